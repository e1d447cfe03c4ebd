"""Gaps, frozen sensors and clocks that are set: is the calibration kept, and is the right cause reported?

    python -m benchmarks gaps --trials 20                           every case, lens free
    python -m benchmarks gaps --trials 20 --lens-known
    python -m benchmarks gaps --trials 20 --target-free
    python -m benchmarks gaps --trials 20 --case "imu 2 s" --case "camera clock +0.5 s"

A disturbance begins at 20 s; ten seconds follow it. Each recording is run without it, too.
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache, partial
from typing import Any

import numpy as np
from vical_mocks.harness.feed import (
    CalibratorSubject,
    Record,
    StartErrors,
    camera_prior,
    finish,
    follow,
    imu_noise,
)
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import Bump, reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks

from benchmarks import runner
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, PointsFrame

AT_S, AFTER_S = 20.0, 10.0
COMMON_S = AT_S - 0.5
LOOK_S = 0.25
GAPS_S = (0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 60.0)
STEPS_S = (0.02, 0.5, 3600.0)
Change = Callable[[SimulatedRun], SimulatedRun]
Late = Callable[[float], float]


def _during(run: SimulatedRun, seconds: float) -> tuple[Any, Any]:
    """Which inertial samples, and which images, lie within the disturbance."""
    t_imu_s = (run.t_imu_ns - run.options.epoch_ns) * 1e-9
    t_cam_s = np.array([f.t_s for f in run.frames])
    end_s = AT_S + seconds
    return (t_imu_s >= AT_S) & (t_imu_s < end_s), (t_cam_s >= AT_S) & (t_cam_s < end_s)


def cut(sensors: str, seconds: float, run: SimulatedRun) -> SimulatedRun:
    """Without the data of one sensor, or both."""
    imu, images = _during(run, seconds)
    if sensors in ("imu", "both"):
        run = replace(
            run,
            t_imu_ns=run.t_imu_ns[~imu],
            gyro_rps=run.gyro_rps[~imu],
            specific_force_mps2=run.specific_force_mps2[~imu],
        )
    if sensors in ("camera", "both"):
        run = replace(run, frames=[f for f, out in zip(run.frames, images, strict=True) if not out])
    return run


def freeze(sensor: str, seconds: float, run: SimulatedRun) -> SimulatedRun:
    """The last reading, or the last image, again and again."""
    imu, images = _during(run, seconds)
    if sensor == "imu":
        gyro, force = run.gyro_rps.copy(), run.specific_force_mps2.copy()
        last = int(np.flatnonzero(imu)[0]) - 1
        gyro[imu], force[imu] = gyro[last], force[last]
        return replace(run, gyro_rps=gyro, specific_force_mps2=force)
    last = run.frames[int(np.flatnonzero(images)[0]) - 1]
    frames = [
        replace(f, ids=last.ids, uv_px=last.uv_px) if frozen else f
        for f, frozen in zip(run.frames, images, strict=True)
    ]
    return replace(run, frames=frames)


class Retimed(CalibratorSubject):
    """Gets the data in their true order, one sensor's stamps `late_s(t_s)` later than they are."""

    sensor = ""
    late_s: Late
    epoch_ns = 0

    def add_imu(self, t_ns: int, gyro: Any, force: Any) -> None:
        """See `Subject`."""
        super().add_imu(self.stamp("imu", t_ns), gyro, force)

    def add_points(self, frame: PointsFrame) -> None:
        """See `Subject`."""
        super().add_points(replace(frame, t_cam_ns=self.stamp("camera", frame.t_cam_ns)))

    def stamp(self, sensor: str, t_ns: int) -> int:
        """The stamp that this reading of a sensor gets, ns."""
        if sensor != self.sensor:
            return t_ns
        return t_ns + round(1e9 * self.late_s(1e-9 * (t_ns - self.epoch_ns)))


def step(by_s: float, t_s: float) -> float:
    """Stamps that step at `AT_S`."""
    return by_s if t_s >= AT_S else 0.0


MOVED = "bump of 10 mm in a gap of 10 s"
CASES: dict[str, tuple[Change, float]] = {
    **{
        f"{sensors} {seconds:g} s": (partial(cut, sensors, seconds), seconds)
        for sensors in ("imu", "camera", "both")
        for seconds in GAPS_S
    },
    "imu frozen 1 s": (partial(freeze, "imu", 1.0), 1.0),
    "camera frozen 3 s": (partial(freeze, "camera", 3.0), 3.0),
    **{
        f"{sensor} clock +{step_s:g} s": (lambda run: run, 0.0)
        for sensor in ("imu", "camera")
        for step_s in STEPS_S
    },
    "bump in a gap of 5 s": (partial(cut, "both", 5.0), 5.0),
    MOVED: (partial(cut, "both", 10.0), 10.0),
}
UNDISTURBED = "undisturbed"
CASES[UNDISTURBED] = (lambda run: run, 0.0)


@lru_cache(maxsize=4)
def simulated(case: str, seed: int, *, target_free: bool) -> SimulatedRun:
    """The undisturbed recording; a bump of 2 deg and 10 mm, or of 10 mm alone, where the case asks for one.

    As long as the longest case needs, whatever the case: noise depends on the length.
    """
    if not case.startswith("bump") and case != UNDISTURBED:
        return simulated(UNDISTURBED, seed, target_free=target_free)
    seconds = AT_S + max(GAPS_S) + AFTER_S
    bumps: tuple[Bump, ...] = ()
    if case.startswith("bump"):
        rng = np.random.default_rng([seed, 77])
        axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        turn, move = (0.0 if case == MOVED else np.deg2rad(2.0)) * axis, 0.01 * way
        bumps = (Bump(AT_S + 2.0, tuple(turn.tolist()), tuple(move.tolist())),)
    rig = reference_rig(seed, timeshift_cam_imu_s=0.01, bumps=bumps)
    if not target_free:
        return simulate(seed, seconds, rig=rig)
    return simulate_tracks(seed, seconds, rig=rig, landmarks_m=room_landmarks(seed, 200))


def trial(case: str, lens_known: bool, target_free: bool, seed: int) -> runner.Result:
    """One recording with the disturbance of a case; after steps of a clock next to the one without."""
    disturbed = recorded(case, seed, lens_known=lens_known, target_free=target_free)
    result = judged(disturbed, case)
    if "clock" in case:
        apart_m = disturbed.snapshots[-1].error[:3] - _undisturbed_m(seed, lens_known, target_free)
        result["apart_mm"] = 1e3 * float(np.linalg.norm(apart_m))
    return result


@cache
def _undisturbed_m(seed: int, lens_known: bool, target_free: bool) -> Any:
    """Error of the lever arm at the end of the recording without a disturbance, m, shape (3,)."""
    plain = recorded(UNDISTURBED, seed, lens_known=lens_known, target_free=target_free)
    return plain.snapshots[-1].error[:3]


def recorded(case: str, seed: int, *, lens_known: bool, target_free: bool) -> Record:
    """What is said about one recording with the disturbance of a case.

    All cases of a seed are the same up to the disturbance: that part is followed once, and each case goes on
    from a copy.
    """
    change, lasts_s = CASES[case]
    before, record = pickle.loads(_before(seed, lens_known, target_free))
    subject = Retimed.__new__(Retimed)
    subject.calibrator = before.calibrator
    run = simulated(case, seed, target_free=target_free)
    subject.sensor, subject.late_s = case.split()[0], partial(step, _added_s(case))
    subject.epoch_ns = run.options.epoch_ns
    end_s = AT_S + lasts_s + AFTER_S
    run = change(run)
    follow(run, subject, record, LOOK_S, after_s=COMMON_S, until_s=end_s)
    finish(run, subject, record, end_s)
    return record


@lru_cache(maxsize=64)
def _before(seed: int, lens_known: bool, target_free: bool) -> bytes:
    """The calibrator and what it had said, `COMMON_S` into the recording; pickled."""
    run = simulated(UNDISTURBED, seed, target_free=target_free)
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}) if lens_known else frozenset(),
        target_free=target_free,
        imu_noise=imu_noise(run),
    )
    prior = camera_prior(run, seed, StartErrors(), exact_lens=lens_known)
    subject = CalibratorSubject(options, prior, None if target_free else run.points_m)
    record = Record()
    follow(run, subject, record, LOOK_S, until_s=COMMON_S)
    return pickle.dumps((subject, record))


def _added_s(case: str) -> float:
    """By how much a clock is set, s."""
    return float(case.split("+")[1].split()[0]) if "clock" in case else 0.0


def judged(record: Record, case: str) -> runner.Result:
    """What was reported, how far sigmas grew, when it had converged again, and whether it ever lied."""
    lasts_s = CASES[case][1]
    shift_moved_s = _added_s(case) * (1.0 if case.startswith("imu") else -1.0)
    seen_s = AT_S + lasts_s
    sigma_before = np.zeros(7)
    grown, lies = 0.0, []
    for s in record.snapshots:
        sigma = np.sqrt(np.diag(s.covariance))[:7]
        error = s.error[:7].copy()
        if s.t_s < AT_S:
            sigma_before = sigma
        elif s.t_s > seen_s + 0.5:
            error[6] -= shift_moved_s
            grown = max(grown, float(np.max(sigma[:6] / sigma_before[:6]))) if sigma_before.any() else grown
        if s.status == "converged" and not AT_S <= s.t_s < seen_s + 3.0:
            worst = float(np.max(np.abs(error) / np.maximum(sigma, 1e-12)))
            if worst > 5.0:
                lies.append((s.t_s, worst))
    was = [s.status for s in record.snapshots if s.t_s < AT_S][-1:] == ["converged"]
    late = [s.t_s for s in record.snapshots if s.t_s > seen_s and s.status != "converged"]
    bumps = [t for t, e in record.events if e.kind in (EventKind.BUMPED, EventKind.STARTED_OVER)]
    return {
        "was_converged": was,
        "bumped_s": min((t - seen_s for t in bumps if t >= AT_S), default=None),
        "early": sum(t < AT_S for t in bumps),
        "reported": [str(event.kind) for t, event in record.events if t >= AT_S],
        "back_s": max(late) - seen_s + 0.25 if late else 0.0,
        "grown": grown,
        "lies": lies,
    }


_DISTURBANCES = {
    EventKind.IMU_GAP,
    EventKind.IMU_REPEATED,
    EventKind.IMAGE_GAP,
    EventKind.IMAGE_REPEATED,
    EventKind.TIMESHIFT_STEPPED,
    EventKind.STAMPS_STEPPED,
    EventKind.IMU_CLOCK_SET_BACK,
    EventKind.IMU_CLOCK_REMAPPED,
}


def _row(case: str, results: list[runner.Result]) -> str:
    known = [r for r in results if r["was_converged"]]
    named = sum(any(kind in _DISTURBANCES for kind in r["reported"]) for r in results)
    bumps = [r["bumped_s"] for r in results if r["bumped_s"] is not None]
    worst = f", at most {max(bumps):.1f} s later" if bumps else ""
    apart = [r["apart_mm"] for r in results if "apart_mm" in r]
    back = [r["back_s"] for r in known]
    grown = [r["grown"] for r in known if r["grown"]]
    return (
        f"| {case} | {len(results)} | {named} | {len(bumps)}{worst} "
        f"| {np.median(back) if back else np.nan:.1f} / {max(back, default=np.nan):.1f} "
        f"| {np.median(grown) if grown else np.nan:.3f} / {max(grown, default=np.nan):.3f} "
        f"| {sum(bool(r['lies']) for r in results)} "
        f"| {f'{np.median(apart):.2f} / {max(apart):.2f}' if apart else ''} |"
    )


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks gaps", description=__doc__)
    runner.add_arguments(parser, trials=20, seconds=AT_S + AFTER_S)
    parser.add_argument("--lens-known", action="store_true")
    parser.add_argument("--target-free", action="store_true")
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon/estimation", "benchmarks/gaps.py", "mocks/vical_mocks")
    print(
        "| disturbance | rigs | reported | announced as bumped | converged again after s (median / worst) "
        "| sigmas after over before (median / worst) | converged beyond 5 sigma "
        "| lever arm from undisturbed mm (median / worst) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    mode = "free" if args.target_free else "known" if args.lens_known else "unknown"
    for case in args.case or CASES:
        results = runner.run_trials(
            f"gaps_{runner.slug(case)}_{mode}",
            partial(trial, case, args.lens_known, args.target_free),
            runner.seeds_of(args),
            args,
            code,
        )
        print(_row(case, results), flush=True)
    return 0
