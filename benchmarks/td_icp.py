"""Temporal calibration: RMSE beside the bound, honest sigmas, outliers, holes, several sensors, real data.

The thesis' Table 3.1 is 100 trials on each of four trajectories; tables 3.2 and 3.3 are a hand-held camera
and imu, and several sensors of one robot. Truth and noise come from `vical_mocks`, the bound from this file:
the dense covariance of all orientations together, inverted as it stands (the estimator never forms it).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from vical_mocks.points import board_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import exp_so3, log_so3
from vical_mocks.trajectory import Trajectory, hand_motion

from vical_daemon.estimation.camera_orientations import target_orientations
from vical_daemon.estimation.lens_refinement import refine_lens
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.td_icp import TdIcpOptions, TdIcpResult, td_icp
from vical_daemon.estimation.td_icp_joint import OrientationStream, joint_with_gyro

FloatArray = npt.NDArray[np.float64]

DEG = np.pi / 180.0
GYRO, WALK = 5.2e-4, 2.0e-5  # GX3: rad/s/sqrt(Hz), rad/s^2/sqrt(Hz)
IMU_HZ = 100.0
REACH_S = 2.0


# The four motions; every trial has its own phases and frequencies.
TRAJECTORIES: dict[str, Callable[[int], Trajectory]] = {
    "hand, 40 deg/s": lambda seed: hand_motion(seed, 40.0),
    "hand, 60 deg/s": lambda seed: hand_motion(seed, 60.0),
    "random knots, 60 deg/s": lambda seed: hand_motion(seed, 60.0, style="spline"),
    "brisk, 100 deg/s": lambda seed: hand_motion(seed, 100.0),
}


def simulate_gyro(
    motion: Trajectory, t_s: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Readings with GX3 noise, and the bias in the middle."""
    dt = float(t_s[1] - t_s[0])
    bias = rng.normal(0.0, 0.005, 3) + np.cumsum(rng.normal(0.0, WALK * np.sqrt(dt), (len(t_s), 3)), axis=0)
    return motion.omega_imu_rps(t_s) + bias + rng.normal(0.0, GYRO / np.sqrt(dt), (len(t_s), 3)), bias


def bound(motion: Trajectory, t_s: FloatArray, R_imu_cam: FloatArray, sigma: float) -> tuple[float, float]:
    """Cramer-Rao bound of the delay (s) and of the mounting (largest of three, rad).

    Residuals in the world: white camera noise, random walk of the integrated gyro, integrated bias walk;
    unknown: reference rotation, mounting, bias at the start, delay.
    """
    n = len(t_s)
    R = motion.R_world_imu(t_s)
    s = t_s - t_s[0]
    early, late = np.minimum(s[:, None], s[None]), np.maximum(s[:, None], s[None])
    C = sigma**2 * np.eye(n) + GYRO**2 * early + WALK**2 * early**2 * (3.0 * late - early) / 6.0
    fine = np.linspace(t_s[0], t_s[-1], 20 * n)
    steps = motion.R_world_imu(fine)
    integral = np.zeros((len(fine), 3, 3))
    integral[1:] = np.cumsum(0.5 * (steps[1:] + steps[:-1]) * (fine[1] - fine[0]), axis=0)
    A = np.stack(
        [np.interp(t_s, fine, integral[:, i, j]) for i in range(3) for j in range(3)], axis=1
    ).reshape(n, 3, 3)
    J = np.zeros((n, 3, 10))
    J[:, :, :3] = np.eye(3)
    J[:, :, 3:6] = R @ R_imu_cam
    J[:, :, 6:9] = A.reshape(n, 3, 3)
    J[:, :, 9] = np.einsum("kij,kj->ki", R, motion.omega_imu_rps(t_s))
    W = np.linalg.inv(C)
    information = np.einsum("kip,kl,liq->pq", J, W, J, optimize=True)
    P = np.linalg.inv(information)
    return float(np.sqrt(P[9, 9])), float(np.sqrt(np.diagonal(P)[3:6].max()))


def trial(
    motion: Trajectory,
    seed: int,
    seconds: float = 10.0,
    camera_hz: float = 15.0,
    sigma: float = 0.1 * DEG,
    outliers: float = 0.0,
    hole_s: float = 0.0,
) -> dict[str, float]:
    """One simulated recording with a random delay of up to 2 s, any mounting; figures in SI units."""
    rng = np.random.default_rng([seed, 77])
    shift = float(rng.uniform(-REACH_S, REACH_S))
    R_imu_cam = exp_so3(rng.normal(0.0, 1.5, 3))
    begin = 5.0
    t_imu = np.arange(begin - REACH_S - 0.5, begin + seconds + REACH_S + 0.5, 1.0 / IMU_HZ)
    gyro, _ = simulate_gyro(motion, t_imu, rng)
    t = begin + np.arange(0.0, seconds, 1.0 / camera_hz)
    if hole_s:
        middle = begin + seconds / 2.0
        t = t[np.abs(t - middle) > hole_s / 2.0]
    R = motion.R_world_imu(t) @ R_imu_cam @ exp_so3(rng.normal(0.0, sigma, (len(t), 3)))
    bad = rng.random(len(t)) < outliers
    R[bad] = R[bad] @ exp_so3(rng.normal(0.0, 0.7, (int(bad.sum()), 3)))
    cpu = time.process_time()
    result = td_icp(t_imu, gyro, t - shift, R, sigma, TdIcpOptions(gyro_density=GYRO, gyro_walk=WALK))
    cpu = time.process_time() - cpu
    limit, limit_rotation = bound(motion, t[~bad], R_imu_cam, sigma)
    turn = log_so3(R_imu_cam.T @ result.R_imu_cam) if result.status != "refused" else np.full(3, np.nan)
    return {
        "captured": float(result.status == "ok" and abs(result.timeshift_cam_imu_s - shift) < 5e-3),
        "error": result.timeshift_cam_imu_s - shift,
        "sigma": result.timeshift_sigma_s,
        "bound": limit,
        "rotation": float(np.linalg.norm(turn)),
        "rotation_bound": limit_rotation,
        "rejected": result.rejected / len(t),
        "cpu": cpu,
    }


def _row(name: str, rows: list[dict[str, float]]) -> str:
    column = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    rmse, limit = np.sqrt(np.nanmean(column["error"] ** 2)), np.sqrt(np.mean(column["bound"] ** 2))
    inside = np.nanmean(np.abs(column["error"]) < 2.0 * column["sigma"])
    turn = np.sqrt(np.nanmean(column["rotation"] ** 2) / 3.0) / DEG
    return (
        f"| {name} | {int(column['captured'].sum())}/{len(rows)} | {1e6 * rmse:.0f} | {1e6 * limit:.0f} | "
        f"{rmse / limit:.2f} | {1e6 * np.nanmean(column['sigma']):.0f} | {100 * inside:.0f} % | {turn:.3f} | "
        f"{100 * np.mean(column['rejected']):.0f} % | {np.mean(column['cpu']):.2f} |"
    )


HEADER = (
    "| case | captured | RMSE us | bound us | ratio | stated sigma us | inside 2 sigma | "
    "R_imu_cam deg/axis | rejected | CPU s |\n|---|---|---|---|---|---|---|---|---|---|"
)


def study_main(trials: int) -> None:
    """Table 3.1: four trajectories, 10 s at 15 Hz, 0.1 deg, delays up to 2 s."""
    print(f"\n### {trials} trials, 10 s, 15 Hz, 0.1 deg, GX3 gyro, true delay within 2 s, any mounting\n")
    print(HEADER)
    everything = []
    for name, make in TRAJECTORIES.items():
        rows = [trial(make(s), s) for s in range(trials)]
        everything += rows
        print(_row(name, rows), flush=True)
    print(_row("all", everything))


def study_robust(trials: int) -> None:
    """Outliers, a hole, short, slow and noisy recordings."""
    print(f"\n### {trials} trials of hand motion at 60 deg/s under stress\n\n{HEADER}")
    cases: dict[str, dict[str, float]] = {
        "30 % outliers and a 1 s hole": {"outliers": 0.3, "hole_s": 1.0},
        "5 s": {"seconds": 5.0},
        "30 Hz": {"camera_hz": 30.0},
        "0.2 deg": {"sigma": 0.2 * DEG},
    }
    for name, changes in cases.items():
        print(_row(name, [trial(hand_motion(s, 60.0), s, **changes) for s in range(trials)]), flush=True)
    print(_row("20 deg/s", [trial(hand_motion(s, 20.0), s) for s in range(trials)]), flush=True)


def _handheld(seed: int, seconds: float) -> tuple[TdIcpResult, float, FloatArray]:
    shift = float(np.random.default_rng([seed, 3]).uniform(-0.3, 0.3))
    run = simulate(seed, seconds, rig=reference_rig(seed, timeshift_cam_imu_s=shift), camera_rate_hz=20.0)
    lens = run.rig.lens
    frames = [PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px) for f in run.frames]
    fit = refine_lens(
        frames, board_points(), np.array(lens.intrinsics), np.array(lens.distortion), lens.model
    )
    poses = target_orientations(frames, board_points(), fit.intrinsics, fit.distortion, lens.model)
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
        "| length s | solved | RMSE us | stated sigma us | inside 2 sigma | R_imu_cam deg/axis |"
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
    print("| pair | RMSE us | stated sigma us | inside 2 sigma |\n|---|---|---|---|")
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
    from vical_daemon.priors import read_initial
    from vical_daemon.recording import open_recording
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
    fit = refine_lens(frames, points, np.array(camera.intrinsics), np.array(camera.distortion))
    poses = target_orientations(frames, points, fit.intrinsics, fit.distortion)
    imu = recording.imu_arrays("imu0")
    base = int(imu.t_ns[0])
    t_imu, t_cam = (imu.t_ns - base) * 1e-9, (poses.t_cam_ns - base) * 1e-9
    options = TdIcpOptions(gyro_density=noise.gyro_density, gyro_walk=noise.gyro_walk)
    print("\n### Real: EuRoC imu_april, windows of 10 s (and the whole)\n")
    print(
        "| from s | mean rate deg/s | delay us | stated sigma us | delay / sigma | status |"
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


def figure_start(path: Path) -> None:
    """Draw what the coarse start sees: disagreement of turn angles over the delay, true delay +1.3 s."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from vical_daemon.estimation.rotation_curves import GyroCurve
    from vical_daemon.estimation.rotation_start import camera_turns, shift_costs
    from vical_daemon.estimation.so3 import quat_from_matrix

    shift, rng, motion = 1.3, np.random.default_rng(1), hand_motion(1, 60.0)
    t_imu = np.arange(0.0, 16.0, 1.0 / IMU_HZ)
    curve = GyroCurve.integrate(t_imu, simulate_gyro(motion, t_imu, rng)[0], np.zeros(3))
    t = np.arange(3.0, 13.0, 1.0 / 15.0)
    figure, axes = plt.subplots(figsize=(7.0, 3.2))
    for outliers, label in ((0.0, "no outliers"), (0.3, "30 % of the orientations wrong")):
        R = motion.R_world_imu(t) @ exp_so3(rng.normal(0.0, 0.1 * DEG, (len(t), 3)))
        bad = rng.random(len(t)) < outliers
        R[bad] = R[bad] @ exp_so3(rng.normal(0.0, 0.7, (int(bad.sum()), 3)))
        turns = camera_turns(t - shift, quat_from_matrix(R))
        delays = np.arange(-4.0, 4.0, 0.01)
        cost = shift_costs(curve, t - shift, turns, delays, 0.25 * float(np.quantile(turns.angle, 0.4)))
        axes.plot(delays, cost, label=label, linewidth=1.0)
    axes.axvline(shift, color="grey", linewidth=0.6)
    axes.set_xlabel("delay tried, s")
    axes.set_ylabel("mean robust disagreement")
    axes.legend()
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(f"wrote {path}")


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks td_icp", description=__doc__)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--study", default="main,robust,handheld,joint,real")
    parser.add_argument("--data", type=Path, default=Path("../shared/data/euroc_imu_april"))
    parser.add_argument("--figure", type=Path, help="only draw the figure of the coarse start there")
    args = parser.parse_args(list(argv))
    if args.figure is not None:
        figure_start(args.figure)
        return 0
    studies = {
        "main": lambda: study_main(args.trials),
        "robust": lambda: study_robust(args.trials),
        "handheld": lambda: study_handheld(max(args.trials // 5, 4)),
        "joint": lambda: study_joint(max(args.trials // 5, 4)),
        "real": lambda: study_real(args.data),
    }
    for name in args.study.split(","):
        if name not in studies:
            print(f"no study {name!r}; there are: {', '.join(studies)}")
            return 2
        studies[name]()
    return 0
