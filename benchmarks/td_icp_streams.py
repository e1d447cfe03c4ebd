"""Temporal calibration of whole recordings: hand-held board, several sensors of a robot, real data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from vical_mocks.points import board_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import exp_so3, log_so3
from vical_mocks.trajectory import hand_motion

from benchmarks.td_icp_trials import DEG, GYRO, IMU_HZ, WALK, simulate_gyro
from vical_daemon.estimation.init.camera_start import starting_camera
from vical_daemon.estimation.init.intrinsics_start import estimate_intrinsics
from vical_daemon.estimation.measurements import CameraPrior, PointsFrame
from vical_daemon.estimation.temporal.camera_orientations import target_orientations
from vical_daemon.estimation.temporal.td_icp import joint_with_gyro, td_icp
from vical_daemon.estimation.temporal.td_icp_input import OrientationStream, TdIcpOptions
from vical_daemon.estimation.temporal.td_icp_result import TdIcpResult

FloatArray = npt.NDArray[np.float64]


def _handheld(seed: int, seconds: float) -> tuple[TdIcpResult, float, FloatArray]:
    shift = float(np.random.default_rng([seed, 3]).uniform(-0.3, 0.3))
    run = simulate(seed, seconds, rig=reference_rig(seed, timeshift_cam_imu_s=shift), camera_rate_hz=20.0)
    lens = run.rig.lens
    frames = [PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px) for f in run.frames]
    used = starting_camera(
        CameraPrior(lens.resolution, tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    )
    estimate_intrinsics(used, frames, board_points())
    poses = target_orientations(frames, board_points(), used.intrinsics, used.distortion, lens.model)
    base = int(run.t_imu_ns[0])
    result = td_icp(
        (run.t_imu_ns - base) * 1e-9, run.gyro_rps, (poses.t_cam_ns - base) * 1e-9, poses.R_world_cam,
        poses.covariance, TdIcpOptions(gyro_density=GYRO, gyro_walk=WALK),
    )  # fmt: skip
    return result, shift, run.rig.R_imu_cam


def study_handheld(trials: int) -> None:
    """Table 3.2: corners of a board seen by a hand-held camera, lens and poses from the corners."""
    print(f"\n### {trials} hand-held recordings of a board (48 corners, 0.5 px, 20 Hz), lens refined\n")
    print(
        "| length s | solved | RMSE us | reported sigma us | inside 2 sigma | R_imu_cam deg/axis |"
        "\n|---|---|---|---|---|---|"
    )
    for seconds in (10.0, 20.0):
        found = [_handheld(s, seconds) for s in range(trials)]
        good = [f for f in found if f[0].status == "ok"]
        error = np.array([r.timeshift_cam_imu_s - shift for r, shift, _ in good])
        sigma = np.array([r.timeshift_sigma_s for r, _, _ in good])
        turn = np.array([log_so3(R.T @ r.R_imu_cam) for r, _, R in good])
        print(
            f"| {seconds:.0f} | {len(good)}/{trials} | {1e6 * np.sqrt(np.mean(error**2)):.0f} | "
            f"{1e6 * sigma.mean():.0f} | {100 * np.mean(np.abs(error) < 2 * sigma):.0f} % | "
            f"{np.sqrt(np.mean(turn**2)) / DEG:.3f} |",
            flush=True,
        )


def study_joint(trials: int) -> None:
    """Table 3.3: an imu, two cameras and a pose estimator of one robot, all at once."""
    sensors = {"cam0": (15.0, 0.1, 0.012), "cam1": (20.0, 0.15, -0.035), "odometry": (30.0, 0.3, 0.25)}
    print(f"\n### {trials} recordings of 10 s with an imu and three other sensors, registered together\n")
    print("| pair | RMSE us | reported sigma us | inside 2 sigma |\n|---|---|---|---|")
    errors: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for seed in range(trials):
        rng, motion = np.random.default_rng([seed, 9]), hand_motion(seed, 55.0)
        t_imu = np.arange(4.0, 17.0, 1.0 / IMU_HZ)
        gyro, _ = simulate_gyro(motion, t_imu, rng)
        streams = []
        for name, (hz, noise, shift) in sensors.items():
            t = np.arange(5.0, 15.0, 1.0 / hz)
            R = exp_so3(rng.normal(0, 1, 3)) @ motion.R_world_imu(t) @ exp_so3(rng.normal(0, 1, 3))
            R = R @ exp_so3(rng.normal(0.0, noise * DEG, (len(t), 3)))
            streams.append(OrientationStream(name, t - shift, R, noise * DEG))
        result = joint_with_gyro(
            "imu0", t_imu, gyro, streams, TdIcpOptions(gyro_density=GYRO, gyro_walk=WALK)
        )
        truth = {"imu0": 0.0, **{name: s[2] for name, s in sensors.items()}}
        for pair in result.pairs:
            error = pair.timeshift_s - (truth[pair.a] - truth[pair.b])
            errors.setdefault((pair.a, pair.b), []).append((error, pair.timeshift_sigma_s))
    for (a, b), values in errors.items():
        e, s = np.array(values).T
        print(
            f"| {a} - {b} | {1e6 * np.sqrt(np.mean(e**2)):.0f} | {1e6 * s.mean():.0f} | "
            f"{100 * np.mean(np.abs(e) < 2 * s):.0f} % |"
        )


def study_real(folder: Path) -> None:
    """Windows of 10 s of a real recording whose delay is next to nothing (hardware trigger; Kalibr: 5 us)."""
    from vical_daemon.config.priors import read_initial
    from vical_daemon.logs import open_recording
    from vical_daemon.vision.target import load_target

    if not folder.is_dir():
        print(f"\n(real data skipped: {folder} is not there)")
        return
    prior = read_initial(folder / "initial.yaml")
    camera, noise = prior.cameras["cam0"], prior.imu_noise
    assert camera.intrinsics is not None and camera.distortion is not None and noise is not None
    recording = open_recording(folder, check=False)
    points = load_target(folder / "target.yaml").points_m
    frames = [f for f in recording.points_frames("cam0") if len(f.ids)]
    lens = starting_camera(camera)
    estimate_intrinsics(lens, frames, points)
    poses = target_orientations(frames, points, lens.intrinsics, lens.distortion, lens.distortion_model)
    imu = recording.imu_arrays("imu0")
    base = int(imu.t_ns[0])
    t_imu, t_cam = (imu.t_ns - base) * 1e-9, (poses.t_cam_ns - base) * 1e-9
    options = TdIcpOptions(gyro_density=noise.gyro_density, gyro_walk=noise.gyro_walk)
    print("\n### Real: EuRoC imu_april, windows of 10 s (and the whole)\n")
    print(
        "| from s | mean rate deg/s | delay us | reported sigma us | delay / sigma | status |"
        "\n|---|---|---|---|---|---|"
    )
    windows = [(float(s), 10.0) for s in range(0, 63, 4)] + [(0.0, 100.0)]
    for begin, length in windows:
        m = (t_cam >= begin) & (t_cam < begin + length)
        k = (t_imu > begin - 0.5) & (t_imu < begin + length + 0.5)
        r = td_icp(t_imu[k], imu.gyro_rps[k], t_cam[m], poses.R_world_cam[m], poses.covariance[m], options)
        rate = np.linalg.norm(imu.gyro_rps[k] - np.array([-0.002, 0.024, 0.077]), axis=1).mean() / DEG
        print(
            f"| {begin:.0f} | {rate:.0f} | {1e6 * r.timeshift_cam_imu_s:+.0f} | "
            f"{1e6 * r.timeshift_sigma_s:.0f} | {r.timeshift_cam_imu_s / r.timeshift_sigma_s:+.1f} | "
            f"{r.status} |",
            flush=True,
        )
