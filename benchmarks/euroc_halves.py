"""The two halves of the real EuRoC recording, calibrated apart: do they agree within their own sigmas?

And how well does the calibration of one explain the corners of the other, which it has not seen?
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from vical_mocks.harness.recordings import Items, read

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.noise.consistency import MODES, modes
from vical_daemon.estimation.result import CameraEstimate, Status
from vical_daemon.vision.target import load_target

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "euroc_imu_april"
NOISE = ImuNoise(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3, 200.0)
LENS = (458.654, 457.296, 367.215, 248.375)
DISTORTION = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
PRIOR = CameraPrior((752, 480), LENS, "radtan", DISTORTION)
SPLIT_S = 35.5
_PART_PX = 24


class Half(NamedTuple):
    """A stretch calibrated: the answer, its images, CPU of each (s), whether it converged."""

    camera: CameraEstimate
    used: list[FrameReport]
    steady_s: list[float]
    converged: bool


def calibrate(
    items: Items, options: CalibrationOptions, points: np.ndarray, prior: CameraPrior = PRIOR
) -> Half:
    """Calibrate a stretch of (stamp, message) in order; its CPU counts from the start on."""
    c = Calibrator(options, {"cam0": prior}, points)
    steady_s: list[float] = []
    used: list[FrameReport] = []
    for _, item in items:
        if isinstance(item, PointsFrame):
            started, before_s = c.filter is not None, time.process_time()
            c.add_points(replace(item, camera="cam0"))
            reports = c.process()
            if started:
                steady_s.append(time.process_time() - before_s)
            used += [r for r in reports if r.used]
        else:
            c.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)
    c.finish()
    estimate = c.estimate()
    return Half(estimate.cameras["cam0"], used, steady_s, estimate.status is Status.CONVERGED)


def rms_px(reports: list[FrameReport]) -> float:
    """RMS of the residuals of a stretch, px an axis."""
    return float(np.sqrt(np.mean(np.concatenate([r.residual_px[r.accepted] for r in reports]) ** 2)))


def noise_px(reports: list[FrameReport]) -> float:
    """Corner noise of a stretch, px an axis: residuals without what a pose could explain in each image."""
    squares = freedom = 0.0
    for r in reports:
        residual, by_pose = r.residual_px[r.accepted].ravel(), modes(r.uv_px[r.accepted])
        left = residual - by_pose @ np.linalg.lstsq(by_pose, residual, rcond=None)[0]
        squares += float(left @ left)
        freedom += len(residual) - MODES
    return float(np.sqrt(squares / freedom))


def where_seen(reports: list[FrameReport], seen: list[FrameReport]) -> list[FrameReport]:
    """Of `reports` the corners in parts of the picture (24 px wide) in which `seen` has corners, too."""
    uv = np.concatenate([r.uv_px[r.accepted] for r in seen])
    known = set(map(tuple, (uv // _PART_PX).astype(int)))
    return [
        replace(r, accepted=r.accepted & [tuple(c) in known for c in (r.uv_px // _PART_PX).astype(int)])
        for r in reports
    ]


def held_back(
    camera: CameraEstimate, other: Items, points: np.ndarray, target_off: bool
) -> list[FrameReport]:
    """Images that had no part in a calibration, with it held fixed.

    Where the calibration was made with a target that differs from its file (`target_off`), so it is here: its
    shape is the target's, not the camera's.
    """
    q = np.roll(camera.T_imu_cam.q_wxyz, -1)
    prior = replace(
        PRIOR,
        distortion_model=camera.distortion_model,
        intrinsics=tuple(camera.intrinsics),
        distortion=tuple(camera.distortion),
        T_imu_cam=(Rotation.from_quat(q).as_matrix(), np.array(camera.T_imu_cam.p_m)),
        timeshift_cam_imu_s=camera.timeshift_cam_imu_s,
    )
    options = CalibrationOptions(
        fix=frozenset({"intrinsics", "timeshift", "extrinsics"}),
        estimate=frozenset({"target_shape"} if target_off else ()),
        imu_noise=NOISE,
    )
    return calibrate(other, options, points, prior).used


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


def ratios(held: tuple[list[FrameReport], ...], own: tuple[Half, ...], by: tuple[Half, ...]) -> str:
    """Residuals of images held back over those of their own half and over its corner noise; (both together).

    And over the noise where the half that was calibrated (`by`) had seen corners: elsewhere its lens is
    extrapolated.
    """
    all_px = [rms_px(h) for h in held]
    seen_px = [rms_px(where_seen(h, x.used)) for h, x in zip(held, by, strict=True)]
    noise = [noise_px(half.used) for half in own]
    there = [noise_px(where_seen(half.used, x.used)) for half, x in zip(own, by, strict=True)]
    columns = [(all_px, [rms_px(half.used) for half in own]), (all_px, noise), (seen_px, there)]
    count = np.array([sum(int(r.accepted.sum()) for r in h) for h in held], dtype=np.float64)
    cells = []
    for seen, stated in columns:
        both = np.sqrt((count @ np.square(seen)) / (count @ np.square(stated)))
        cells.append(f"{', '.join(f'{x:.3f}' for x in np.divide(seen, stated))} ({both:.3f})")
    return " | ".join(cells) + " |"


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
        "| corners of the other half over own | over corner noise | the same, where corners had been seen "
        "| CPU an image once started, ms: mean (median) |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    halves = [[i for i in items if (i[0] < split) == first] for first in (True, False)]
    fixed_lens, free = (
        CalibrationOptions(fix=f, imu_noise=NOISE) for f in (frozenset({"intrinsics"}), frozenset())
    )
    five = replace(PRIOR, distortion_model="plumb_bob", distortion=(*DISTORTION, 0.0))
    for name, options, prior in (
        ("fixed", fixed_lens, PRIOR),
        ("free", free, PRIOR),
        ("free, plumb_bob", free, five),
    ):
        a, b = (calibrate(h, options, points, prior) for h in halves)
        off = name != "fixed"
        held = (
            held_back(b.camera, halves[0], points, off),
            held_back(a.camera, halves[1], points, off),
        )
        cells = [row(name, a.camera, b.camera), ratios(held, (a, b), (b, a))]
        ms = 1e3 * np.array(a.steady_s + b.steady_s)
        print(*cells, f"{np.mean(ms):.1f} ({np.median(ms):.1f}) |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
