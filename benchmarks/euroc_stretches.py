"""Short stretches of the real EuRoC recording against the whole of it: are their sigmas true?

python -m benchmarks euroc_stretches [--seconds 16] [--every 1 4 10]

Stretches begun every 5 s are calibrated on their own, with all images and with each K-th alone, as of a
slower camera. Differences from the answer of the whole are divided by the stretch's own sigmas.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.euroc_halves import FOLDER, NOISE, PRIOR, Items, calibrate, read
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, FloatArray, PointsFrame
from vical_daemon.estimation.result import CameraEstimate
from vical_daemon.vision.target import load_target

BEGINS_S = range(0, 60, 5)
LENSES = {
    "radtan": PRIOR,
    "plumb_bob": replace(PRIOR, distortion_model="plumb_bob", distortion=(*PRIOR.distortion, 0.0)),
}


def stretch(items: Items, begin_s: float, seconds: float, every: int) -> Items:
    """Cut a stretch out, with each `every`-th image alone."""
    begin_ns = items[0][0] + round(begin_s * 1e9)
    part = [x for x in items if begin_ns <= x[0] < begin_ns + round(seconds * 1e9)]
    kept = {t for k, t in enumerate(t for t, item in part if isinstance(item, PointsFrame)) if k % every == 0}
    return [x for x in part if not isinstance(x[1], PointsFrame) or x[0] in kept]


def errors(part: CameraEstimate, whole: CameraEstimate) -> FloatArray:
    """Differences of lever arm, mounting, time shift and lens over the sigmas of the part."""
    a, b = part.T_imu_cam, whole.T_imu_cam
    turn = Rotation.from_quat(b.q_wxyz, scalar_first=True).inv() * Rotation.from_quat(
        a.q_wxyz, scalar_first=True
    )
    pose = np.concatenate([np.subtract(a.p_m, b.p_m), turn.as_rotvec()]) / np.sqrt(np.diag(a.covariance))
    late = (part.timeshift_cam_imu_s - whole.timeshift_cam_imu_s) / part.timeshift_sigma_s
    lens = np.subtract(part.intrinsics, whole.intrinsics) / np.asarray(part.intrinsics_sigma)
    return np.concatenate([pose, [late], lens])


def row(lens: str, prior: CameraPrior, every: int, items: Items, points: FloatArray, seconds: float) -> str:
    """A row of the table."""
    options = CalibrationOptions(imu_noise=NOISE)
    whole = calibrate(items, options, points, prior).camera
    squares, worst, converged = [], [], []
    for begin_s in BEGINS_S:
        try:
            part = calibrate(stretch(items, begin_s, seconds, every), options, points, prior)
        except KeyError:  # no answer from so short a stretch
            continue
        z = errors(part.camera, whole)
        squares.append(float(z @ z) / len(z))
        worst.append(float(np.abs(z).max()))
        converged.append(part.converged)
    late = [w for w, sure in zip(worst, converged, strict=True) if sure]
    of_converged = f"{np.median(late):.1f}, {max(late):.1f}" if late else "-"
    return (
        f"| {lens} | {20 / every:g} | {np.mean(squares):.1f} ({np.median(squares):.1f}) "
        f"| {np.median(worst):.1f}, {max(worst):.1f} | {len(worst)} | {sum(converged)} | {of_converged} |"
    )


def main(argv: list[str]) -> int:
    """Print a row for each lens and rate."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks euroc_stretches", description=__doc__)
    parser.add_argument("--seconds", type=float, default=16.0, help="of a stretch (default: 16)")
    parser.add_argument(
        "--every", type=int, nargs="+", default=[1, 4, 10], metavar="K", help="each K-th image"
    )
    args = parser.parse_args(argv)
    items, points = read(FOLDER), load_target(FOLDER / "target.yaml").points_m
    print(
        "| lens | images a second | mean z^2 (median) | largest z: median, largest | answered | converged "
        "| of these |\n"
        "|---|---|---|---|---|---|---|"
    )
    for lens, prior in LENSES.items():
        for every in args.every:
            print(row(lens, prior, every, items, points, args.seconds), flush=True)
    return 0
