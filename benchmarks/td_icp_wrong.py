"""Temporal calibration when something is wrong."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from vical_mocks.rotations import exp_so3
from vical_mocks.trajectory import hand_motion

from benchmarks.td_icp_trials import DEG, GYRO, IMU_HZ, WALK, simulate_gyro
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions

FloatArray = npt.NDArray[np.float64]

# What is done to a recording, and the words that a refusal must hold; empty: it must be solved.
WRONG = {
    "camera 0.75 s early": "",
    "camera 0.75 s late": "",
    "gyro in deg/s": "degrees per second",
    "gyro divided by 57.3": "divided",
    "camera stamps stretched 5 %": "stamps",
    "camera stamps shrunk 5 %": "stamps",
    "camera stamps stretched 1 %": "stamps",
    "imu stamps stretched 5 %": "stamps",
    "one gyro axis reversed": "mirrored",
    "two gyro axes swapped": "mirrored",
    "orientations inverted": "inverted",
    "another recording": "no delay|direction|only",
}


def _recording(seed: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    rng, motion = np.random.default_rng([seed, 21]), hand_motion(seed, 60.0)
    t_imu = np.arange(3.0, 17.0, 1.0 / IMU_HZ)
    gyro, _ = simulate_gyro(motion, t_imu, rng)
    t = np.arange(5.0, 15.0, 1.0 / 15.0)
    R = motion.R_world_imu(t) @ exp_so3(rng.normal(0.0, 1.5, 3))
    return t_imu, gyro, t, R @ exp_so3(rng.normal(0.0, 0.1 * DEG, (len(t), 3)))


def _spoiled(seed: int, what: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    t_imu, gyro, t, R = _recording(seed)
    stretch = {"stretched 5 %": 1.05, "shrunk 5 %": 0.95, "stretched 1 %": 1.01}
    factor = next((f for words, f in stretch.items() if what.endswith(words)), 1.0)
    if what.startswith("imu"):
        t_imu = t_imu[0] + factor * (t_imu - t_imu[0])
    else:
        t = t[0] + factor * (t - t[0])
    t = t + {"camera 0.75 s early": -0.75, "camera 0.75 s late": 0.75}.get(what, 0.0)
    gyro = gyro * {"gyro in deg/s": 1.0 / DEG, "gyro divided by 57.3": DEG}.get(what, 1.0)
    if what == "one gyro axis reversed":
        gyro = gyro * np.array([1.0, -1.0, 1.0])
    elif what == "two gyro axes swapped":
        gyro = gyro[:, [0, 2, 1]]
    elif what == "orientations inverted":
        R = np.swapaxes(R, 1, 2)
    elif what == "another recording":
        R = _recording(seed + 10_000)[3]
    return t_imu, gyro, t, R


def study_wrong(trials: int) -> None:
    """Input that must be refused with the right reason, or solved all the same."""
    print(f"\n### {trials} recordings of 10 s, hand motion at 60 deg/s, with something wrong\n")
    print("| what is wrong | expected | solved | refused | with the right reason | slowest CPU s |")
    print("|---|---|---|---|---|---|")
    options = TdIcpOptions(gyro_density=GYRO, gyro_walk=WALK)
    for what, words in WRONG.items():
        solved = refused = named = 0
        slowest = 0.0
        for seed in range(trials):
            data = _spoiled(seed, what)
            cpu = time.process_time()
            result = td_icp(*data, 0.1 * DEG, options)
            slowest = max(slowest, time.process_time() - cpu)
            truth = -float(what.endswith("late")) * 0.75 + float(what.endswith("early")) * 0.75
            close = abs(result.timeshift_cam_imu_s - truth) < 4.0 * result.timeshift_sigma_s
            solved += result.status == "ok" and close
            refused += result.status == "refused"
            named += result.status == "refused" and any(w in result.reason for w in words.split("|"))
        expected = f"`{words.split('|')[0]}`" if words else "solved"
        right = f"{named}" if words else ""
        print(f"| {what} | {expected} | {solved} | {refused} | {right} | {slowest:.2f} |", flush=True)
