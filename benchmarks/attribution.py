"""Is the cause that vical announces the true one? A confusion table of single causes and announcements.

    python -m benchmarks attribution --trials 30                      the reference rig, 30 motions
    python -m benchmarks attribution --trials 30 --zoo                random rigs
    python -m benchmarks attribution --trials 10 --case "imu 1 %"     one cause

Each recording has one cause and no other. A row counts the rigs in which the cause was announced, and those
in which any other was. Gaps of the images are facts and not causes: boards leave the view.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import SimulatedRun, board_points, crooked_board, simulate
from vical_mocks.random_rigs import draw
from vical_mocks.rig import Bump, Rig, reference_rig
from vical_mocks.rotations import FloatArray, exp_so3
from vical_mocks.tracks import room_landmarks, simulate_tracks

from benchmarks import gaps, runner
from benchmarks.montecarlo import lying, summary, with_lens_off
from vical_daemon.estimation.events import EventKind as Kind
from vical_daemon.estimation.measurements import CalibrationOptions

AT_S = gaps.AT_S
"""When a sudden cause begins, s."""
NOTICED_S = 3.0
LOOK_S = 0.5
_CLEAN = ("frame_sigma_px", "stamp_jitter_s", "outlier_fraction", "missing_fraction", "frame_drop_fraction")
_FACTS = {Kind.IMAGE_GAP, Kind.STARTED_ANEW, Kind.WENT_ON}
_DRIFT = (Kind.CLOCK_DRIFT, Kind.CLOCK_WANDER)
_BUMP = (Kind.BUMPED, Kind.STARTED_OVER)
_BOARD = (Kind.POSE_LOST, Kind.NOT_BUMPED)
_OF_A_BUMP = frozenset({Kind.CAMERA_MOVED, Kind.CAMERA_TURNED, Kind.POSE_LOST})


def _exact(rig: Rig, rng: np.random.Generator) -> Rig:  # noqa: ARG001
    return rig


def _axes_apart(rig: Rig, rng: np.random.Generator) -> Rig:
    """About as in EuRoC's ADIS16448, axes in any order; their mean is what the lever arm refers to."""
    positions = [[-5e-3, 8e-3, -1e-3], [2e-3, -4e-3, 0.0], [3e-3, -4e-3, 1e-3]]
    return replace(rig, accel_positions=rng.permutation(positions))


def _matrices(size: float, rig: Rig, rng: np.random.Generator) -> Rig:
    """Scale and alignment off by `size`, one sigma; what of the gyro's is no turn of the imu's frame."""
    G, A = size * rng.standard_normal((2, 3, 3))
    return replace(rig, gyro_matrix=np.eye(3) + 0.5 * (G + G.T), accel_matrix=np.eye(3) + A)


def _random_move(turn_deg: float, move_m: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A turn, rad, and a move, m, in random directions."""
    turn, move = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return np.deg2rad(turn_deg) * turn, move_m * move


def _bumped(turn_deg: float, move_m: float, rig: Rig, rng: np.random.Generator) -> Rig:
    """A camera that is knocked."""
    turn, move = _random_move(turn_deg, move_m, rng)
    return replace(rig, bumps=(Bump(AT_S, tuple(turn.tolist()), tuple(move.tolist())),))


def _zoomed(factor: float, run: SimulatedRun) -> SimulatedRun:
    """The focal length changes."""
    middle = np.array(run.rig.lens.intrinsics[2:])
    return replace(
        run,
        frames=[
            f if f.t_s < AT_S else replace(f, uv_px=middle + factor * (f.uv_px - middle)) for f in run.frames
        ],
    )


def _biases_step(turn_dps: float, force_mps2: float, rig: Rig, rng: np.random.Generator) -> Rig:
    """The biases of the IMU jump, in random directions."""
    turn, force = _random_move(turn_dps, force_mps2, rng)
    gyro, accel = rig.gyro_bias.with_step(AT_S, turn), rig.accel_bias.with_step(AT_S, force)
    return replace(rig, gyro_bias=gyro, accel_bias=accel)


def _apart(ppm: float, from_s: float, rig: Rig, rng: np.random.Generator) -> Rig:  # noqa: ARG001
    """Two crystals that differ, or that begin to."""
    return replace(rig, clock_skew_ppm=ppm, clock_skew_from_s=from_s)


def _stepped(rig: Rig, rng: np.random.Generator) -> Rig:  # noqa: ARG001
    """A driver maps its device's clock anew."""
    return replace(rig, bumps=(Bump(AT_S, timeshift_s=2e-3),))


def _one_term_more(rig: Rig, rng: np.random.Generator) -> Rig:
    """A sixth power of the radius that moves the corners of the image by 3 % of their distance."""
    width, height = rig.lens.resolution
    radius = np.hypot(0.5 * width, 0.5 * height) / rig.lens.intrinsics[0]
    size = float(rng.choice([-1.0, 1.0])) * 0.03 / radius**6
    return replace(rig, lens=replace(rig.lens, sixth_power=size))


@dataclass(frozen=True)
class Case:
    """One cause.

    Attributes:
        right: What should be announced, any of them; empty: nothing.
        also: What may be announced, too, because it is true as well.
        simulation: Fields of `SimulationOptions`.
        rig: Changes the rig.
        after: Changes the recording.
        held: The lens is fixed.
        lens_off: At values that are not this camera's.
        crooked, size: The board is bent, or as many times as large as in its file.
        board_only: It makes no sense without a board.
        knocked: By how far the board is turned (deg) and moved (m) at `AT_S`.
        sudden: The calibration changes at `AT_S`; it may take `NOTICED_S` to notice.
    """

    right: frozenset[Kind] = frozenset()
    also: frozenset[Kind] = frozenset()
    simulation: dict[str, Any] = field(default_factory=dict)
    rig: Callable[[Rig, np.random.Generator], Rig] = _exact
    after: Callable[[SimulatedRun], SimulatedRun] = lambda run: run
    held: bool = False
    lens_off: bool = False
    crooked: bool = False
    size: float = 1.0
    board_only: bool = False
    knocked: tuple[float, float] = (0.0, 0.0)
    sudden: bool = False


def _is(*right: Kind, **more: Any) -> Case:
    return Case(frozenset(right), **more)


def _rolling(axis: str) -> Callable[[Rig, np.random.Generator], Rig]:
    return lambda rig, _: replace(rig, readout_s=0.02, readout_axis=axis)


CASES: dict[str, Case] = {
    "none": Case(),
    "none, lens fixed": Case(held=True),
    "image stamps jitter by 1 ms": _is(Kind.STAMP_JITTER, simulation={"stamp_jitter_s": 1e-3}),
    "whole images off by 0.3 px": Case(simulation={"frame_sigma_px": 0.3}),
    "corner noise changes": Case(simulation={"noise_spread": 0.8}),
    "5 % outliers": Case(simulation={"outlier_fraction": 0.05}),
    "lens of one term more": _is(Kind.LENS_TERM_MISSING, rig=_one_term_more),
    "fixed lens wrong": _is(Kind.FIXED_LENS, held=True, lens_off=True),
    "board bent by 0.5 mm": _is(Kind.TARGET_SHAPE, crooked=True, board_only=True),
    "board 3 % larger": _is(Kind.TARGET_SIZE, size=1.03, board_only=True),
    "imu 0.3 %": _is(Kind.IMU_INTRINSICS, rig=partial(_matrices, 3e-3)),
    "imu 1 %": _is(Kind.IMU_INTRINSICS, rig=partial(_matrices, 1e-2)),
    "accelerometer 1 ms late": _is(Kind.ACCEL_LAG, simulation={"accel_lag_s": 1e-3}),
    "accelerometer axes 11 mm apart": _is(Kind.ACCEL_POSITIONS, rig=_axes_apart),
    "rows read in 20 ms": _is(Kind.ROLLING_SHUTTER, rig=_rolling("rows")),
    "columns read in 20 ms": _is(Kind.ROLLING_COLUMNS, rig=_rolling("columns")),
    "clocks 100 ppm apart": _is(Kind.CLOCK_DRIFT, rig=partial(_apart, 100.0, 0.0)),
    "clocks 15 ppm apart": _is(Kind.CLOCK_DRIFT, rig=partial(_apart, 15.0, 0.0)),
    "clocks 100 ppm apart from 20 s on": _is(*_DRIFT, rig=partial(_apart, 100.0, AT_S), sudden=True),
    "clocks 15 ppm apart from 20 s on": _is(*_DRIFT, rig=partial(_apart, 15.0, AT_S), sudden=True),
    "time shift steps by 2 ms": _is(Kind.TIMESHIFT_STEPPED, Kind.CLOCK_WANDER, rig=_stepped, sudden=True),
    "imu gap of 0.5 s": _is(Kind.IMU_GAP, after=partial(gaps.cut, "imu", 0.5)),
    "biases of the imu step by 0.3 deg/s and 0.05 m/s^2": _is(
        Kind.BIASES_STEPPED, rig=partial(_biases_step, 0.3, 0.05), sudden=True
    ),
    "bump": _is(*_BUMP, also=_OF_A_BUMP, rig=partial(_bumped, 2.0, 0.01), sudden=True),
    "camera moved by 5 mm": _is(*_BUMP, also=_OF_A_BUMP, rig=partial(_bumped, 0.0, 0.005), sudden=True),
    "camera moved by 3 mm": _is(*_BUMP, also=_OF_A_BUMP, rig=partial(_bumped, 0.0, 0.003), sudden=True),
    "camera turned by 0.3 deg": _is(*_BUMP, also=_OF_A_BUMP, rig=partial(_bumped, 0.3, 0.0), sudden=True),
    "lens zoomed by 1 %": _is(Kind.LENS_STEPPED, after=partial(_zoomed, 1.01), sudden=True, board_only=True),
    "board moved by 20 mm": _is(*_BOARD, knocked=(0.0, 0.02), board_only=True, sudden=True),
    "board moved by 200 mm and 20 deg": _is(*_BOARD, knocked=(20.0, 0.2), board_only=True, sudden=True),
}


def make_run(case: Case, seed: int, seconds: float, *, zoo: bool, target_free: bool) -> SimulatedRun:
    """The recording of one trial; a random mounting of the reference rig, or a random rig."""
    rng = np.random.default_rng([seed, 82])
    simulation: dict[str, Any] = {}
    if zoo:
        drawn, _ = draw(seed, 1.0, target_free=target_free)
        rig, points = drawn.rig, drawn.points_m
        simulation = {k: v for k, v in vars(drawn.options).items() if k != "epoch_ns" and k not in _CLEAN}
    else:
        shift_s = float(rng.uniform(-0.05, 0.05))
        R = reference_rig(seed).R_imu_cam @ exp_so3(0.1 * rng.standard_normal(3))
        rig = reference_rig(seed, timeshift_cam_imu_s=shift_s, R_imu_cam=R)
        points = room_landmarks(seed, 200) if target_free else board_points()
    rig, simulation = case.rig(rig, rng), simulation | case.simulation
    if target_free:
        return case.after(simulate_tracks(seed, seconds, rig=rig, landmarks_m=points, **simulation))
    true = case.size * (crooked_board(seed, points) if case.crooked else points)
    run = simulate(seed, seconds, rig=rig, points_m=true, **simulation)
    if any(case.knocked):
        turn, move = _random_move(*case.knocked, rng)
        middle = true.mean(axis=0)
        moved = simulate(
            seed, seconds, rig=rig, points_m=(true - middle) @ exp_so3(turn).T + middle + move, **simulation
        )
        frames = [f for f in run.frames if f.t_s < AT_S] + [f for f in moved.frames if f.t_s >= AT_S]
        run = replace(run, frames=frames)
    return replace(case.after(run), points_m=points)


def trial(name: str, seconds: float, zoo: bool, target_free: bool, seed: int) -> runner.Result:
    """One recording with one cause."""
    case = CASES[name]
    run = make_run(case, seed, seconds, zoo=zoo, target_free=target_free)
    prior = camera_prior(run, seed, StartErrors(), exact_lens=case.held)
    prior = replace(prior, readout_s=0.0, readout_axis="")
    if case.lens_off:
        prior = with_lens_off(prior, seed, stated=False)
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"} if case.held else ()),
        target_free=target_free,
        imu_noise=imu_noise(run),
    )
    record = feed(run, CalibratorSubject(options, prior, None if target_free else run.points_m), LOOK_S)
    return summary(record, 7, []) | {"rig": {"lens": run.rig.lens.model, "rate": run.options.camera_rate_hz}}


def announced(result: runner.Result) -> list[tuple[float, str, float]]:
    """What was announced as a cause: when, kind, value."""
    return [
        (t_s, event["kind"], event["value"])
        for t_s, event in result["events"]
        if event["kind"] not in {str(kind) for kind in _FACTS}
    ]


def applies(case: Case, result: runner.Result) -> bool:
    """Whether the cause exists for this rig: a fisheye lens has no term that `plumb_bob` adds."""
    return Kind.LENS_TERM_MISSING not in case.right or result["rig"]["lens"] == "radtan"


def row(name: str, results: list[runner.Result]) -> str:
    """One line of the confusion table."""
    case = CASES[name]
    results = [r for r in results if r["trace"]["t_s"] and applies(case, r)]
    right = {str(kind) for kind in case.right}
    also = right | {str(kind) for kind in case.also}
    kinds = [{kind for _, kind, _ in announced(r)} for r in results]
    when = [min(t for t, kind, _ in announced(r) if kind in right) for r in results if _any(r, right)]
    found = f"{len(when)} of {len(results)}" if right else "(nothing)"
    wrong = Counter(kind for said in kinds for kind in said - also)
    others = ", ".join(f"{kind} {count}" for kind, count in wrong.most_common()) or "-"
    at = f"{np.median(when):.0f} / {max(when):.0f}" if when else "-"
    rigs = sum(bool(said - also) for said in kinds)
    lies, longest_s = sum(_lies(case, r) for r in results), max(map(_lied_s, results), default=0.0)
    converged = sum(r["trace"]["status"][-1] == "converged" for r in results)
    return (
        f"| {name} | {len(results)} | {found} | {at} | {rigs} | {others} "
        f"| {converged} | {lies} | {longest_s:g} |"
    )


def _lies(case: Case, result: runner.Result) -> bool:
    """Whether it was ever `converged` beyond 5 sigma, but for the time in which a change is noticed."""
    trace = result["trace"]
    at = [k for k, t_s in enumerate(trace["t_s"]) if not (case.sudden and AT_S <= t_s < AT_S + NOTICED_S)]
    return lying({"trace": {key: [trace[key][k] for k in at] for key in ("status", "error", "sigma")}})


def _lied_s(result: runner.Result) -> float:
    """For how long it was `converged` beyond 5 sigma, s, in which a change cannot be noticed yet included."""
    trace = result["trace"]
    looks = zip(trace["status"], trace["error"], trace["sigma"], strict=True)
    wrong = sum(lying({"trace": {"status": [s], "error": [e], "sigma": [d]}}) for s, e, d in looks)
    return LOOK_S * wrong


def _any(result: runner.Result, kinds: set[str]) -> bool:
    return any(kind in kinds for _, kind, _ in announced(result))


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks attribution", description=__doc__)
    runner.add_arguments(parser, trials=30, seconds=30.0)
    parser.add_argument("--zoo", action="store_true", help="random rigs instead of the reference rig")
    parser.add_argument("--target-free", action="store_true", help="unknown landmarks instead of a board")
    parser.add_argument("--list", action="store_true", help="print every wrong announcement, too")
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon/estimation", "benchmarks/attribution.py", "mocks/vical_mocks")
    print(
        "| cause | rigs | announced | after s (median / worst) | rigs with another announcement | which "
        "| converged at the end | converged beyond 5 sigma | for s (worst) |\n"
        "|---|---|---|---|---|---|---|---|---|"
    )
    kind = ("free" if args.target_free else "board") + ("_zoo" if args.zoo else "")
    wrong = []
    for name in args.case or CASES:
        if args.target_free and CASES[name].board_only:
            continue
        work = partial(trial, name, args.seconds, args.zoo, args.target_free)
        store = f"attribution_{kind}_{runner.slug(name)}_{args.seconds:g}s"
        results = runner.run_trials(store, work, runner.seeds_of(args), args, code)
        print(row(name, results), flush=True)
        also = {str(k) for k in CASES[name].right | CASES[name].also}
        for seed, result in zip(runner.seeds_of(args), results, strict=True):
            wrong += [
                f"{name}, seed {seed}: {what} {value if value is None else f'{value:.3g}'} after {t_s:.0f} s"
                for t_s, what, value in announced(result)
                if what not in also
            ]
    if args.list:
        print("\n" + "\n".join(wrong))
    return 0
