"""Rehearsals whose answers creep: slow motion, many sharp images, a poor start."""

import numpy as np

from benchmarks.zoo import draw, trial
from vical_daemon.estimation.start import rehearsal

SEED = 318  # 60 images a second, 0.25 px, 19 deg/s


def test_answers_that_creep_are_found_with_the_imu_as_stated(monkeypatch):
    # with all states from the first run on: 8 sigma off, and an imu that is true was told to be 0.8 % off
    done = []
    runs = rehearsal._runs

    def counted(*args, **how):
        found = runs(*args, **how)
        done.append((how.get("as_stated", False), found.runs, found.stands))
        return found

    monkeypatch.setattr(rehearsal, "_runs", counted)
    run, _ = draw(SEED, 7.0, target_free=False)
    assert run.options.camera_rate_hz == 60.0
    result = trial(False, False, 7.0, SEED)
    assert [held for held, *_ in done] == [False, True, False]
    assert done[0][1] >= rehearsal._CREEPING
    assert all(stands for *_, stands in done[1:])
    assert result["events"] == []
    z = np.abs(np.array(result["trace"]["error"][-1][:7]) / np.array(result["trace"]["sigma"][-1][:7]))
    assert z.max() < 4.0
