"""Optional blocks without a target: readout and matrices of the imu are found, with honest sigmas."""

import numpy as np
import pytest
from scipy.stats import chi2
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise, nees
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.target_free import TargetFreeCalibrator
from vical_daemon.estimation.wording import event_text


def followed(seed, estimate, *, seconds=9.0, dark=None, accel_lag_s=0.0, rate_hz=10.0, **changes):
    """A recording of a rig with these changes, and the calibration that finds `estimate`, too."""
    shift_s = float(np.random.default_rng([seed, 92]).uniform(-0.05, 0.05))
    rig = reference_rig(seed, timeshift_cam_imu_s=shift_s, **changes)
    run = simulate_tracks(seed, seconds, rig=rig, camera_rate_hz=rate_hz, accel_lag_s=accel_lag_s)
    if dark is not None:
        run.frames[:] = [f for f in run.frames if not dark[0] < f.t_s < dark[1]]
    prior = camera_prior(run, seed, StartErrors(0.05, 5.0), exact_lens=True)
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}),
        estimate=frozenset(estimate),
        target_free=True,
        imu_noise=imu_noise(run),
    )
    subject = CalibratorSubject(options, prior, None)
    return rig, subject.calibrator, feed(run, subject)


def crooked(seed):
    """Matrices of the rig's readings, one percent off; the accelerometer's inverse is a lower triangle."""
    rng = np.random.default_rng([seed, 93])
    lower = np.eye(3) + np.tril(0.01 * rng.standard_normal((3, 3)))
    return {
        "gyro_matrix": np.eye(3) + 0.01 * rng.standard_normal((3, 3)),
        "accel_matrix": np.linalg.inv(lower),
    }


def matrix_errors(rig, imu):
    """Of the 15 entries: M_g row by row, lower triangle of M_a."""
    gyro = np.array(imu.gyro_matrix) - np.linalg.inv(rig.gyro_matrix)
    accel = np.array(imu.accel_matrix) - np.linalg.inv(rig.accel_matrix)
    return np.concatenate([gyro.ravel(), accel[np.tril_indices(3)]])


@pytest.mark.parametrize("readout_s", [-0.015, 0.03])
def test_a_readout_nobody_told_is_found(readout_s):
    rig, calibrator, record = followed(3, {"readout"}, readout_s=readout_s)
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-5, 7), shot.t_s
    camera = calibrator.estimate().cameras["cam0"]
    assert 0.0 < camera.readout_sigma_s < 5e-4
    assert abs(camera.readout_s - rig.readout_s) < 4.0 * camera.readout_sigma_s


def imu_covariance(carry):
    """Of the entries of the matrices."""
    entries = slice(carry.layout.gyro_matrix.start, carry.layout.accel_matrix.stop)
    return carry.covariance()[entries, entries]


def test_scale_and_misalignment_of_the_imu_are_found():
    rig, calibrator, record = followed(4, {"imu_intrinsics"}, **crooked(4))
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-5, 7), shot.t_s
    error = matrix_errors(rig, calibrator.estimate().imu)
    P = imu_covariance(calibrator.latest)
    assert error @ np.linalg.solve(P, error) < chi2.isf(1e-4, 15)
    assert np.sqrt(np.diag(P)).max() < 0.006  # from one percent, after nine seconds


@pytest.mark.parametrize("size", [1e-3, 3e-3, 1e-2])
def test_untold_matrices_are_noticed_and_no_answer_is_sure_and_wrong(size):
    # until two windows can be compared, at some 12 s, it may as well be the images
    # what is reported is the mounting in the frame in which the gyro's matrix is symmetric
    rng = np.random.default_rng(4)
    G, A = rng.standard_normal((2, 3, 3))
    off = {"gyro_matrix": np.eye(3) + 0.5 * size * (G + G.T), "accel_matrix": np.eye(3) + size * A}
    _, calibrator, record = followed(4, set(), seconds=16.0, **off)
    assert any(e.kind is EventKind.IMU_INTRINSICS for _, e in record.events)
    assert record.statuses[-1][1] == "converged"
    for shot in record.snapshots:
        if shot.status == "converged":
            assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-6, 7), shot.t_s
    assert calibrator.estimate().imu.gyro_matrix == []  # only where asked for: another frame is meant


def test_an_imu_that_is_true_pays_nothing():
    _, _, record = followed(4, set(), seconds=12.0)
    _, _, imu_asked = followed(4, {"imu_intrinsics"}, seconds=12.0)
    assert not any(e.kind is EventKind.IMU_INTRINSICS for _, e in record.events)
    assert nees(record.snapshots[-1].error, record.snapshots[-1].covariance, 7) < chi2.isf(1e-3, 7)
    sigma, asked = (np.sqrt(np.diag(r.snapshots[-1].covariance))[3:6] for r in (record, imu_asked))
    assert sigma.max() < 0.6 * asked.max()


@pytest.mark.parametrize("lag_s", [3e-4, -3e-4])
def test_an_accelerometer_out_of_step_is_told_and_every_answer_is_right(lag_s):
    # taken as in step: NEES/7 4.6 after half a minute, `converged`
    _, calibrator, record = followed(3, set(), seconds=24.0, accel_lag_s=lag_s, rate_hz=20.0)
    where = "ms behind the gyro" if lag_s > 0 else "ms ahead of the gyro"
    (event,) = (e for _, e in record.events if e.kind is EventKind.ACCEL_LAG)
    assert where in event_text(event)
    for shot in record.snapshots:
        assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-4, 7), shot.t_s
    found, sigma = calibrator.latest.imu[-1], calibrator.latest.sigma(calibrator.layout.accel_lag)
    assert sigma < 1e-4
    assert abs(found - lag_s) < 3.0 * sigma


def test_what_was_found_outlasts_darkness():
    rig, calibrator, record = followed(
        5, {"readout", "imu_intrinsics"}, seconds=16.0, dark=(8.0, 11.0), readout_s=0.02, **crooked(5)
    )
    assert any(e.kind is EventKind.WENT_ON for _, e in record.events)
    last = record.snapshots[-1]
    assert nees(last.error, last.covariance, 7) < chi2.isf(1e-4, 7)
    estimate = calibrator.estimate()
    error, P = matrix_errors(rig, estimate.imu), imu_covariance(calibrator.latest)
    assert error @ np.linalg.solve(P, error) < chi2.isf(1e-4, 15)
    camera = estimate.cameras["cam0"]
    assert abs(camera.readout_s - 0.02) < 4.0 * camera.readout_sigma_s


def test_what_is_not_asked_for_is_held():
    _, calibrator, _ = followed(6, set(), seconds=7.0)
    estimate = calibrator.estimate()
    assert estimate.imu.gyro_matrix == estimate.imu.accel_matrix == []
    assert estimate.cameras["cam0"].readout_s == estimate.cameras["cam0"].readout_sigma_s == 0.0


def test_the_size_of_a_target_that_is_not_there_is_refused():
    options = CalibrationOptions(target_free=True, estimate=frozenset({"target_scale"}))
    with pytest.raises(ValueError, match="without a target there is no target_scale"):
        TargetFreeCalibrator(options, {"a": CameraPrior((640, 480))})


@pytest.mark.parametrize(("asked", "seconds"), [(set(), 16.0), ({"size_effect"}, 12.0)])
def test_positions_of_the_accelerometers_axes_are_estimated_without_being_asked_for(asked, seconds):
    positions = np.array([[-5e-3, 8e-3, -1e-3], [2e-3, -4e-3, 0.0], [3e-3, -4e-3, 1e-3]])
    _, calibrator, record = followed(2, asked, seconds=seconds, accel_positions=positions)
    found = np.array(calibrator.estimate().imu.accel_positions_m)
    np.testing.assert_allclose(found, positions, atol=5e-3)
    shot = record.snapshots[-1]
    assert nees(shot.error, shot.covariance, 7) < chi2.isf(1e-4, 7)
