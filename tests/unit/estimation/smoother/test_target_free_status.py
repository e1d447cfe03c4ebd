"""Before a second window confirms an answer, its sigmas include what windows disagree by."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.unit.estimation.some_layout import window_layout
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.selection.clock_drift import CLOCKS_IN_DOUBT
from vical_daemon.estimation.smoother.marginal_prior import CORE, MarginalPrior, root_of
from vical_daemon.estimation.smoother.target_free_status import TargetFreeStatus

LAYOUT = window_layout()
SIGMA = np.array(
    [0.015] + [1e-3] * 16 + [1e-2] * 3 + [1e-3] * 3 + [1e-4, 1e-5] + [2.0] * 4 + [1e-3] * 4 + [1e-4]
)
CAMERA = CameraState(
    np.eye(3), np.zeros(3), 0.01, np.array([500.0, 500.0, 320.0, 240.0]), np.zeros(4), "radtan", (640, 480)
)


def carry(shrunk=1.0):
    whole = np.eye(LAYOUT.size)
    whole[CORE:, CORE:] = shrunk * np.diag(SIGMA**2)
    return MarginalPrior(
        np.eye(3), np.zeros(3), np.zeros(6), CAMERA, root_of(whole), LAYOUT, 0.0, np.zeros(17)
    )


def fit(times):
    """A window that halves the variance, and moves the calibration by `times` what it should."""
    change = np.concatenate([np.zeros(CORE), times * np.sqrt(0.5) * SIGMA])
    return SimpleNamespace(change=change, carry=carry(0.5), counted=carry(0.5))


def focal_sigma(status):
    return status._camera(carry(0.5)).intrinsics_sigma[0]


@pytest.mark.parametrize(("times", "wider"), [(0.7, 1.0), (4.0, 4.0), (30.0, 30.0)])
def test_a_second_window_that_disagrees_widens_the_sigmas_at_once_and_in_full(times, wider):
    status = TargetFreeStatus(CalibrationOptions(), LAYOUT)
    assert focal_sigma(status) == pytest.approx(np.sqrt(0.5) * 2.0)
    status.closed()
    status.agrees(fit(times), carry(), complete=False)
    assert focal_sigma(status) == pytest.approx(wider * np.sqrt(0.5) * 2.0, rel=1e-6)
    status.agrees(fit(1.0), carry(), complete=False)  # as it grows, it turns out to agree
    assert focal_sigma(status) == pytest.approx(np.sqrt(0.5) * 2.0, rel=1e-6)


@pytest.mark.parametrize(("times", "wider"), [(0.7, 1.0), (3.0, 3.0)])
def test_two_complete_windows_widen_the_sigmas_by_all_that_they_disagree_by(times, wider):
    status = TargetFreeStatus(CalibrationOptions(), LAYOUT)
    for _ in range(2):
        status.closed()
        status.agrees(fit(times), carry(), complete=True)
    assert status.proven
    assert focal_sigma(status) == pytest.approx(wider * np.sqrt(0.5) * 2.0, rel=1e-6)


def test_two_windows_that_agree_are_believed_again():
    status = TargetFreeStatus(CalibrationOptions(), LAYOUT)
    status.closed()
    status.agrees(fit(1.5), carry(), complete=True)
    status.closed()
    before = focal_sigma(status)
    status.agrees(
        fit(4.0), carry(), complete=False
    )  # of a third one nothing is believed until it is complete
    assert focal_sigma(status) == before


def test_an_accelerometer_in_g_is_named_before_the_start():
    status = TargetFreeStatus(CalibrationOptions(), LAYOUT)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((2200, 6))
    for k, (w, f) in enumerate(zip(noise[:, :3], noise[:, 3:], strict=True)):
        status.saw_reading(5_000_000 * k, w, f + np.array([0.0, 0.0, 1.0]))
    estimate = status.estimate(None, 0.0, running=False, gravity=[])
    assert estimate.status == Status.INCONSISTENT
    assert "it looks like g: multiply by 9.80665" in estimate.reason


def test_a_clock_that_changes_again_and_again_is_in_doubt():
    """After changes at 10 s and 19 s it may change again at 28 s; once that is over it is believed."""
    status = TargetFreeStatus(CalibrationOptions(), LAYOUT)
    for _ in range(3):
        status.closed()
    reasons = []
    for second in range(36):
        status.saw_reading(second * 10**9, np.zeros(3), np.array([0.0, 0.0, 9.8]))
        if second in (10, 19):
            status.stepped(2e-3)
        reasons.append(status.estimate(carry(0.01), 0.0, running=True, gravity=[]).reason)
    doubtful = [k for k, reason in enumerate(reasons) if reason == CLOCKS_IN_DOUBT]
    assert 19 <= doubtful[0] <= 21 and 27 <= doubtful[-1] <= 30 and len(doubtful) <= 9
