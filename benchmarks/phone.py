"""A tablet held upright, without a board: the whole recording, its halves, and stretches of it.

The recording is `iphone_tracks`, in truth of an iPad. Each stretch is calibrated alone, with nothing known
but the lens of the file of start values. "z": differences of fx fy cx cy from what is known, over the stated
sigmas.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from vical_mocks.harness.recordings import Items, camera_of, feed, read

from benchmarks.euroc_halves import row
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.result import CameraEstimate
from vical_daemon.estimation.target_free import TargetFreeCalibrator

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "real" / "iphone_tracks"
KNOWN_LENS = np.array([567.0, 567.0, 240.0, 320.0])  # published f, centre of the picture
KNOWN_R = np.diag([1.0, -1.0, -1.0])  # axes of device and camera, to some degrees
HALF_S = 18.4


def calibrate(items: Items, prior: CameraPrior, begin_s: float, end_s: float) -> CameraEstimate | str:
    """The camera by a stretch of the recording, or why there is no answer."""
    calibrator = TargetFreeCalibrator(CalibrationOptions(target_free=True), {"cam0": prior})
    feed(calibrator, items, begin_s, end_s)
    calibrator.finish()
    estimate = calibrator.estimate()
    return estimate.cameras.get("cam0", estimate.reason)


def z_of_lens(c: CameraEstimate) -> npt.NDArray[np.float64]:
    """Of fx fy cx cy from what is known, shape (4,)."""
    return np.asarray((np.array(c.intrinsics) - KNOWN_LENS) / np.array(c.intrinsics_sigma))


def line(name: str, c: CameraEstimate | str) -> str:
    """One row of the table."""
    if isinstance(c, str):
        return f"| {name} | - | | | | {c[:70]} |"
    sigma = np.sqrt(np.diag(c.T_imu_cam.covariance))
    turn = so3.log(KNOWN_R.T @ so3.matrix_from_quat(np.array(c.T_imu_cam.q_wxyz)))
    cells = [
        f"{c.intrinsics[0]:.0f} ± {c.intrinsics_sigma[0]:.0f}",
        " ".join(f"{z:.1f}" for z in z_of_lens(c)),
        _with_sigma(1e3 * np.array(c.T_imu_cam.p_m), 1e3 * sigma[:3], 0),
        _with_sigma(np.rad2deg(turn), np.rad2deg(sigma[3:]), 1),
        f"{1e3 * c.timeshift_cam_imu_s:.1f} ± {1e3 * c.timeshift_sigma_s:.1f}",
    ]
    return f"| {name} | {' | '.join(cells)} |"


def _with_sigma(x: npt.NDArray[np.float64], sigma: npt.NDArray[np.float64], digits: int) -> str:
    values = (", ".join(f"{v:.{digits}f}" for v in part) for part in (x, sigma))
    return " ± ".join(f"({v})" for v in values)


def main(argv: list[str]) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks phone", description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--seconds", type=float, default=12.0, help="of the stretches, from every 2 s on")
    args = parser.parse_args(argv)
    if not args.folder.is_dir():
        print(f"no recording at {args.folder}: name it with --folder", file=sys.stderr)
        return 1
    items, given = read(args.folder), camera_of(args.folder / "initial.yaml")
    prior = CameraPrior(tuple(given["resolution"]), tuple(given["intrinsics"]), "radtan", (0.0,) * 4)
    print("| stretch s | fx px | z of the lens | lever arm mm | mounting off deg | time shift ms |")
    print("|---|---|---|---|---|---|")
    last_s = (items[-1][0] - items[0][0]) * 1e-9
    print(line("all", calibrate(items, prior, 0.0, last_s)), flush=True)
    halves = [calibrate(items, prior, *part) for part in ((0.0, HALF_S), (HALF_S, last_s))]
    for name, half in zip(("first half", "second half"), halves, strict=True):
        print(line(name, half), flush=True)
    found = []
    begins = np.arange(0.0, last_s - args.seconds, 2.0)
    for begin_s in begins:
        c = calibrate(items, prior, begin_s, begin_s + args.seconds)
        print(line(f"{begin_s:g} to {begin_s + args.seconds:g}", c), flush=True)
        found += [] if isinstance(c, str) else [z_of_lens(c)]
    z = np.array(found)
    print(f"\nstretches with an answer: {len(z)} of {len(begins)}", end="")
    if len(z):
        each = ", ".join(f"{x:.1f}" for x in np.sqrt((z**2).mean(axis=0)))
        print(f"; z of fx fy cx cy: RMS {each}, largest {np.abs(z).max():.1f}")
    if not any(isinstance(h, str) for h in halves):
        print("\n| | lever arm mm | rotation deg | time shift us | largest z | z of lens / distortion |")
        print("|---|---|---|---|---|---|")
        print(row("halves", *(h for h in halves if isinstance(h, CameraEstimate))))
    return 0
