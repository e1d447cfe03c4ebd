"""Gaps, frozen sensors and clocks that are set, in EuRoC's real recording: what is reported, what moves?

python -m benchmarks gaps_euroc                  with the board, lens known
python -m benchmarks gaps_euroc --target-free    its corners as unknown points
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.euroc_halves import FOLDER, NOISE, PRIOR, Items, read
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, PointsFrame
from vical_daemon.estimation.result import CameraEstimate, Status
from vical_daemon.estimation.target_free import TargetFreeCalibrator
from vical_daemon.vision.target import load_target

_LOOK_S = 0.2
Change = Callable[[Items], Items]


class Followed(NamedTuple):
    """One run: the answer, events (s, kind) and status (s, status) as time went by."""

    camera: CameraEstimate
    events: list[tuple[float, str]]
    statuses: list[tuple[float, Status]]


def cut(sensors: str, at_s: float, seconds: float, items: Items) -> Items:
    """Without the data of one sensor, or both, for some seconds of the recording."""
    return [(t, x) for t, x in items if not (_of(x) in sensors and _within(items, t, at_s, seconds))]


def freeze(sensor: str, at_s: float, seconds: float, items: Items) -> Items:
    """The last reading, or image, again and again under new stamps."""
    last: Any = None
    out: Items = []
    for t, x in items:
        if _of(x) == sensor and not (last is not None and _within(items, t, at_s, seconds)):
            last = x
        out.append((t, _at(last, t) if _of(x) == sensor else x))
    return out


def step(sensor: str, at_s: float, by_s: float, items: Items) -> Items:
    """Other stamps from some second on, in the true order of arrival."""
    by_ns = round(by_s * 1e9)
    return [
        (t, _at(x, t + by_ns)) if _of(x) == sensor and _within(items, t, at_s, np.inf) else (t, x)
        for t, x in items
    ]


def _of(item: object) -> str:
    return "camera" if isinstance(item, PointsFrame) else "imu"


def _within(items: Items, t_ns: int, at_s: float, seconds: float) -> bool:
    return at_s <= (t_ns - items[0][0]) * 1e-9 < at_s + seconds


def _at(item: Any, t_ns: int) -> Any:
    """An item under another stamp."""
    return replace(item, t_cam_ns=t_ns) if isinstance(item, PointsFrame) else item._replace(stamp_ns=t_ns)


CASES: dict[str, tuple[float, Change]] = {
    **{
        f"both {seconds:g} s at {at_s:g} s": (at_s + seconds, partial(cut, "camera imu", at_s, seconds))
        for at_s in (40.0, 45.0, 50.0)
        for seconds in (0.1, 1.0, 5.0)
    },
    **{f"imu {s:g} s at 45 s": (45.0 + s, partial(cut, "imu", 45.0, s)) for s in (2.0, 5.0)},
    "imu frozen 1 s": (46.0, partial(freeze, "imu", 45.0, 1.0)),
    "camera frozen 3 s": (48.0, partial(freeze, "camera", 45.0, 3.0)),
    **{
        f"{sensor} clock {by_s:+g} s": (45.0, partial(step, sensor, 45.0, by_s))
        for sensor in ("imu", "camera")
        for by_s in (0.02, 0.5, 3600.0)
    },
}


def follow(items: Items, *, target_free: bool, folder: Path) -> Followed:
    """Feed a recording in its order of arrival and look five times a second."""
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), target_free=target_free, imu_noise=NOISE)
    c: Any
    if target_free:
        c = TargetFreeCalibrator(options, {"cam0": PRIOR})
    else:
        c = Calibrator(options, {"cam0": PRIOR}, load_target(folder / "target.yaml").points_m)
    events: list[tuple[float, str]] = []
    statuses: list[tuple[float, Status]] = []
    next_s = 0.0
    for t_ns, item in items:
        if isinstance(item, PointsFrame):
            c.add_points(replace(item, camera="cam0"))
            c.process()
        else:
            c.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)  # type: ignore[attr-defined]
        t_s = (t_ns - items[0][0]) * 1e-9
        if t_s >= next_s:
            next_s += _LOOK_S
            estimate = c.estimate()
            events += [(t_s, str(event.kind)) for event in estimate.events]
            statuses.append((t_s, estimate.status))
    c.finish()
    estimate = c.estimate()
    events += [(t_s, str(event.kind)) for event in estimate.events]
    return Followed(estimate.cameras["cam0"], events, statuses)


def row(case: str, over_s: float, followed: Followed, plain: Followed) -> str:
    """One line: events that the undisturbed run has not, when converged again, what has moved."""
    usual = {kind for _, kind in plain.events}
    events = ", ".join(kind for _, kind in followed.events if kind not in usual) or "nothing"
    late = [t for t, status in followed.statuses if t > over_s and status is not Status.CONVERGED]
    back_s = max(late) + _LOOK_S - over_s if late else 0.0
    arm_m = np.subtract(followed.camera.T_imu_cam.p_m, plain.camera.T_imu_cam.p_m)
    moved_ms = 1e3 * (followed.camera.timeshift_cam_imu_s - plain.camera.timeshift_cam_imu_s)
    sigma_m = np.sqrt(np.trace(np.array(plain.camera.T_imu_cam.covariance)[:3, :3]))
    return (
        f"| {case} | {events} | {back_s:.1f} | {1e3 * np.linalg.norm(arm_m):.2f} ({1e3 * sigma_m:.2f}) "
        f"| {moved_ms:+.3f} |"
    )


def main(argv: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks gaps_euroc", description=__doc__)
    parser.add_argument("--data", type=Path, default=FOLDER, help="folder euroc_imu_april")
    parser.add_argument("--target-free", action="store_true")
    parser.add_argument("--case", action="append", choices=list(CASES), help="only this one; may be repeated")
    args = parser.parse_args(argv)
    if not args.data.is_dir():
        print(f"no recording at {args.data}: name the folder with --data", file=sys.stderr)
        return 1
    items = read(args.data)
    plain = follow(items, target_free=args.target_free, folder=args.data)
    print("| disturbance | also reported | converged again after s | lever arm moved mm (sigma) | shift ms |")
    print("|---|---|---|---|---|")
    for case in args.case or CASES:
        over_s, change = CASES[case]
        followed = follow(change(items), target_free=args.target_free, folder=args.data)
        print(row(case, over_s, followed, plain), flush=True)
    return 0
