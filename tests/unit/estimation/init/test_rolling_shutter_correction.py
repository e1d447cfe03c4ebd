"""Rolling shutters: rows of a board in fast motion, for the start and for the filter."""

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import project_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.trajectory import hand_motion

from vical_daemon.estimation.events import ROLLING
from vical_daemon.estimation.filter.linearise import view
from vical_daemon.estimation.inertial.imu_model import Motion
from vical_daemon.estimation.init.readout_start import at_middle_row
from vical_daemon.estimation.measurements import CalibrationOptions, PointsFrame
from vical_daemon.estimation.model.rates import Rates
from vical_daemon.estimation.model.retract import CameraPoints

READOUT_S = 0.02


def fast_rig(seed, readout_s=READOUT_S, rate_dps=90.0):
    plain = reference_rig(seed, timeshift_cam_imu_s=0.02)
    motion = hand_motion(seed, rate_dps, T_imu_cam=(plain.R_imu_cam, plain.p_imu_cam))
    return replace(plain, trajectory=motion, readout_s=readout_s)


@pytest.mark.parametrize(("axis", "bent_px"), [("rows", 2.0), ("columns", 1.5)])
def test_corners_are_where_the_middle_row_saw_them(axis, bent_px):
    rolling = simulate(3, 4.0, rig=replace(fast_rig(3), readout_axis=axis), corner_sigma_px=0.0)
    frames = [(f.t_s, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in rolling.frames]
    still = replace(rolling.rig, readout_s=0.0)
    before, after = [], []
    for t_s, frame in at_middle_row(frames, READOUT_S, (640, 480), axis):
        exact = project_points(still, np.array([t_s]), rolling.points_m)[0][0][frame.ids]
        seen = next(f for t, f in frames if t == t_s)
        before.append(np.linalg.norm(seen.uv_px - exact, axis=1))
        after.append(np.linalg.norm(frame.uv_px - exact, axis=1))
    before_px, after_px = (float(np.sqrt(np.mean(np.concatenate(x) ** 2))) for x in (before, after))
    assert before_px > bent_px
    assert after_px < 0.15 * before_px


def test_frames_stay_as_they_are_without_a_readout():
    frames = [(0.1 * k, PointsFrame("cam0", k, np.arange(4), np.ones((4, 2)))) for k in range(3)]
    assert at_middle_row(frames, 0.0, (640, 480)) is frames


def test_rows_are_seen_from_where_the_rig_was_by_then():
    """Against the exact motion: half a readout later its rate has changed, too."""
    rig = fast_rig(3)
    path, lens, off = rig.trajectory, rig.lens, []
    points = simulate(3, 0.2, rig=rig).points_m
    for t in np.linspace(1.0, 4.0, 25):
        uv, seen = (x[0] for x in project_points(rig, np.array([t]), points))
        motion = Motion(*(x(t)[None] for x in (path.R_world_imu, path.p_world_imu, path.v_world_imu)))
        rates = Rates(path.omega_imu_rps(t), path.a_world_imu(t), path.alpha_imu_rps2(t))
        camera = CameraPoints(
            rig.R_imu_cam[None],
            rig.p_imu_cam[None],
            np.zeros(1),
            np.array(lens.intrinsics)[None],
            np.array(lens.distortion)[None],
            np.array([READOUT_S]),
        )
        rows = uv[:, 1] / lens.resolution[1] - 0.5
        off.append((view(points, motion, camera, rates, 0.0, lens.model, rows)[0] - uv)[seen])
    assert np.abs(np.concatenate(off)).max() < 0.1


@pytest.mark.parametrize("said", ["how long", "that it is", "nothing"])
@pytest.mark.parametrize(
    ("seed", "rate_dps", "axis"), [(4, 50.0, "rows"), (5, 90.0, "rows"), (7, 90.0, "columns")]
)
def test_a_rolling_shutter_does_not_delay_the_start(seed, rate_dps, axis, said):
    """Not when its first image is seen by a filter that does not know yet how fast the rig turns, either."""
    rig = replace(fast_rig(seed, rate_dps=rate_dps), readout_axis=axis)
    run = simulate(seed, 7.0, rig=rig, corner_sigma_px=0.2, camera_rate_hz=10.0)
    prior = camera_prior(run, seed, StartErrors(0.03, 5.0), exact_lens=False)
    prior = replace(prior, readout_s=READOUT_S if said == "how long" else 0.0)
    estimate = frozenset({"readout"} if said == "that it is" else ())
    options = CalibrationOptions(imu_noise=imu_noise(run), estimate=estimate)
    subject = CalibratorSubject(options, prior, run.points_m)
    record = feed(run, subject)
    assert record.started_s() <= 6.0
    last = record.snapshots[-1]
    sigma = np.sqrt(np.diag(last.covariance))
    assert np.abs(last.error[:15] / sigma[:15]).max() < 4.0
    camera = subject.calibrator.estimate().cameras["cam0"]
    assert abs(camera.readout_s - READOUT_S) < (1e-12 if said == "how long" else 4.0 * camera.readout_sigma_s)
    assert camera.readout_axis == axis
    announced = [e.kind for _, e in record.events if e.kind in ROLLING.values()]
    assert announced == ([ROLLING[axis]] if said == "nothing" else [])


def test_sigmas_cover_the_noise_of_the_gyro_that_places_the_rows():
    """With sharp corners it is what limits them; taken for nothing, the readout was 4.4 sigma off."""
    run = simulate(9, 12.0, rig=fast_rig(9, rate_dps=60.0), corner_sigma_px=0.02, camera_rate_hz=10.0)
    prior = camera_prior(run, 9, StartErrors(0.03, 5.0), exact_lens=False)
    prior = replace(prior, readout_s=0.0)
    options = CalibrationOptions(imu_noise=imu_noise(run), estimate=frozenset({"readout"}))
    subject = CalibratorSubject(options, prior, run.points_m)
    last = feed(run, subject).snapshots[-1]
    error, covariance = last.error[:7], last.covariance[:7, :7]
    assert error @ np.linalg.solve(covariance, error) < 12.0  # 90 % of chi-square with 7; it was 12.8
    camera = subject.calibrator.estimate().cameras["cam0"]
    assert abs(camera.readout_s - READOUT_S) < 3.0 * camera.readout_sigma_s
