"""Posterior Cramer-Rao bound of the reference cases: what the data can tell at best."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from vical_mocks.cramer_rao.bound import Bound, bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.tracks import simulate_tracks


def describe(bound: Bound) -> str:
    """One Markdown table row: time, time shift, lever arm, mounting, focal length and centre."""
    p = bound.sigma("p_imu_cam") * 1e3
    r = np.rad2deg(bound.sigma("r_imu_cam"))
    shift = f"{bound.sigma('timeshift')[0] * 1e6:.1f}" if "timeshift" in bound.slices else "-"
    lens = "- | -"
    if "intrinsics" in bound.slices:
        f = bound.sigma("intrinsics")
        lens = f"{f[0]:.3f}/{f[1]:.3f} | {f[2]:.3f}/{f[3]:.3f}"
    places = f"{p[0]:.3f}/{p[1]:.3f}/{p[2]:.3f} | {r[0]:.4f}/{r[1]:.4f}/{r[2]:.4f}"
    return f"{bound.t_s:.0f} | {shift} | {places} | {lens}"


def main(argv: list[str]) -> int:
    """Print the bound of the reference cases."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks bound", description=__doc__)
    parser.add_argument(
        "--seeds", type=int, default=3, help="motions per case; their mean variance is printed"
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--case", action="append", help="only these cases")
    args = parser.parse_args(argv)
    times = [t for t in (5.0, 10.0, 20.0, 30.0, 60.0, 120.0) if t <= args.seconds]
    print("| case | t s | time shift us | lever arm mm | mounting deg | f px | c px |")
    print("|---|---|---|---|---|---|---|")
    for name, (make, options) in CASES.items():
        if args.case and name not in args.case:
            continue
        runs = [bounds(make(seed, args.seconds), options, times) for seed in range(args.seeds)]
        for at_time in zip(*runs, strict=True):
            mean = replace(at_time[0], covariance=np.mean([b.covariance for b in at_time], axis=0))
            print(f"| {name} | {describe(mean)} |", flush=True)
    return 0


def _board(seed: int, seconds: float) -> SimulatedRun:
    return simulate(seed, seconds, whole_board_only=True)


def _tracks(seed: int, seconds: float) -> SimulatedRun:
    return simulate_tracks(seed, seconds)


CASES: dict[str, tuple[Callable[[int, float], SimulatedRun], BoundOptions]] = {
    "reference": (_board, BoundOptions(gravity="free")),
    "lens known": (_board, BoundOptions(gravity="free", intrinsics=False, distortion=False)),
    "gravity magnitude known": (_board, BoundOptions(gravity_sigma_mps2=1e-6)),
    "gravity known": (_board, BoundOptions(gravity="known")),
    "0.1 px": (_board, BoundOptions(gravity="free", corner_sigma_px=0.1)),
    "clocks apart": (_board, BoundOptions(gravity="free", drift_prior=1e-4)),
    "stamp jitter 1 ms": (_board, BoundOptions(gravity="free", stamp_jitter_s=1e-3)),
    "target scale 0.1 %": (_board, BoundOptions(gravity="free", target_scale_prior=1e-3)),
    "IMU matrices 1 %, scale 0.2 %": (
        _board,
        BoundOptions(gravity="free", imu_matrix_prior=0.01, target_scale_prior=2e-3),
    ),
    "target-free": (_tracks, BoundOptions(target_free=True, gravity="free")),
    "target-free, lens known": (
        _tracks,
        BoundOptions(target_free=True, gravity="free", intrinsics=False, distortion=False),
    ),
}
