"""Images that are wrong for a while are no change of the rig."""

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.points import simulate

from tests.unit.estimation.test_calibrator import calibrate, errors
from vical_daemon.estimation.measurements import CalibrationOptions, ImuNoise
from vical_daemon.estimation.result import Status

WRONG = 10  # images, half a second


@pytest.mark.parametrize("fix", [(), ("intrinsics",)], ids=["free lens", "fixed lens"])
def test_nothing_has_changed_where_images_fit_again_after_a_while(fix):
    """They had been announced as another lens, then as a bump, and calibration had started over."""
    true = simulate(1, 19.0, timeshift_cam_imu_s=0.012)
    first = next(k for k, f in enumerate(true.frames) if f.t_s >= 15.0)
    frames = list(true.frames)
    for k in range(first, first + WRONG):
        frames[k] = replace(frames[k], uv_px=frames[k].uv_px + np.array([15.0, 0.0]))
    events = []
    estimate = calibrate(
        replace(true, frames=frames),
        CalibrationOptions(fix=frozenset(fix), imu_noise=ImuNoise()),
        each=lambda c: events.extend(c.estimate().events),
    ).estimate()
    assert events == []
    x, sigma = errors(estimate, true)
    assert estimate.status == Status.CONVERGED and np.abs(x / sigma).max() < 3.5
