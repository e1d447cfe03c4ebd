"""Motions that do not show everything: never `converged`, the right direction named, the rest right."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt
from vical_mocks import trajectory
from vical_mocks.cramer_rao.bound import Bound, bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.harness.feed import (
    PARAMETERS,
    CalibratorSubject,
    Snapshot,
    StartErrors,
    camera_prior,
    feed,
    imu_noise,
)
from vical_mocks.points import simulate
from vical_mocks.rig import NOMINAL_P_IMU_CAM, NOMINAL_R_IMU_CAM, reference_rig
from vical_mocks.tracks import simulate_tracks
from vical_mocks.trajectory import Trajectory

from benchmarks import runner
from benchmarks.montecarlo import bound_sigmas
from vical_daemon.estimation.measurements import CalibrationOptions

_MOUNT = (NOMINAL_R_IMU_CAM, NOMINAL_P_IMU_CAM)
MOTIONS: dict[str, Callable[[int], Trajectory]] = {
    "still": lambda _: trajectory.still(T_imu_cam=_MOUNT),
    "pure translation": lambda seed: trajectory.pure_translation(seed, T_imu_cam=_MOUNT),
    "one axis (camera x)": lambda seed: trajectory.one_axis(seed, [1, 0, 0], T_imu_cam=_MOUNT),
    "one axis (optical)": lambda seed: trajectory.one_axis(seed, [0, 0, 1], T_imu_cam=_MOUNT),
    "constant rate": lambda _: trajectory.constant_rate(T_imu_cam=_MOUNT),
    "fronto-parallel": lambda seed: trajectory.fronto_parallel(seed, T_imu_cam=_MOUNT),
    "planar": lambda seed: trajectory.planar(seed, T_imu_cam=_MOUNT),
    "about one point": lambda seed: trajectory.about_a_point(seed, T_imu_cam=_MOUNT),
    "slow 1 deg/s": lambda seed: trajectory.hand_motion(seed, 1.0, T_imu_cam=_MOUNT),
    "hand (control)": lambda seed: trajectory.hand_motion(seed, T_imu_cam=_MOUNT),
}
# With its prior only (StartErrors) a parameter or direction is called lost by the bound above these sigmas.
_LOST = np.array([5e-3] * 3 + [np.deg2rad(0.3)] * 3 + [1e-3])


def trial(
    motion: str, lens_known: bool, given: bool, target_free: bool, seconds: float, seed: int
) -> runner.Result:
    """One recording of a degenerate motion; `given`: mounting and shift are given roughly."""
    rig = reference_rig(seed, timeshift_cam_imu_s=0.02, trajectory=MOTIONS[motion](seed))
    run = (simulate_tracks if target_free else simulate)(seed, seconds, rig=rig)
    start = (
        StartErrors(extrinsics=(float(np.deg2rad(3.0)), 0.03), timeshift_s=0.005) if given else StartErrors()
    )
    prior = camera_prior(run, seed, start, exact_lens=lens_known)
    fix = frozenset({"intrinsics"}) if lens_known else frozenset[str]()
    options = CalibrationOptions(fix=fix, imu_noise=imu_noise(run), target_free=target_free)
    record = feed(run, CalibratorSubject(options, prior, None if target_free else run.points_m))
    free = not lens_known
    limit: Bound = bounds(run, BoundOptions(intrinsics=free, distortion=free, target_free=target_free))[0]
    lost = [name for name, s, most in zip(PARAMETERS, bound_sigmas(limit), _LOST, strict=False) if s > most]
    last = record.snapshots[-1] if record.snapshots else None
    return {
        "ever_converged": any(status == "converged" for _, status, _ in record.statuses),
        "statuses": record.statuses,
        "reason": record.statuses[-1][2] if record.statuses else "",
        "unobservable": record.unobservable,
        "guidance": record.guidance,
        "lost_by_bound": lost,
        "z_shown": None
        if last is None
        else z_shown(limit.block("p_imu_cam", "r_imu_cam", "timeshift"), last),
        "sigma": None if last is None else np.sqrt(np.diag(last.covariance))[:7],
        "events": record.event_documents,
    }


def z_shown(limit: npt.NDArray[np.float64], last: Snapshot) -> list[float]:
    """Errors over their reported sigmas along every direction that the bound says is known.

    Args:
        limit: The bound's covariance of lever arm, mounting and time shift, shape (7, 7).
        last: What the estimator says.
    """
    found = []
    for rows in (slice(0, 3), slice(3, 6), slice(6, 7)):
        values, axes = np.linalg.eigh(limit[rows, rows])
        for axis in axes[:, values < _LOST[rows][0] ** 2].T:
            sigma = np.sqrt(axis @ last.covariance[rows, rows] @ axis)
            found.append(float(axis @ last.error[rows] / sigma))
    return found


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks degenerate", description=__doc__)
    runner.add_arguments(parser, trials=3, seconds=40.0)
    parser.add_argument("--lens-known", action="store_true")
    parser.add_argument("--given", action="store_true", help="mounting and shift are given roughly")
    parser.add_argument("--target-free", action="store_true", help="unknown landmarks instead of a board")
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon/estimation", "benchmarks/degenerate.py", "mocks/vical_mocks")
    print(
        "| motion | ever converged | last status | lost by the bound | withheld | largest z of the rest "
        "| reason |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in args.case or MOTIONS:
        slug = runner.slug(name)
        kind = f"{'known' if args.lens_known else 'unknown'}_{'given' if args.given else 'nothing'}"
        kind += "_free" if args.target_free else ""
        results = runner.run_trials(
            f"degenerate_{slug}_{kind}_{args.seconds:g}s",
            partial(trial, name, args.lens_known, args.given, args.target_free, args.seconds),
            runner.seeds_of(args),
            args,
            code,
        )
        print(_row(name, results), flush=True)
    return 0


def _row(name: str, results: list[runner.Result]) -> str:
    converged = sum(r["ever_converged"] for r in results)
    first = results[0]
    status = ", ".join(sorted({r["statuses"][-1][1] for r in results if r["statuses"]}))
    shown = [abs(z) for r in results for z in r["z_shown"] or ()]
    answered = sum(r["z_shown"] is not None for r in results)
    rest = f"{max(shown):.1f} ({answered} of {len(results)} answered)" if shown else "no numbers"
    return (
        f"| {name} | {converged}/{len(results)} | {status} | {' '.join(first['lost_by_bound']) or '-'} "
        f"| {'; '.join(first['unobservable']) or '-'} | {rest} | {first['reason']} |"
    )
