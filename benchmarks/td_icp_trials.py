"""Simulated trials of temporal calibration and their bound, for the studies of `benchmarks td_icp`.

Truth and noise come from `vical_mocks`, the bound from this file: the dense covariance of all orientations
together, inverted as it stands (the estimator never forms it).
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from vical_mocks.rotations import exp_so3, log_so3
from vical_mocks.trajectory import Trajectory, hand_motion

from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions

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


def row_of(name: str, rows: list[dict[str, float]]) -> str:
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
    "| case | captured | RMSE us | bound us | ratio | reported sigma us | inside 2 sigma | "
    "R_imu_cam deg/axis | rejected | CPU s |\n|---|---|---|---|---|---|---|---|---|---|"
)
