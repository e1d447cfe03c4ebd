"""Simulated sensors measure what the truth says, with the noise that is stated, at the stamps they bear."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.lens import Lens
from vical_mocks.points import EPOCH_NS, board_points, simulate
from vical_mocks.rig import BiasWalk, Bump, ImuDensities, reference_rig
from vical_mocks.tracks import simulate_tracks

QUIET = ImuDensities().scaled(0.0)


def noise_free_run(**changes):
    rig = reference_rig(3, densities=QUIET, **changes)
    return simulate(3, 6.0, rig=rig, corner_sigma_px=0.0)


def test_corners_are_where_the_shifted_camera_sees_them():
    run = noise_free_run(timeshift_cam_imu_s=0.08, clock_skew_ppm=500.0)
    rig = run.rig
    for frame in run.frames[::17]:
        t_cam_s = (frame.t_cam_ns - EPOCH_NS) * 1e-9
        t_imu_s = t_cam_s + 0.08 + 500e-6 * frame.t_s
        assert t_imu_s == pytest.approx(frame.t_s, abs=2e-9)
        R_world_imu = rig.trajectory.R_world_imu(t_imu_s)
        p_imu = (board_points()[frame.ids] - rig.trajectory.p_world_imu(t_imu_s)) @ R_world_imu
        p_cam = (p_imu - rig.p_imu_cam) @ rig.R_imu_cam
        uv = 520.0 * p_cam[:, :2] / p_cam[:, 2:] + [320.0, 240.0]
        np.testing.assert_allclose(frame.uv_px, uv, atol=1e-6)


def test_inertial_readings_integrate_to_the_trajectory():
    run = simulate(4, 5.0, rig=reference_rig(4, densities=QUIET), imu_rate_hz=1000.0)
    rig = run.rig
    gyro = run.gyro_rps - rig.gyro_bias.value((run.t_imu_ns - EPOCH_NS) * 1e-9)
    force = run.specific_force_mps2 - rig.accel_bias.value((run.t_imu_ns - EPOCH_NS) * 1e-9)
    R, v, p, step_s = (
        rig.trajectory.R_world_imu(0.0),
        rig.trajectory.v_world_imu(0.0),
        rig.trajectory.p_world_imu(0.0),
        1e-3,
    )
    for i in range(5000):
        half = R @ Rotation.from_rotvec((3 * gyro[i] + gyro[i + 1]) / 8 * step_s).as_matrix()
        acceleration = half @ (force[i] + force[i + 1]) / 2 + rig.gravity_world_mps2
        p, v = p + v * step_s + acceleration * step_s**2 / 2, v + acceleration * step_s
        R = R @ Rotation.from_rotvec((gyro[i] + gyro[i + 1]) / 2 * step_s).as_matrix()
    error = Rotation.from_matrix(R.T @ rig.trajectory.R_world_imu(5.0)).magnitude()
    assert error < 1e-5
    np.testing.assert_allclose(v, rig.trajectory.v_world_imu(5.0), atol=1e-3)
    np.testing.assert_allclose(p, rig.trajectory.p_world_imu(5.0), atol=2e-3)


def test_noise_has_the_stated_densities():
    rig = reference_rig(5)
    run = simulate(5, 60.0, rig=rig, imu_rate_hz=200.0)
    t_s = (run.t_imu_ns - EPOCH_NS) * 1e-9
    gyro, force = rig.imu_reading(t_s)
    n = gyro.size
    for residual, density in (
        (run.gyro_rps - gyro, rig.densities.gyro),
        (run.specific_force_mps2 - force, rig.densities.accel),
    ):
        ratio = np.sum(residual**2) / (density**2 * 200.0) / n
        assert ratio == pytest.approx(1.0, abs=4 * np.sqrt(2 / n))


def test_bias_walk_grows_as_stated_and_does_not_depend_on_the_asking():
    walks = [BiasWalk(np.zeros(3), 2e-3, seed) for seed in range(200)]
    end = np.array([walk.value(100.0) for walk in walks])
    assert np.mean(end**2) == pytest.approx(2e-3**2 * 100.0, rel=4 * np.sqrt(2 / end.size))
    again = BiasWalk(np.zeros(3), 2e-3, 7)
    again.value(3000.0)
    np.testing.assert_array_equal(again.value(100.0), walks[7].value(100.0))


def test_averaged_samples_differ_from_instantaneous_ones_by_the_second_derivative():
    rig = reference_rig(6, densities=QUIET)
    mean = simulate(6, 5.0, rig=rig, imu_average_s=0.015).gyro_rps
    instant = simulate(6, 5.0, rig=rig).gyro_rps
    curvature = (instant[2:] - 2 * instant[1:-1] + instant[:-2]) * 1.5**2 / 24
    np.testing.assert_allclose((mean - instant)[1:-1], curvature, atol=0.05 * np.abs(curvature).max())


def test_bump_changes_extrinsics_and_shift_from_its_time_on():
    bump = Bump(3.0, (0.0, 0.02, 0.0), (0.01, 0.0, 0.0), 0.02)
    rig = reference_rig(7, bumps=(bump,))
    R, p = rig.extrinsics_at(np.array([2.9, 3.1]))
    assert Rotation.from_matrix(R[0].T @ R[1]).as_rotvec() == pytest.approx([0, 0.02, 0])
    assert p[1] - p[0] == pytest.approx([0.01, 0, 0])
    assert np.diff(rig.timeshift_at([2.9, 3.1])) == pytest.approx(0.02)
    stamps = np.array([f.t_cam_ns for f in simulate(7, 6.0, rig=rig).frames])
    assert np.all(np.diff(stamps) > 0)


def test_a_clock_may_begin_to_drift_later():
    rig = reference_rig(7, timeshift_cam_imu_s=0.01, clock_skew_ppm=100.0, clock_skew_from_s=3.0)
    assert rig.timeshift_at([0.0, 3.0, 5.0]) == pytest.approx([0.01, 0.01, 0.0102])


def test_rolling_shutter_rows_are_later():
    run = noise_free_run(readout_s=0.02)
    frame = run.frames[30]
    t_row = frame.t_s + 0.02 * (frame.uv_px[:, 1] / 480 - 0.5)
    R, p = run.rig.camera_pose_target(t_row)
    p_cam = np.einsum("nji,nj->ni", R, board_points()[frame.ids] - p)
    np.testing.assert_allclose(frame.uv_px, run.rig.lens.project(p_cam)[0], atol=1e-3)


@pytest.mark.parametrize(
    "lens",
    [
        Lens(distortion=(-0.28, 0.07, 2e-4, -3e-4)),
        Lens((460.0, 458.0, 367.0, 248.0), (-0.02, 0.03, -0.02, 0.008), (752, 480), "equidistant"),
    ],
)
def test_lens_both_ways(lens):
    width, height = lens.resolution
    u, v = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 7))
    uv = np.stack([u, v], axis=-1)
    again, inside = lens.project(lens.unproject(uv) * 2.5)
    np.testing.assert_allclose(again, uv, atol=1e-8)
    assert inside[1:-1, 1:-1].all()


def test_options_spoil_the_board_as_told():
    run = simulate(
        8, 20.0, outlier_fraction=0.05, missing_fraction=0.1, hidden_fraction=0.3, frame_drop_fraction=0.1
    )
    assert len(run.frames) < 0.95 * 400
    assert np.mean(np.concatenate([f.outlier for f in run.frames])) == pytest.approx(0.05, abs=0.01)
    assert min(len(f.ids) for f in run.frames) < 24
    whole = simulate(8, 5.0, whole_board_only=True)
    assert {len(f.ids) for f in whole.frames} == {48}


def test_the_same_seed_gives_the_same_run():
    a, b = simulate(9, 3.0), simulate(9, 3.0)
    np.testing.assert_array_equal(a.gyro_rps, b.gyro_rps)
    np.testing.assert_array_equal(a.frames[5].uv_px, b.frames[5].uv_px)


def test_tracks_get_new_ids_when_they_come_back():
    run = simulate_tracks(1, 10.0)
    seen = [set(frame.ids.tolist()) for frame in run.frames]
    assert max(map(len, seen)) <= 60
    assert np.mean([len(s) for s in seen]) > 45
    alive_then_gone = set()
    for before, after in itertools.pairwise(seen):
        assert not (after & alive_then_gone)
        alive_then_gone |= before - after
    frame = run.frames[100]
    landmarks = run.points_m[[run.landmark_of[int(i)] for i in frame.ids]]
    uv, _ = run.rig.lens.project(run.rig.points_in_camera(np.array(frame.t_s), landmarks))
    assert np.std(frame.uv_px - uv) == pytest.approx(0.5, abs=0.15)
