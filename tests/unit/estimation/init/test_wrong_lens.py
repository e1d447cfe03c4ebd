"""A fixed lens that is not this camera's is named as the reason for no start, not the motion or the delay."""

from dataclasses import replace

import pytest
from vical_mocks.harness.feed import (
    CalibratorSubject,
    StartErrors,
    camera_prior,
    events_in_order,
    imu_noise,
    points_frame,
)
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior


def _reasons(run, prior: CameraPrior) -> list[str]:
    """What is said until a start, every second."""
    options = CalibrationOptions(imu_noise=imu_noise(run), fix=frozenset({"intrinsics"}))
    subject, reasons, next_s = CalibratorSubject(options, prior, run.points_m), [], 1.0
    for t_s, event in events_in_order(run):
        if isinstance(event, int):
            subject.add_imu(int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])
        else:
            subject.add_points(points_frame(event))
        if t_s > next_s:
            next_s += 1.0
            estimate = subject.calibrator.estimate()
            if estimate.cameras:
                break
            reasons.append(estimate.reason)
    return reasons


def _scaled(prior: CameraPrior, size: float) -> CameraPrior:
    fx, fy, cx, cy = prior.intrinsics
    return replace(prior, intrinsics=(fx * size, fy * size, cx, cy))


def _fisheye(prior: CameraPrior) -> CameraPrior:
    return replace(prior, distortion_model="equidistant", distortion=(0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "wrong",
    [lambda p: _scaled(p, 470 / 520), lambda p: _scaled(p, 1.2), _fisheye],
    ids=["470", "624", "equi"],
)
def test_a_fixed_lens_of_another_camera_is_blamed(wrong):
    run = simulate(1, 7.0)
    reasons = _reasons(run, wrong(camera_prior(run, 1, StartErrors(), exact_lens=True)))
    assert any("is not this camera's: with fx 5" in reason for reason in reasons)
    assert not any("turn the rig" in reason or "delay" in reason for reason in reasons)


@pytest.mark.parametrize("seed", [2, 3])
def test_a_fixed_lens_that_is_right_is_not_blamed_for_slow_motion(seed):
    run = simulate(seed, 12.0, rig=reference_rig(seed, mean_rate_dps=4.0))
    reasons = _reasons(run, camera_prior(run, seed, StartErrors(), exact_lens=True))
    assert any("turn the rig" in reason or "delay" in reason for reason in reasons)
    assert not any("lens" in reason for reason in reasons)
