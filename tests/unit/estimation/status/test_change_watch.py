"""When it is looked for what has jumped."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.status.change_watch import Action, ChangeWatch


def _filter(suspicion: float) -> Any:
    """A filter whose images have disagreed, by so much, and whose clocks are not estimated."""
    known = Consistency(suspicion=suspicion)
    cameras = {"cam0": SimpleNamespace(skew=None)}
    return SimpleNamespace(
        state=SimpleNamespace(t_s=5.0), consistency={"cam0": known}, layout=SimpleNamespace(cameras=cameras)
    )


@pytest.mark.parametrize(("early", "asked"), [(True, True), (False, False)])
def test_first_signs_of_a_change_count_once_the_calibration_has_been_confirmed(early, asked) -> None:
    watch, f, used = ChangeWatch(), _filter(100.0), SimpleNamespace(camera="cam0", used=True)
    actions = {watch.look(used, f, early=early) for _ in range(15)}
    assert (Action.ASK in actions) == asked and Action.RESTART not in actions


@pytest.mark.parametrize("early", [True, False])
def test_refused_images_count_at_any_time(early) -> None:
    watch, f, refused = ChangeWatch(), _filter(0.0), SimpleNamespace(camera="cam0", used=False)
    assert Action.POSE in {watch.look(refused, f, early=early) for _ in range(10)}
