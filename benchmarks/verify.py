"""Does `vical verify` see what has changed, in time, and leave alone what has not?

python -m benchmarks verify --trials 40                             rigs of the zoo, a board, 5 s
python -m benchmarks verify --seconds 20 --today hand               without a board, moved by hand
python -m benchmarks verify --seconds 20 --today driving --size 3   without a board, along a corridor
python -m benchmarks verify --bound                                 what the best estimator would see

Every rig is calibrated once before a board (`--stored` seconds), then verified with a recording of another
day: motion, biases and noise are its own. Half of the rigs have changed in between, one block each, by
`--size` times what counts as a change.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, astuple, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from vical_mocks.cramer_rao.bound import bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.driving import simulate_drive
from vical_mocks.harness.feed import (
    CAMERA,
    CalibratorSubject,
    StartErrors,
    camera_prior,
    events_in_order,
    imu_noise,
    points_frame,
)
from vical_mocks.points import SimulatedFrame, SimulatedRun
from vical_mocks.random_rigs import draw
from vical_mocks.rig import Rig
from vical_mocks.rotations import exp_so3, log_so3

from benchmarks import runner
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.results.change_odds import FALSE_ALARM, SURE, Counts, odds
from vical_daemon.results.export import rig_from_estimate
from vical_daemon.results.known import KnownCamera, known_cameras
from vical_daemon.results.verifier import Answer, CameraCheck, Verifier

WAYS = ("none", "rotation", "none", "position", "none", "time shift", "none", "lens")
"""What has changed, by the seed: every other rig has not."""


@dataclass(frozen=True)
class Plan:
    """What is recorded.

    Attributes:
        today: A `board`, or unknown landmarks with the motion of a `hand` or of `driving`.
        stored_s: Length of the first recording, before a board.
        seconds: Length of the second one.
        size: Of a change, in units of what counts.
    """

    today: str
    stored_s: float
    seconds: float
    size: float

    @property
    def target_free(self) -> bool:
        """Whether the second recording is without a board."""
        return self.today != "board"

    def first(self, seed: int) -> SimulatedRun:
        """The recording that gives the stored calibration."""
        return draw(seed, self.stored_s, target_free=False)[0]

    def second(self, seed: int, way: str = "none") -> SimulatedRun:
        """The recording of another day, after a change."""
        since = partial(changed, way=way, seed=seed, size=self.size)
        run, _ = draw(seed, self.seconds, target_free=self.target_free, day=1, change=since)
        if self.today != "driving":
            return run
        return simulate_drive(seed, self.seconds, rig=run.rig, **asdict(run.options))


def changed(rig: Rig, way: str, seed: int, size: float) -> Rig:
    """The rig with one block changed by `size` times what counts, in a random direction."""
    rng, usual = np.random.default_rng([seed, 91]), Counts()
    counts = Counts(*(size * x for x in astuple(usual)))
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    sign = float(rng.choice([-1.0, 1.0]))
    if way == "rotation":
        return replace(rig, R_imu_cam=rig.R_imu_cam @ exp_so3(counts.rotation_rad * axis))
    if way == "position":
        return replace(rig, p_imu_cam=rig.p_imu_cam + counts.position_m * axis)
    if way == "time shift":
        return replace(rig, timeshift_cam_imu_s=rig.timeshift_cam_imu_s + sign * counts.timeshift_s)
    if way == "lens":
        fx, fy, cx, cy = rig.lens.intrinsics
        f = 1.0 + sign * counts.lens_share
        return replace(rig, lens=replace(rig.lens, intrinsics=(f * fx, f * fy, cx, cy)))
    return rig


def estimate(
    run: SimulatedRun, prior: CameraPrior, *, target_free: bool, verifier: Verifier | None = None
) -> Any:
    """Calibrate; with a verifier until it knows, looking once a second."""
    options = CalibrationOptions(target_free=target_free, imu_noise=imu_noise(run))
    subject = CalibratorSubject(options, prior, None if target_free else run.points_m)
    next_s = 1.0
    for t_s, event in events_in_order(run):
        if isinstance(event, SimulatedFrame):
            subject.add_points(points_frame(event))
        else:
            subject.add_imu(int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])
        if verifier is not None and t_s >= next_s:
            next_s += 1.0
            if verifier.look(subject.calibrator.estimate()):
                return verifier
    subject.finish()
    last: CalibrationEstimate = subject.calibrator.estimate()
    if verifier is not None:
        verifier.look(last)
        return verifier
    return last


def stored_calibration(run: SimulatedRun, seed: int) -> KnownCamera | None:
    """What was known before, from a board; None if the first recording gave no calibration."""
    last = estimate(run, camera_prior(run, seed, StartErrors(), exact_lens=True), target_free=False)
    if not last.cameras:
        return None
    return known_cameras(rig_from_estimate(last), "stored")[CAMERA]


def bound_of(run: SimulatedRun, *, target_free: bool) -> np.ndarray:
    """Covariance of the best estimate of a calibration from a recording, lens free, shape (15, 15)."""
    o = run.options
    options = BoundOptions(
        corner_sigma_px=o.corner_sigma_px,
        frame_sigma_px=o.frame_sigma_px,
        stamp_jitter_s=o.stamp_jitter_s,
        target_free=target_free,
    )
    return bounds(run, options)[-1].block("p_imu_cam", "r_imu_cam", "timeshift", "intrinsics", "distortion")


def visible_by_the_bound(stored: np.ndarray, today: SimulatedRun, *, target_free: bool) -> dict[str, float]:
    """By block, the smallest change in units of what counts that the best estimate of a recording shows."""
    own = bound_of(today, target_free=target_free)
    counts = Counts().of_errors(today.rig.lens.intrinsics[0], len(own))
    return odds(np.zeros(len(own)), stored + own, stored, counts).visible


def found_by_the_bound(stored: np.ndarray, today: SimulatedRun, change: np.ndarray, free: bool) -> bool:
    """Whether the test, which knows neither what has changed nor how, finds a change in 95 % of recordings.

    Its estimate is the best one, and off by 1.645 sigmas towards the stored calibration.
    """
    S = stored + bound_of(today, target_free=free)
    sigmas = float(np.sqrt(change @ np.linalg.solve(S, change)))
    if sigmas <= SURE:
        return False
    counts = Counts().of_errors(today.rig.lens.intrinsics[0], len(S))
    return odds(change * (1.0 - SURE / sigmas), S, stored, counts).log_changed >= np.log(1.0 / FALSE_ALARM)


def difference_of(before: Rig, after: Rig) -> np.ndarray:
    """What leads from one rig to the other, in the order of a calibration's errors, shape (15,)."""
    lenses = [np.array([*rig.lens.intrinsics, *rig.lens.distortion]) for rig in (before, after)]
    return np.concatenate(
        [
            np.asarray(after.p_imu_cam) - np.asarray(before.p_imu_cam),
            log_so3(before.R_imu_cam.T @ after.R_imu_cam),
            [after.timeshift_cam_imu_s - before.timeshift_cam_imu_s],
            lenses[1] - lenses[0],
        ]
    )


def bound_trial(plan: Plan, seed: int) -> runner.Result:
    """What is visible if both recordings of a rig were used by the best estimator; nothing is estimated."""
    before, today = plan.first(seed), plan.second(seed)
    stored = bound_of(before, target_free=False)
    counts = Counts().of_errors(today.rig.lens.intrinsics[0], len(stored))
    floor = odds(np.zeros(len(stored)), stored, stored, counts).floor
    visible = visible_by_the_bound(stored, today, target_free=plan.target_free)
    return {"visible": visible, "left_open": floor}


def print_bound(results: list[runner.Result], size: float) -> None:
    """Shares of the rigs, by block."""
    print(f"| rigs | {size:g} times what counts is visible in | is left open by the stored calibration in |")
    print("|---|---|---|")
    cells = []
    for key, joined in (("visible", all), ("left_open", any)):
        yes = [{b: (x <= size) is (key == "visible") for b, x in r[key].items()} for r in results]
        words = [f"{b} {100 * np.mean([y[b] for y in yes]):.0f} %" for b in yes[0]]
        everything = np.mean([joined(y.values()) for y in yes])
        cells.append(f"{', '.join(words)}; {joined.__name__} {100 * everything:.0f} %")
    print(f"| {len(results)} | {' | '.join(cells)} |")


def trial(plan: Plan, seed: int) -> runner.Result:
    """One rig, stored and verified."""
    way = WAYS[seed % len(WAYS)]
    run = plan.first(seed)
    known = stored_calibration(run, seed)
    if known is None or known.lens is None:
        return {"way": way, "answer": "not stored"}
    today = plan.second(seed, way)
    fx, fy, cx, cy, *distortion = (float(x) for x in known.lens)
    prior = CameraPrior(run.rig.lens.resolution, (fx, fy, cx, cy), known.model, tuple(distortion))
    verifier = Verifier({CAMERA: CameraCheck(known, lens_asked=True)})
    estimate(today, prior, target_free=plan.target_free, verifier=verifier)
    document = verifier.document()
    latest = verifier.latest
    return {
        "way": way,
        "answer": document["verdict"],
        "status": "" if latest is None else f"{latest.status}: {latest.reason}",
        "visible": visible_by_the_bound(known.covariance, today, target_free=plan.target_free),
        "found": found_by_the_bound(
            known.covariance, today, difference_of(run.rig, today.rig), plan.target_free
        ),
        "document": document,
        "sigma": known.sigma[:7].tolist(),
    }


def print_summary(results: list[runner.Result], size: float) -> None:
    """One row for each way."""
    print(
        "| changed since | rigs | visible by the bound | of these: found by it | holds | changed "
        "| the right block | cannot tell | not visible: holds | changed | cannot tell |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for way in dict.fromkeys(WAYS):
        own = [r for r in results if r["way"] == way and r["answer"] != "not stored"]
        seen, unseen = ([r for r in own if _visible(r, way, size) == which] for which in (True, False))
        right = sum(r["answer"] == Answer.CHANGED and _named(r) == {way} for r in seen)
        a, b = ([[r["answer"] for r in some].count(word) for word in Answer] for some in (seen, unseen))
        best = "-" if way == "none" else sum(r["found"] for r in seen)
        cells = [way, len(own), len(seen), best, a[0], a[1], right, a[2], *b]
        print("| " + " | ".join(map(str, cells)) + " |")
    should = [r for r in results if r.get("found") and r["way"] != "none"]
    found = sum(r["answer"] == Answer.CHANGED for r in should)
    print(f"\nfound by the best estimate in 95 % of recordings: {len(should)}; of these found: {found}")
    times = [r["document"]["seconds_used"] for r in results if r["answer"] in ("holds", "changed")]
    if times:
        print(f"\nseconds until an answer, median and worst: {np.median(times):.0f}, {np.max(times):.0f}")


def _named(result: runner.Result) -> set[str]:
    return {change["what"] for change in result["document"]["changes"]}


def _visible(result: runner.Result, way: str, size: float) -> bool:
    """Whether the bound shows the change of this block (where nothing changed: one that counts, of all)."""
    visible = result["visible"]
    return max(visible.values()) <= 1.0 if way == "none" else bool(visible[way] <= size)


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks verify", description=__doc__)
    runner.add_arguments(parser, trials=40, seconds=5.0)
    parser.add_argument(
        "--stored", type=float, default=30.0, metavar="S", help="length of the first recording"
    )
    parser.add_argument("--today", choices=("board", "hand", "driving"), default="board")
    parser.add_argument("--size", type=float, default=1.0, help="of a change, in units of what counts")
    parser.add_argument("--bound", action="store_true", help="only what the Cramer-Rao bound says is visible")
    args = parser.parse_args(argv)
    name = (
        f"verify_{'bound_' if args.bound else ''}{args.today}_{args.stored:g}_{args.seconds:g}s_{args.size:g}"
    )
    code = runner.fingerprint("vical_daemon", "benchmarks/verify.py", "mocks/vical_mocks")
    plan = Plan(args.today, args.stored, args.seconds, args.size)
    work = partial(bound_trial if args.bound else trial, plan)
    results = runner.run_trials(name, work, runner.seeds_of(args), args, code)
    if args.bound:
        print_bound(results, args.size)
        return 0
    print_summary(results, args.size)
    for seed, r in zip(runner.seeds_of(args), results, strict=True):
        wrong = {"none": "changed"}.get(r["way"], "holds")
        if r["answer"] == wrong:
            print(f"seed {seed}: {r['way']}, answered {r['answer']}: {r['document']['changes']}")
        elif r.get("found") and r["answer"] != Answer.CHANGED:
            print(f"seed {seed}: {r['way']}, answered {r['answer']}; {r['status']}")
    return 0
