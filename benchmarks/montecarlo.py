"""Monte Carlo: RMSE and the Cramer-Rao bound, NEES, coverage, time; also of a plain EKF."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from vical_mocks.cramer_rao.bound import Bound, bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.harness.feed import (
    CalibratorSubject,
    Record,
    StartErrors,
    Subject,
    assumed_gravity_mps2,
    camera_prior,
    feed,
    imu_noise,
    nees,
)
from vical_mocks.points import SimulatedRun, board_points, crooked_board, simulate
from vical_mocks.rig import STANDARD_GRAVITY_MPS2, reference_rig
from vical_mocks.tracks import simulate_tracks

from benchmarks import runner, scores
from benchmarks.ekf import EkfSubject
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior

TIMES_S = (10.0, 30.0, 60.0)
_OFF_FOCAL, _OFF_CENTRE_PX, _OFF_K1 = 0.005, 5.0, 0.01  # one sigma of a lens that is off
_PLACES = (
    ("p_imu_cam", slice(0, 3)),
    ("r_imu_cam", slice(3, 6)),
    ("timeshift", slice(6, 7)),
    ("intrinsics", slice(7, 11)),
    ("distortion", slice(11, 15)),
)


@dataclass(frozen=True)
class Case:
    """One row of a study.

    Attributes:
        lens_known: The lens is given exactly and held fixed.
        start: Errors of the starting values.
        timeshift_s: True time shift; None: uniform in +-50 ms, by seed.
        skew_ppm: Drift of the camera's clock.
        gravity_error_mps2: Of the magnitude that the estimator assumes; None: drawn from its prior.
        target_free: Landmarks instead of a board.
        random_mounting: The camera points anywhere on the imu, 20 cm away.
        trials: How many by default.
        simulation: Options of the simulation.
        rig: Changes of the rig.
        bound: Changes of the bound's model.
        estimate: Optional blocks of the estimator.
        readout_known: The readout of a rolling shutter is given.
        crooked: The board differs from its file: see `vical_mocks.points.crooked_board`.
        board_size: True size of the board over its stated size.
        lens_off: The lens is held (`lens_known`) at values that are off by 0.5 % of f, 5 px of the centre,
            0.01 of k1, one sigma each; "stated": and the estimator is given these sigmas.
        imu_off: One sigma of each entry of the imu's matrices, of which the gyro's is symmetric (what is not
            is a turn of the imu's frame).
    """

    lens_known: bool = False
    start: StartErrors = field(default_factory=StartErrors)
    timeshift_s: float | None = None
    skew_ppm: float = 0.0
    gravity_error_mps2: float | None = None
    target_free: bool = False
    random_mounting: bool = False
    trials: int = 100
    simulation: dict[str, Any] = field(default_factory=dict)
    rig: dict[str, Any] = field(default_factory=dict)
    bound: dict[str, Any] = field(default_factory=dict)
    estimate: frozenset[str] = frozenset()
    readout_known: bool = True
    crooked: bool = False
    board_size: float = 1.0
    lens_off: str = ""
    imu_off: float = 0.0

    @property
    def dof(self) -> int:
        """Size of the calibration block."""
        return 7 if self.lens_known else 15


_FAR = StartErrors(0.05, 10.0, (float(np.deg2rad(10.0)), 0.10), 0.05)
CASES: dict[str, Case] = {
    "reference, lens known": Case(lens_known=True),
    "reference": Case(),
    "full self-calibration (lens 10 %)": Case(start=StartErrors(0.10, 15.0)),
    "given 10 deg 100 mm 50 ms off": Case(start=_FAR),
    "shift +200 ms": Case(timeshift_s=0.2, trials=20),
    "shift -200 ms": Case(timeshift_s=-0.2, trials=20),
    "given 20 deg 200 mm 200 ms off": Case(
        start=StartErrors(0.05, 10.0, (float(np.deg2rad(20.0)), 0.20), 0.2), trials=50
    ),
    "any mounting, nothing given": Case(start=StartErrors(0.05, 10.0), random_mounting=True, trials=50),
    "0.1 px": Case(simulation={"corner_sigma_px": 0.1}, trials=20),
    "5 % outliers, 30 % half-hidden": Case(
        simulation={"outlier_fraction": 0.05, "hidden_fraction": 0.3}, trials=20
    ),
    "gravity stated 0.02 m/s^2 wrong": Case(gravity_error_mps2=0.02, trials=20),
    "skew 100 ppm": Case(skew_ppm=100.0, trials=20),
    "stamp jitter 1 ms": Case(simulation={"stamp_jitter_s": 1e-3}, trials=20),
    "whole images off by 0.3 px": Case(simulation={"frame_sigma_px": 0.3}, trials=20),
    "rolling shutter of 20 ms, nothing said": Case(
        rig={"readout_s": 0.02}, bound={"readout": True}, readout_known=False, trials=20
    ),
    "board 3 % smaller than stated": Case(board_size=0.97, bound={"target_scale_prior": 0.1}, trials=20),
    "board 30 % larger than stated": Case(board_size=1.3, bound={"target_scale_prior": 0.1}, trials=20),
    "crooked board": Case(crooked=True, trials=20),
    "crooked board, its shape found": Case(crooked=True, estimate=frozenset({"target_shape"}), trials=20),
    "crooked board, lens known": Case(crooked=True, lens_known=True, trials=20),
    "crooked board, lens known, its shape found": Case(
        crooked=True, lens_known=True, estimate=frozenset({"target_shape"}), trials=20
    ),
    "imu 0.1 % off": Case(imu_off=1e-3, bound={"imu_matrix_prior": 1e-3}, trials=20),
    "imu 0.3 % off": Case(imu_off=3e-3, bound={"imu_matrix_prior": 3e-3}, trials=20),
    "imu 1 % off": Case(imu_off=1e-2, bound={"imu_matrix_prior": 1e-2}, trials=20),
    "accelerometer 0.3 ms late": Case(lens_known=True, simulation={"accel_lag_s": 3e-4}, trials=20),
    "imu averages over 15 ms": Case(lens_known=True, simulation={"imu_average_s": 0.015}, trials=20),
    "imu averages over 2 ms": Case(
        lens_known=True, simulation={"imu_average_s": 0.002, "imu_rate_hz": 500.0}, trials=20
    ),
    "lens held, not this camera's": Case(lens_known=True, lens_off="silent", trials=50),
    "lens held, not this camera's, sigmas stated": Case(lens_known=True, lens_off="stated", trials=20),
    "straight board, its shape found": Case(estimate=frozenset({"target_shape"}), trials=20),
    "target-free, lens known": Case(lens_known=True, target_free=True, trials=50),
    "target-free, lens held, not this camera's": Case(
        lens_known=True, lens_off="silent", target_free=True, trials=50
    ),
    "target-free": Case(target_free=True, start=StartErrors(0.05, 5.0), trials=50),
    "target-free, stamp jitter 1 ms": Case(
        lens_known=True, target_free=True, simulation={"stamp_jitter_s": 1e-3}, trials=20
    ),
    "target-free, 3 % outliers": Case(
        lens_known=True, target_free=True, simulation={"outlier_fraction": 0.03}, trials=20
    ),
    "target-free, rolling shutter of 20 ms, nothing said": Case(
        target_free=True,
        start=StartErrors(0.05, 5.0),
        rig={"readout_s": 0.02},
        bound={"readout": True},
        readout_known=False,
        trials=20,
    ),
    "target-free, accelerometer 0.3 ms late": Case(
        lens_known=True, target_free=True, simulation={"accel_lag_s": 3e-4}, trials=20
    ),
    "target-free, imu matrices 1 % off": Case(
        lens_known=True,
        target_free=True,
        rig={
            "gyro_matrix": np.eye(3)
            + 0.01 * np.array([[0.8, -0.5, 1.0], [0.3, -1.2, 0.4], [-0.9, 0.7, 0.6]]),
            "accel_matrix": np.eye(3)
            + 0.01 * np.array([[-0.7, 0.0, 0.0], [0.9, 1.1, 0.0], [-0.4, 0.6, 0.5]]),
        },
        bound={"imu_matrix_prior": 0.01},
        estimate=frozenset({"imu_intrinsics"}),
        trials=20,
    ),
    "target-free, imu 0.3 % off": Case(
        lens_known=True, target_free=True, imu_off=3e-3, bound={"imu_matrix_prior": 3e-3}, trials=20
    ),
    "target-free, skew 100 ppm": Case(lens_known=True, target_free=True, skew_ppm=100.0, trials=20),
}


def make_run(case: Case, seed: int, seconds: float) -> SimulatedRun:
    """The recording of one trial."""
    shift = case.timeshift_s
    if shift is None:
        shift = float(np.random.default_rng([seed, 61]).uniform(-0.05, 0.05))
    changes = dict(case.rig)
    if case.random_mounting:
        rng = np.random.default_rng([seed, 62])
        changes["R_imu_cam"] = Rotation.random(rng=rng).as_matrix()
        changes["p_imu_cam"] = 0.2 * rng.standard_normal(3) / np.sqrt(3)
    if case.imu_off:
        rng = np.random.default_rng([seed, 63])
        G, A = case.imu_off * rng.standard_normal((2, 3, 3))
        changes["gyro_matrix"] = np.eye(3) + 0.5 * (G + G.T)
        changes["accel_matrix"] = np.eye(3) + A
    rig = reference_rig(seed, timeshift_cam_imu_s=shift, clock_skew_ppm=case.skew_ppm, **changes)
    if case.target_free:
        return simulate_tracks(seed, seconds, rig=rig, **case.simulation)
    points_m = crooked_board(seed) if case.crooked else case.board_size * board_points()
    return simulate(seed, seconds, rig=rig, points_m=points_m, **case.simulation)


def make_subject(case: Case, run: SimulatedRun, seed: int, kind: str) -> Subject:
    """The estimator of one trial: "vical" or "ekf"."""
    prior = camera_prior(run, seed, case.start, exact_lens=case.lens_known)
    if case.lens_off:
        prior = with_lens_off(prior, seed, stated=case.lens_off == "stated")
    if not case.readout_known:
        prior = replace(prior, readout_s=0.0)
    gravity_mps2 = assumed_gravity_mps2(seed)
    if case.gravity_error_mps2 is not None:
        gravity_mps2 = STANDARD_GRAVITY_MPS2 + case.gravity_error_mps2
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}) if case.lens_known else frozenset(),
        estimate=case.estimate,
        target_free=case.target_free,
        gravity_mps2=gravity_mps2,
        imu_noise=imu_noise(run),
    )
    if kind == "ekf":
        return EkfSubject(options, prior, run.points_m)
    return CalibratorSubject(options, prior, None if case.target_free else board_points())


def with_lens_off(prior: CameraPrior, seed: int, *, stated: bool) -> CameraPrior:
    """A lens that is not quite this camera's; `stated`: with how well it is known."""
    assert prior.intrinsics is not None
    assert prior.distortion is not None
    rng = np.random.default_rng([seed, 64])
    fx, fy, cx, cy = prior.intrinsics
    grown = 1.0 + _OFF_FOCAL * rng.standard_normal()
    du, dv = _OFF_CENTRE_PX * rng.standard_normal(2)
    k1 = prior.distortion[0] + _OFF_K1 * rng.standard_normal()
    off = replace(
        prior,
        intrinsics=(fx * grown, fy * grown, cx + du, cy + dv),
        distortion=(k1, *prior.distortion[1:]),
    )
    if not stated:
        return off
    rest = (0.0,) * (len(prior.distortion) - 1)
    return replace(
        off,
        intrinsics_sigma=(_OFF_FOCAL * fx, _OFF_FOCAL * fy, _OFF_CENTRE_PX, _OFF_CENTRE_PX),
        distortion_sigma=(_OFF_K1, *rest),
    )


def bound_options(case: Case, run: SimulatedRun) -> BoundOptions:
    """The bound's model of a case."""
    return replace(
        BoundOptions(
            corner_sigma_px=run.options.corner_sigma_px,
            stamp_jitter_s=run.options.stamp_jitter_s,
            frame_sigma_px=run.options.frame_sigma_px,
            drift_prior=1e-4 if case.skew_ppm else 0.0,
            intrinsics=not case.lens_known,
            distortion=not case.lens_known,
            target_free=case.target_free,
        ),
        **case.bound,
    )


def bound_sigmas(bound: Bound) -> list[float]:
    """Sigmas of a bound in the order of the error vectors; 0 where not estimated."""
    return vector_of(bound, np.sqrt(np.diag(bound.covariance)))


def vector_of(bound: Bound, values: npt.NDArray[np.float64]) -> list[float]:
    """What a bound says of its parameters, in the order of the error vectors; 0 where not estimated."""
    out = np.zeros(15)
    for name, place in _PLACES:
        if name in bound.slices:
            out[place] = values[bound.slices[name]]
    return out.tolist()


def bound_trial(case: Case, seconds: float, seed: int) -> runner.Result:
    """The bound at the times of interest (kept apart: it does not change when the estimator does)."""
    times = [t for t in TIMES_S if t <= seconds]
    run = make_run(case, seed, seconds)
    found = bounds(run, bound_options(case, run), times)
    return {f"{b.t_s:g}": bound_sigmas(b) for b in found}


def trial(case: Case, seconds: float, kind: str, seed: int) -> runner.Result:
    """One recording through one estimator."""
    run = make_run(case, seed, seconds)
    record = feed(run, make_subject(case, run, seed, kind))
    return summary(record, case.dof, [t for t in TIMES_S if t <= seconds])


def summary(record: Record, dof: int, times_s: list[float]) -> runner.Result:
    """What is kept of a record."""
    shots = record.snapshots
    at: dict[str, Any] = {}
    for t_s in times_s:
        shot = record.at(t_s)
        at[f"{t_s:g}"] = shot and {
            "error": shot.error,
            "sigma": np.sqrt(np.diag(shot.covariance)),
            "nees": nees(shot.error, shot.covariance, dof),
            "status": shot.status,
            "extra": shot.extra,
        }
    return {
        "started_s": record.started_s(),
        "cpu_ms_per_frame": 1e3 * record.cpu_s / max(record.frames, 1),
        "at": at,
        "trace": {
            "t_s": [s.t_s for s in shots],
            "error": [s.error for s in shots],
            "sigma": [np.sqrt(np.diag(s.covariance)) for s in shots],
            "nees": [nees(s.error, s.covariance, dof) for s in shots],
            "status": [s.status for s in shots],
        },
        "events": record.event_documents,
        "statuses": record.statuses,
        "unobservable": record.unobservable,
        "guidance": record.guidance,
    }


@cache
def code_under_test(kind: str) -> str:
    """Fingerprint of what decides a trial's result."""
    subject = "vical_daemon/estimation" if kind == "vical" else "benchmarks/ekf.py"
    return runner.fingerprint(subject, "benchmarks/montecarlo.py", "mocks/vical_mocks")


@cache
def _code_of_the_bound() -> str:
    return runner.fingerprint("mocks/vical_mocks")


def results_of(name: str, case: Case, kind: str, args: argparse.Namespace) -> list[runner.Result]:
    """Trials of a case joined with their bounds."""
    seeds = runner.seeds_of(args)
    file = f"{runner.slug(name)}_{args.seconds:g}s"
    limits = runner.run_trials(
        f"bound_{file}",
        partial(bound_trial, case, args.seconds),
        seeds,
        args,
        _code_of_the_bound(),
    )
    results = runner.run_trials(
        f"{kind}_{file}", partial(trial, case, args.seconds, kind), seeds, args, code_under_test(kind)
    )
    for result, limit in zip(results, limits, strict=True):
        for key, at in result["at"].items():
            if at is not None:
                at["bound"] = limit[key]
    return results


def print_case(name: str, case: Case, results: list[runner.Result], args: argparse.Namespace) -> None:
    """Table rows of one case, and its plot."""
    covered = scores.coverage(results, case.dof)
    for t_s in (t for t in TIMES_S if t <= args.seconds):
        print(scores.row(name, scores.score(results, t_s, case.dof), covered), flush=True)
    if not args.no_plots and any(r["trace"]["t_s"] for r in results):
        scores.plot(results, case.dof, name, args.out / f"{runner.slug(name)}.png")


def print_behaviour(name: str, results: list[runner.Result]) -> None:
    """One row: start, verdicts, costs."""
    started = runner.array(results, "started_s")
    cpu = runner.array(results, "cpu_ms_per_frame")
    last = [r["trace"]["status"][-1] if r["trace"]["status"] else "no answer" for r in results]
    counts = ", ".join(f"{last.count(s)} {s}" for s in sorted(set(last)))
    lies = sum(lying(r) for r in results)
    first = f"{np.nanmedian(started):.0f} / {np.nanmax(started):.0f}" if len(started) else "-"
    print(f"| {name} | {first} | {counts} | {lies} | {np.median(cpu):.1f} |", flush=True)


def lying(result: runner.Result, k: float = 5.0) -> bool:
    """Whether it ever said `converged` while a calibration parameter was off by more than k sigma."""
    trace = result["trace"]
    for status, error, sigma in zip(trace["status"], trace["error"], trace["sigma"], strict=True):
        e, s = np.array(error[:7]), np.array(sigma[:7])
        if status == "converged" and np.any(np.abs(e) > k * s):
            return True
    return False


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks montecarlo", description=__doc__)
    runner.add_arguments(parser, trials=0, seconds=60.0)
    parser.add_argument("--subject", choices=("vical", "ekf", "both"), default="vical")
    parser.add_argument("--no-plots", action="store_true")
    args = parser.parse_args(argv)
    unknown = set(args.case or ()) - set(CASES)
    if unknown:
        parser.error(f"no case {sorted(unknown)}; there are: {', '.join(CASES)}")
    kinds = ("vical", "ekf") if args.subject == "both" else (args.subject,)
    for kind in kinds:
        code_under_test(kind)  # now, not hours later: somebody may edit the code meanwhile
    _code_of_the_bound()
    all_results: dict[str, list[runner.Result]] = {}
    print(scores.HEADER)
    asked = args.trials
    for name in args.case or CASES:
        case = CASES[name]
        args.trials = asked or case.trials
        for kind in kinds:
            if kind == "ekf" and case.target_free:
                continue
            label = name if kind == "vical" else f"{name} (plain EKF)"
            all_results[label] = results_of(name, case, kind, args)
            print_case(label, case, all_results[label], args)
    print(
        "\n| case | first answer s (median / last) | last status | converged beyond 5 sigma | CPU ms/frame |"
    )
    print("|---|---|---|---|---|")
    for label, results in all_results.items():
        print_behaviour(label, results)
    return 0
