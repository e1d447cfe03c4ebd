"""Knocked cameras: is a step of the calibration announced and followed, and is calm left alone?"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import numpy as np
from vical_mocks.harness.feed import CalibratorSubject, Record, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate
from vical_mocks.rig import Bump, reference_rig

from benchmarks import runner
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions

AT_S = 60.0
# Name: (rotation deg, translation mm, time shift ms); directions are chosen by the seed.
STEPS: dict[str, tuple[float, float, float]] = {
    "5 ms": (0.0, 0.0, 5.0),
    "20 ms": (0.0, 0.0, 20.0),
    "0.5 deg": (0.5, 0.0, 0.0),
    "2 deg": (2.0, 0.0, 0.0),
    "10 mm": (0.0, 10.0, 0.0),
    "2 deg, 10 mm, 5 ms": (2.0, 10.0, 5.0),
    "calm": (0.0, 0.0, 0.0),
}


def bump(size: tuple[float, float, float], seed: int) -> tuple[Bump, ...]:
    """A step of the given size in random directions; nothing for the calm case."""
    if not any(size):
        return ()
    rng = np.random.default_rng([seed, 71])
    axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    turn, move = np.deg2rad(size[0]) * axis, 1e-3 * size[1] * way
    sign = float(rng.choice([-1.0, 1.0]))
    return (
        Bump(
            AT_S,
            (float(turn[0]), float(turn[1]), float(turn[2])),
            (float(move[0]), float(move[1]), float(move[2])),
            1e-3 * size[2] * sign,
        ),
    )


def trial(size: tuple[float, float, float], lens_known: bool, seconds: float, seed: int) -> runner.Result:
    """One recording with a step at `AT_S`."""
    rig = reference_rig(seed, timeshift_cam_imu_s=0.01, bumps=bump(size, seed))
    run = simulate(seed, seconds, rig=rig)
    fix = frozenset({"intrinsics"}) if lens_known else frozenset[str]()
    prior = camera_prior(run, seed, StartErrors(), exact_lens=lens_known)
    record = feed(
        run,
        CalibratorSubject(CalibrationOptions(fix=fix, imu_noise=imu_noise(run)), prior, run.points_m),
        0.5,
    )
    return judge(record)


_STEPS = (EventKind.BUMPED, EventKind.TIMESHIFT_STEPPED)


def judge(record: Record) -> runner.Result:
    """Delay of the announcement, time until the errors stay within 3 sigma, false alarms, lies."""
    bumps = [t for t, event in record.events if event.kind in _STEPS]
    after = [s for s in record.snapshots if s.t_s >= AT_S]
    worst = [(s.t_s, _worst(s.error, s.covariance)) for s in after]
    outside = [t for t, w in worst if w > 3.0]
    # Until it is announced (at most 3 s) nobody can know of a step.
    blind_until_s = min([t for t in bumps if t >= AT_S] + [AT_S + 3.0])
    lies = [
        s.t_s
        for s in record.snapshots
        if s.status == "converged"
        and not AT_S <= s.t_s < blind_until_s
        and _worst(s.error, s.covariance) > 5.0
    ]
    last = record.snapshots[-1] if record.snapshots else None
    return {
        "announced_s": min((t - AT_S for t in bumps if t >= AT_S), default=None),
        "early": sum(t < AT_S for t in bumps),
        "events": record.event_documents,
        "back_s": (outside[-1] - AT_S + 0.5) if outside else 0.0,
        "sigmas_at_10_s": next((w for t, w in worst if t >= AT_S + 10.0), None),
        "lies_s": lies,
        "last": None if last is None else {"status": last.status, "error": last.error[:7]},
        "cpu_ms_per_frame": 1e3 * record.cpu_s / max(record.frames, 1),
    }


def _worst(error: Any, covariance: Any) -> float:
    """Largest error of the seven calibration parameters in sigmas."""
    sigma = np.sqrt(np.diag(covariance))[:7]
    return float(np.max(np.abs(error[:7]) / np.maximum(sigma, 1e-12)))


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks changes", description=__doc__)
    runner.add_arguments(parser, trials=10, seconds=90.0)
    parser.add_argument("--lens-known", action="store_true")
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon/estimation", "benchmarks/changes.py", "mocks/vical_mocks")
    print(
        "| step at 60 s | trials | announced | delay s (median / worst) | within 3 sigma for good after s "
        "(median / worst) | within 3 sigma 10 s later | false alarms | converged beyond 5 sigma |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in args.case or STEPS:
        size = STEPS[name]
        slug = runner.slug(name)
        file = f"changes_{slug}_{'known' if args.lens_known else 'unknown'}_{args.seconds:g}s"
        results = runner.run_trials(
            file, partial(trial, size, args.lens_known, args.seconds), runner.seeds_of(args), args, code
        )
        print(_row(name, results), flush=True)
    return 0


def _row(name: str, results: list[runner.Result]) -> str:
    heard = [r["announced_s"] for r in results if r["announced_s"] is not None]
    delay = f"{np.median(heard):.1f} / {np.max(heard):.1f}" if heard else "-"
    back = [r["back_s"] for r in results]
    fine = sum(r["sigmas_at_10_s"] is not None and r["sigmas_at_10_s"] <= 3.0 for r in results)
    alarms = sum(r["early"] for r in results) + (len(heard) if name == "calm" else 0)
    lies = sum(bool(r["lies_s"]) for r in results)
    n = len(results)
    return (
        f"| {name} | {n} | {len(heard)}/{n} | {delay} | {np.median(back):.1f} / {np.max(back):.1f} "
        f"| {fine}/{n} | {alarms} | {lies}/{n} |"
    )
