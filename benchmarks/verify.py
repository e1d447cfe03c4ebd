"""Does `vical verify` see what has changed, in time, and leave alone what has not?

python -m benchmarks verify --trials 40                 rigs of the zoo, a board, 5 s
python -m benchmarks verify --trials 20 --target-free   without a board, 20 s
python -m benchmarks verify --bound                     only what the best estimator would see

Every rig is calibrated once (`--stored` seconds), then verified with a recording of another day: motion,
biases and noise are its own. Half of the rigs have changed in between, one block each, by what counts as a
change.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from vical_mocks.cramer_rao.bound import bounds
from vical_mocks.cramer_rao.information import BoundOptions
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
from vical_mocks.rotations import exp_so3

from benchmarks import runner
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.results.change_odds import Counts, odds
from vical_daemon.results.export import rig_from_estimate
from vical_daemon.results.known import KnownCamera, known_cameras
from vical_daemon.results.verifier import Answer, CameraCheck, Verifier

WAYS = ("none", "rotation", "none", "position", "none", "time shift", "none", "lens")
"""What has changed, by the seed: every other rig has not."""


def changed(rig: Rig, way: str, seed: int) -> Rig:
    """The rig with one block changed by what counts, in a random direction."""
    rng, counts = np.random.default_rng([seed, 91]), Counts()
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


def stored_calibration(run: SimulatedRun, seed: int, *, target_free: bool) -> KnownCamera | None:
    """What was known before; None if the first recording gave no calibration."""
    last = estimate(run, camera_prior(run, seed, StartErrors(), exact_lens=True), target_free=target_free)
    if not last.cameras:
        return None
    known = known_cameras(rig_from_estimate(last), "stored")[CAMERA]
    return replace(known, begin_ns=0, end_ns=0)  # another day, whatever the simulation's clock says


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


def visible_by_the_bound(stored: np.ndarray, today: SimulatedRun, *, target_free: bool) -> dict[str, bool]:
    """By block, whether the best estimate would see a change that counts in the whole of a recording."""
    own = bound_of(today, target_free=target_free)
    counts = Counts().of_errors(today.rig.lens.intrinsics[0], len(own))
    best = odds(np.zeros(len(own)), stored + own, stored, counts)
    return {name: x <= max(1.0, best.floor[name]) for name, x in best.visible.items()}


def bound_trial(target_free: bool, stored_s: float, seconds: float, seed: int) -> runner.Result:
    """What is visible if both recordings of a rig were used by the best estimator; nothing is estimated."""
    before, today = (
        draw(seed, s, target_free=target_free, day=day)[0] for day, s in enumerate((stored_s, seconds))
    )
    stored = bound_of(before, target_free=target_free)
    visible = visible_by_the_bound(stored, today, target_free=target_free)
    counts = Counts().of_errors(today.rig.lens.intrinsics[0], len(stored))
    floor = odds(np.zeros(len(stored)), stored, stored, counts).floor
    return {"visible": visible, "left_open": {name: x > 1.0 for name, x in floor.items()}}


def print_bound(results: list[runner.Result]) -> None:
    """Shares of the rigs, by block."""
    print("| rigs | what counts shows in | what counts is left open by the stored calibration in |")
    print("|---|---|---|")
    cells = []
    for key in ("visible", "left_open"):
        shares = {b: np.mean([r[key][b] for r in results]) for b in results[0][key]}
        everything = np.mean([(all if key == "visible" else any)(r[key].values()) for r in results])
        words = [f"{b} {100 * share:.0f} %" for b, share in shares.items()]
        cells.append(f"{', '.join(words)}; {'all' if key == 'visible' else 'any'} {100 * everything:.0f} %")
    print(f"| {len(results)} | {' | '.join(cells)} |")


def trial(target_free: bool, stored_s: float, seconds: float, seed: int) -> runner.Result:
    """One rig, stored and verified."""
    way = WAYS[seed % len(WAYS)]
    run, _ = draw(seed, stored_s, target_free=target_free)
    known = stored_calibration(run, seed, target_free=target_free)
    if known is None or known.lens is None:
        return {"way": way, "answer": "not stored"}
    since = partial(changed, way=way, seed=seed)
    today, _ = draw(seed, seconds, target_free=target_free, day=1, change=since)
    fx, fy, cx, cy, *distortion = (float(x) for x in known.lens)
    prior = CameraPrior(run.rig.lens.resolution, (fx, fy, cx, cy), known.model, tuple(distortion))
    verifier = Verifier({CAMERA: CameraCheck(known, lens_asked=True)})
    estimate(today, prior, target_free=target_free, verifier=verifier)
    document = verifier.document()
    latest = verifier.latest
    return {
        "way": way,
        "answer": document["verdict"],
        "status": "" if latest is None else f"{latest.status}: {latest.reason}",
        "visible": visible_by_the_bound(known.covariance, today, target_free=target_free),
        "document": document,
        "sigma": known.sigma[:7].tolist(),
    }


def print_summary(results: list[runner.Result]) -> None:
    """One row for each way."""
    print(
        "| changed since | rigs | visible by the bound | of these: holds | changed | the right block "
        "| cannot tell | not visible: holds | changed | cannot tell |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for way in dict.fromkeys(WAYS):
        own = [r for r in results if r["way"] == way and r["answer"] != "not stored"]
        seen, unseen = ([r for r in own if _visible(r, way) == which] for which in (True, False))
        right = sum(r["answer"] == Answer.CHANGED and _named(r) == {way} for r in seen)
        a, b = ([[r["answer"] for r in some].count(word) for word in Answer] for some in (seen, unseen))
        cells = [way, len(own), len(seen), a[0], a[1], right, a[2], *b]
        print("| " + " | ".join(map(str, cells)) + " |")
    times = [r["document"]["seconds_used"] for r in results if r["answer"] in ("holds", "changed")]
    print(f"\nseconds until an answer, median and worst: {np.median(times):.0f}, {np.max(times):.0f}")


def _named(result: runner.Result) -> set[str]:
    return {change["what"] for change in result["document"]["changes"]}


def _visible(result: runner.Result, way: str) -> bool:
    """Whether the bound shows a change that counts of this block (of all, where nothing changed)."""
    visible = result["visible"]
    return all(visible.values()) if way == "none" else bool(visible[way])


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks verify", description=__doc__)
    runner.add_arguments(parser, trials=40, seconds=5.0)
    parser.add_argument(
        "--stored", type=float, default=30.0, metavar="S", help="length of the first recording"
    )
    parser.add_argument("--target-free", action="store_true", help="unknown landmarks instead of a board")
    parser.add_argument("--bound", action="store_true", help="only what the Cramer-Rao bound says is visible")
    args = parser.parse_args(argv)
    kind = f"{'bound_' if args.bound else ''}{'free' if args.target_free else 'board'}"
    name = f"verify_{kind}_{args.stored:g}_{args.seconds:g}s"
    code = runner.fingerprint("vical_daemon", "benchmarks/verify.py", "mocks/vical_mocks")
    chosen = bound_trial if args.bound else trial
    work = partial(chosen, args.target_free, args.stored, args.seconds)
    results = runner.run_trials(name, work, runner.seeds_of(args), args, code)
    if args.bound:
        print_bound(results)
        return 0
    print_summary(results)
    for seed, r in zip(runner.seeds_of(args), results, strict=True):
        wrong = {"none": "changed"}.get(r["way"], "holds")
        if r["answer"] == wrong:
            print(f"seed {seed}: {r['way']}, answered {r['answer']}: {r['document']['changes']}")
    return 0
