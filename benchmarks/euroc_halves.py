"""The two halves of the real EuRoC recording, calibrated apart: do they agree within their own sigmas?"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.result import CameraEstimate
from vical_daemon.messages import decode_imu, decode_points
from vical_daemon.recording import open_recording
from vical_daemon.vision.target import load_target

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "euroc_imu_april"
NOISE = ImuNoise(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3, 200.0)
LENS = (458.654, 457.296, 367.215, 248.375)
DISTORTION = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
SPLIT_S = 35.5


def calibrate(
    items: list[tuple[int, object]],
    fix: frozenset[str],
    points: np.ndarray,
    steady_s: list[float] | None = None,
) -> CameraEstimate:
    """Calibrate a stretch of (stamp, message) in order; `steady_s`: CPU of each image after the start."""
    prior = CameraPrior((752, 480), LENS, "radtan", DISTORTION)
    c = Calibrator(CalibrationOptions(fix=fix, imu_noise=NOISE), {"cam0": prior}, points)
    for _, item in items:
        if isinstance(item, PointsFrame):
            started, before_s = c.filter is not None, time.process_time()
            c.add_points(replace(item, camera="cam0"))
            c.process()
            if started and steady_s is not None:
                steady_s.append(time.process_time() - before_s)
        else:
            c.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)
    c.finish()
    return c.estimate().cameras["cam0"]


def read(folder: Path) -> list[tuple[int, object]]:
    """All messages by stamp; inertial ones first where stamps are equal."""
    items: list[tuple[int, int, object]] = []
    for key, payload in open_recording(folder).messages():
        if "/imu/" in key:
            imu = decode_imu(payload)
            items.append((imu.stamp_ns, 0, imu))
        elif key.endswith(("/points", "/tracks")):
            frame = decode_points(payload).to_frame()
            items.append((frame.t_cam_ns, 1, frame))
    items.sort(key=lambda item: item[:2])
    return [(t, item) for t, _, item in items]


def row(name: str, a: CameraEstimate, b: CameraEstimate) -> str:
    """Differences and the largest of them over its joint sigma."""
    turn = (
        Rotation.from_quat(np.roll(a.T_imu_cam.q_wxyz, -1)).inv()
        * Rotation.from_quat(np.roll(b.T_imu_cam.q_wxyz, -1))
    ).as_rotvec()
    d = np.concatenate([np.subtract(b.T_imu_cam.p_m, a.T_imu_cam.p_m), turn])
    sigma = np.sqrt(np.diag(a.T_imu_cam.covariance) + np.diag(b.T_imu_cam.covariance))
    shift = b.timeshift_cam_imu_s - a.timeshift_cam_imu_s
    z = [*np.abs(d / sigma), abs(shift) / np.hypot(a.timeshift_sigma_s, b.timeshift_sigma_s)]
    lens = "-"
    if any(a.intrinsics_sigma):
        both = np.hypot(
            [*a.intrinsics_sigma, *a.distortion_sigma], [*b.intrinsics_sigma, *b.distortion_sigma]
        )
        change = np.abs(np.subtract([*b.intrinsics, *b.distortion], [*a.intrinsics, *a.distortion])) / both
        lens = f"{change[:4].max():.1f} / {change[4:].max():.1f}"
    arm_mm, turn_deg = 1e3 * np.linalg.norm(d[:3]), np.rad2deg(np.linalg.norm(turn))
    return f"| {name} | {arm_mm:.2f} | {turn_deg:.3f} | {1e6 * abs(shift):.0f} | {max(z):.1f} | {lens} |"


def main(argv: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks euroc_halves", description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    args = parser.parse_args(argv)
    if not args.folder.is_dir():
        print(f"no recording at {args.folder}: name it with --folder", file=sys.stderr)
        return 1
    items, points = read(args.folder), load_target(args.folder / "target.yaml").points_m
    split = items[0][0] + int(SPLIT_S * 1e9)
    print(
        "| lens | lever arm mm | rotation deg | time shift us | largest z | z of lens / distortion "
        "| CPU an image once started, ms: mean (median) |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, fix in (("fixed", frozenset({"intrinsics"})), ("free", frozenset())):
        halves = [[i for i in items if (i[0] < split) == first] for first in (True, False)]
        steady_s: list[float] = []
        cells = row(name, *(calibrate(h, fix, points, steady_s) for h in halves))
        print(f"{cells} {1e3 * np.mean(steady_s):.1f} ({1e3 * np.median(steady_s):.1f}) |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
