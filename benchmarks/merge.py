"""Ten short recordings of one rig merged, one of them bumped: is it named, how near the bound is the rest?

Each trial: recordings of 5 s with their own motion, biases and lean of the board. The bump turns the camera
by 0.5 deg and moves it by 5 mm in one of them. The result of the others is compared with the Cramér-Rao bound
of those recordings together, and with that of one recording as long as all of them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from vical_mocks.cramer_rao.bound import Bound, bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import Rig, reference_rig
from vical_mocks.rotations import exp_so3

from benchmarks.recordings import SHIFT_S, another, compare
from vical_daemon.config.priors import read_initial
from vical_daemon.logs import open_recording
from vical_daemon.offline.calibration_job import Job, add_recordings, make_job
from vical_daemon.offline.merge import MergeOutcome, merge

BUMP_RAD, BUMP_M = np.deg2rad(0.5), 5e-3
_APART_S = 60.0
_BLOCKS = ("p_imu_cam", "r_imu_cam", "timeshift")


def bumped(rig: Rig, seed: int) -> Rig:
    """The rig with its camera turned and moved, in random directions."""
    rng = np.random.default_rng([seed, 65])
    axis, way = (x / np.linalg.norm(x) for x in rng.standard_normal((2, 3)))
    return replace(
        rig,
        R_imu_cam=rig.R_imu_cam @ exp_so3(BUMP_RAD * axis),
        p_imu_cam=np.asarray(rig.p_imu_cam) + BUMP_M * way,
    )


def job_of(folders: list[Path]) -> Job:
    """The recordings as one job, lens known."""
    first, *others = (open_recording(str(folder)) for folder in folders)
    initial = read_initial(folders[0] / "initial.yaml")
    job = make_job(first, initial, target=str(folders[0] / "target.yaml"), fix=("intrinsics",))
    add_recordings(job, others)
    return job


def bound_of(run: SimulatedRun) -> Bound:
    """The bound at the end of a recording, lens known, as the filter has it."""
    options = BoundOptions(intrinsics=False, distortion=False, corner_sigma_px=run.options.corner_sigma_px)
    return bounds(run, options, [run.duration_s])[-1]


def calibration(bound: Bound) -> np.ndarray:
    """Covariance of lever arm, mounting and time shift, shape (7, 7)."""
    at = np.concatenate([np.arange(bound.covariance.shape[0])[bound.slices[name]] for name in _BLOCKS])
    return bound.covariance[np.ix_(at, at)]


def together(runs: list[SimulatedRun]) -> np.ndarray:
    """Sigmas of the bound of several recordings, shape (7,)."""
    information = sum(np.linalg.inv(calibration(bound_of(run))) for run in runs)
    return np.sqrt(np.diag(np.linalg.inv(information)))


def trial(seed: int, count: int, seconds: float, *, bump: bool) -> str:
    """One row."""
    rigs = [another(seed + 1000 * k, leans=True) for k in range(count)]
    wrong = int(np.random.default_rng([seed, 66]).integers(count)) if bump else -1
    runs = [
        simulate(seed + 1000 * k, seconds, rig=bumped(rig, seed) if k == wrong else rig, corner_sigma_px=0.3)
        for k, rig in enumerate(rigs)
    ]
    begin_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        folders = [write_asl(Path(folder) / f"r{k}", run, _APART_S * k) for k, run in enumerate(runs)]
        merged: MergeOutcome = merge(job_of(folders), lambda *_: None)
    cpu_s = time.process_time() - begin_s
    camera = merged.outcome.estimate.cameras["cam0"]
    chi, sigma = compare(camera, rigs[0])
    best = together([run for k, run in enumerate(runs) if k != wrong])
    long = reference_rig(seed, timeshift_cam_imu_s=SHIFT_S)
    whole = together([simulate(seed, seconds * (count - bump), rig=long, corner_sigma_px=0.3)])
    alone = sum(one.agrees is not None for one in merged.agreements)
    named = (
        "right" if merged.disagreeing == ([wrong] if bump else []) else f"{merged.disagreeing} for {wrong}"
    )
    ratios = [
        " / ".join(f"{np.mean((sigma / s)[part]):.2f}" for part in (slice(0, 3), slice(3, 6), slice(6, 7)))
        for s in (best, whole)
    ]
    status = merged.outcome.estimate.status
    return f"| {seed} | {alone} | {named} | {status} | {chi:.2f} | {ratios[0]} | {ratios[1]} | {cpu_s:.0f} |"


def main(argv: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks merge", description=__doc__)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--count", type=int, default=10, help="recordings a trial")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each recording")
    parser.add_argument("--first-seed", type=int, default=10)
    parser.add_argument("--no-bump", action="store_true", help="all recordings agree: false alarms")
    args = parser.parse_args(argv)
    print(
        "| seed | compared | named | status | NEES/7 | sigmas over the bound of these recordings: "
        "arm / rotation / shift | over the bound of one long recording | CPU s |"
    )
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for seed in range(args.first_seed, args.first_seed + args.trials):
        print(trial(seed, args.count, args.seconds, bump=not args.no_bump), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
