"""first_window.py: columns are tried where they explain more than chance, in the first window and later."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from vical_mocks.harness.feed import CAMERA, CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import COLUMNS, CalibrationOptions
from vical_daemon.estimation.smoother import first_window
from vical_daemon.estimation.smoother.first_window import readout_sigmas, shows_columns


@pytest.mark.parametrize(
    ("gain", "misfit", "worth"),
    [(5.0, 1.0, False), (12.0, 1.0, True), (5.0, 0.4, False), (20.0, 4.0, False), (50.0, 4.0, True)],
)
def test_columns_are_tried_where_they_explain_more_than_chance(gain, misfit, worth):
    problem = SimpleNamespace(late_by_columns=lambda view: gain)
    fit = SimpleNamespace(squares=1000.0 * misfit, dof=1000)
    assert shows_columns(SimpleNamespace(view=object(), problem=problem), fit) is worth
    assert not shows_columns(SimpleNamespace(view=None, problem=problem), fit)


def test_a_readout_counts_by_its_sigmas():
    where = SimpleNamespace(camera=SimpleNamespace(readout=7))
    carry = SimpleNamespace(camera=SimpleNamespace(readout_s=-0.03), layout=where, sigma={7: 2e-3}.get)
    assert readout_sigmas(carry) == pytest.approx(15.0)


def test_columns_that_the_first_window_does_not_show_are_found_in_a_later_one(monkeypatch):
    run = simulate_tracks(
        5, 9.0, rig=reference_rig(5, readout_s=0.02, readout_axis=COLUMNS), camera_rate_hz=10.0
    )
    prior = camera_prior(run, 5, StartErrors(0.05, 5.0), exact_lens=False)
    prior = replace(prior, readout_s=0.0, readout_axis="")
    asked = []

    def not_at_first(bundle, fit):
        asked.append(bundle.window.camera.readout_axis)
        return len(asked) > 1 and shows_columns(bundle, fit)

    monkeypatch.setattr(first_window, "shows_columns", not_at_first)
    subject = CalibratorSubject(CalibrationOptions(target_free=True, imu_noise=imu_noise(run)), prior, None)
    record = feed(run, subject)
    events = [event for _, event in record.events]
    assert asked == ["", ""]  # from then on it is known
    assert [e.kind for e in events if e.kind is EventKind.ROLLING_COLUMNS]
    found = subject.calibrator.latest.camera
    assert found.readout_axis == COLUMNS and abs(found.readout_s - 0.02) < 1.5e-3
    last = record.snapshots[-1]
    assert np.abs(last.error[:7] / np.sqrt(np.diag(last.covariance)[:7])).max() < 4.0
    assert subject.calibrator.camera == CAMERA
