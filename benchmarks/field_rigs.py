"""The faults of `python -m benchmarks field` on simulated rigs, with a board and without one.

    python -m benchmarks field --rigs                   a board, the reference rig mounted anyhow
    python -m benchmarks field --rigs --target-free     unknown landmarks
    python -m benchmarks field --rigs --zoo             random rigs

Each rig is recorded without any fault, too: 25 s, lens free. A row counts the rigs that answer; those within
3 joint sigma of their undisturbed answer, over rotation, lever arm and time shift; those of which the right
cause was reported; those of which another one was, or a bump; and gives the CPU time over the undisturbed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from vical_mocks.curves import Pause
from vical_mocks.harness.feed import StartErrors, camera_prior, imu_noise
from vical_mocks.points import SimulatedRun
from vical_mocks.rig import Rig

from benchmarks import attribution, runner
from benchmarks.field import FAULTS, Data, clipped, difference, write
from vical_daemon.config.priors import Initial
from vical_daemon.estimation.events import EventKind as Kind
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.offline.calibrate import document, run_job
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.input_diagnosis import diagnose_input

REST_S, AT_S = 60.0, 15.0
_CLIPPED_SHARE = 0.1  # of the readings
_SLIDING_SHARE, _SLIDE_PX_S = 0.1, 3.0  # of the tracks, by how much
_CHANGES = {str(k) for k in (Kind.BUMPED, Kind.STARTED_OVER, Kind.CAMERA_MOVED, Kind.CAMERA_TURNED)}
_FACTS = {str(k) for k in (Kind.IMAGE_GAP, Kind.STARTED_ANEW, Kind.WENT_ON)}

Change = Callable[[Data, np.random.Generator], Data]


@dataclass(frozen=True)
class Fault:
    """What a real device does to a recording.

    Attributes:
        change: Of the recording.
        kinds: Events that report it; empty: none is needed.
        text: Part of a warning or of the error that reports it.
        counted: What of `left_out` counts it.
        answers: There is to be a calibration; otherwise the error is to name the mistake.
        rest: The rig rests before it moves.
        moving: Share of the landmarks that move.
    """

    change: Change = lambda data, _: data
    kinds: frozenset[str] = frozenset()
    text: str = ""
    counted: str = ""
    answers: bool = True
    rest: bool = False
    moving: float = 0.0


def _clip(columns: slice, data: Data, rng: np.random.Generator) -> Data:  # noqa: ARG001
    """At the rail that a tenth of the readings reach on one axis or another."""
    largest = np.abs(data.six[:, columns]).max(axis=1)
    return clipped(data, columns, float(np.quantile(largest, 1.0 - _CLIPPED_SHARE)))


def _swapped(data: Data, rng: np.random.Generator) -> Data:
    """One reading in fifty is written twice, another before the one that came first."""
    n = len(data.t_ns)
    order = np.repeat(np.arange(n), 1 + (rng.random(n) < 0.02))
    at = np.flatnonzero(rng.random(len(order) - 1) < 0.02)[::2]
    order[at], order[at + 1] = order[at + 1], order[at].copy()
    return replace(data, t_ns=data.t_ns[order], six=data.six[order])


def _gap(data: Data, rng: np.random.Generator) -> Data:  # noqa: ARG001
    since_s = (data.t_ns - data.t_ns[0]) * 1e-9
    kept = (since_s < AT_S) | (since_s >= AT_S + 0.5)
    return replace(data, t_ns=data.t_ns[kept], six=data.six[kept])


def _frozen(data: Data, rng: np.random.Generator) -> Data:  # noqa: ARG001
    since_s = (data.t_ns - data.t_ns[0]) * 1e-9
    still = (since_s >= AT_S) & (since_s < AT_S + 1.0)
    six = data.six.copy()
    six[still] = six[np.flatnonzero(still)[0]]
    return replace(data, six=six)


def _outliers(data: Data, rng: np.random.Generator) -> Data:
    points = data.points.copy()
    out = rng.random(len(points)) < 0.05
    points["uv"][out] += rng.uniform(-20.0, 20.0, (int(out.sum()), 2))
    return replace(data, points=points)


def _sliding(data: Data, rng: np.random.Generator) -> Data:
    """Tracks that slide along an edge."""
    points = data.points.copy()
    ids, first, row = np.unique(points["id"], return_index=True, return_inverse=True)
    way = rng.standard_normal((len(ids), 2))
    way *= (rng.random(len(ids)) < _SLIDING_SHARE)[:, None] / np.linalg.norm(way, axis=1, keepdims=True)
    since_s = (points["t"] - points["t"][first][row]) * 1e-9
    points["uv"] += _SLIDE_PX_S * since_s[:, None] * way[row]
    return replace(data, points=points)


def _recycled(data: Data, rng: np.random.Generator) -> Data:
    """A front end that gives an id to a second point of the same image: one in two hundred."""
    points = data.points.copy()
    at = np.flatnonzero((points["t"][1:] == points["t"][:-1]) & (rng.random(len(points) - 1) < 0.005))
    points["id"][at + 1] = points["id"][at]
    return replace(data, points=points)


def _kinds(*kinds: Kind) -> frozenset[str]:
    return frozenset(str(kind) for kind in kinds)


BOTH: dict[str, Fault] = {
    "none": Fault(),
    "IMU stamped on arrival, delays of 2 ms": Fault(FAULTS["delayed"][1], text="even grid"),
    "IMU stamped on arrival, four at once": Fault(FAULTS["bursts"][1], text="even grid"),
    "IMU rows doubled and swapped": Fault(_swapped),
    "gyro clipped (10 % of the readings)": Fault(partial(_clip, slice(0, 3)), _kinds(Kind.IMU_CLIPPED)),
    "accelerometer clipped (10 %)": Fault(partial(_clip, slice(3, 6)), _kinds(Kind.IMU_CLIPPED)),
    "40 gyro spikes": Fault(FAULTS["spikes"][1], counted="imu_spikes"),
    "IMU gap of 0.5 s": Fault(_gap, _kinds(Kind.IMU_GAP)),
    "IMU frozen for 1 s": Fault(_frozen, _kinds(Kind.IMU_REPEATED)),
    "10 % of the images delivered twice": Fault(FAULTS["twice"][1], counted="images_repeated"),
    "two points with one id": Fault(_recycled, text="id seen twice"),
    "60 s at rest before": Fault(rest=True),
    "images stamped on arrival": Fault(FAULTS["late_images"][1], text="even grid"),
}
BOARD = BOTH | {
    "accelerometer negated": Fault(FAULTS["negated"][1], text="accelerometer", answers=False),
    "accelerometer's axes permuted": Fault(FAULTS["axes"][1], text="accelerometer", answers=False),
}
FREE = BOTH | {
    "5 % outliers": Fault(_outliers),
    "10 % of the tracks slide by 3 px/s": Fault(_sliding),
    "30 % of the tracks on things that move": Fault(moving=0.3),
}


def data_of(run: SimulatedRun) -> Data:
    """A simulated recording as the rows of its files."""
    row = np.dtype([("t", "<i8"), ("id", "<i8"), ("uv", "<f8", (2,))])
    points = np.zeros(sum(len(f.ids) for f in run.frames), row)
    points["t"] = np.repeat([f.t_cam_ns for f in run.frames], [len(f.ids) for f in run.frames])
    points["id"] = np.concatenate([f.ids for f in run.frames])
    points["uv"] = np.concatenate([f.uv_px for f in run.frames])
    return Data(run.t_imu_ns, np.hstack([run.gyro_rps, run.specific_force_mps2]), points)


def recording(fault: Fault, seed: int, seconds: float, *, zoo: bool, target_free: bool) -> SimulatedRun:
    """The recording of a rig without what is changed afterwards."""

    def rig(rig: Rig, _: np.random.Generator) -> Rig:
        motion = rig.trajectory.with_pauses([Pause(0.0, REST_S)]) if fault.rest else rig.trajectory
        return replace(rig, trajectory=motion)

    simulation = {"moving_fraction": fault.moving} if fault.moving else {}
    case = attribution.Case(rig=rig, simulation=simulation)
    seconds += REST_S if fault.rest else 0.0
    return attribution.make_run(case, seed, seconds, zoo=zoo, target_free=target_free)


def trial(name: str, seconds: float, zoo: bool, target_free: bool, seed: int) -> runner.Result:
    """One recording with one fault."""
    fault = (FREE if target_free else BOARD)[name]
    run = recording(fault, seed, seconds, zoo=zoo, target_free=target_free)
    rng = np.random.default_rng([seed, 27])
    prior = camera_prior(run, seed, StartErrors(), exact_lens=False)
    initial = Initial({"cam0": prior}, imu_noise(run))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "recording"
        write(fault.change(data_of(run), rng), folder, "tracks" if target_free else "corners")
        target = None if target_free else _target(run, Path(place) / "target.yaml")
        return _calibrate(folder, initial, target)


def _target(run: SimulatedRun, file: Path) -> str:
    """Write the file of a checkerboard."""
    columns, rows = (len(np.unique(np.round(run.points_m[:, k], 6))) for k in (0, 1))
    spacing = float(run.points_m[1, 0] - run.points_m[0, 0])
    keys = {"targetCols": columns, "targetRows": rows}
    keys |= {"rowSpacingMeters": spacing, "colSpacingMeters": spacing}
    file.write_text(json.dumps({"target_type": "checkerboard"} | keys))
    return str(file)


def _calibrate(folder: Path, initial: Initial, target: str | None) -> runner.Result:
    """Do as `vical calibrate` does; what counts of its result."""
    begin_s = time.process_time()
    try:
        job = make_job(open_recording(folder), initial, target=target)
    except RecordingError as error:
        return {"status": "refused", "said": str(error), "cameras": {}, "events": [], "cpu_s": 0.0}
    result: dict[str, Any] = json.loads(json.dumps(document(job, run_job(job, lambda *_: None))))
    result["cpu_s"] = time.process_time() - begin_s
    lost = result["status"] in ("waiting", "initialising", "inconsistent") or not result["cameras"]
    result["said"] = (diagnose_input(job) if lost else "") or result["reason"]
    kept = ("status", "said", "cameras", "events", "cpu_s", "warnings", "left_out")
    return {key: result[key] for key in kept}


def row(name: str, fault: Fault, results: list[runner.Result], undisturbed: list[runner.Result]) -> str:
    """One line of the table."""
    pairs = [p for p in zip(results, undisturbed, strict=True) if p[1]["cameras"]]
    both = [(r, u) for r, u in pairs if r["cameras"]]
    away = [difference(r, u) for r, u in both]
    reported = sum(_reported(fault, r) for r, _ in pairs)
    others = Counter(kind for r, u in pairs for kind in _others(fault, r, u))
    bumps = sum(bool(_CHANGES & {e["kind"] for e in r["events"]}) for r, _ in pairs)
    cpu = [r["cpu_s"] / u["cpu_s"] for r, u in both]
    ends = Counter(r["status"] for r, _ in pairs)
    cells = (
        f"{len(both)} of {len(pairs)}",
        ", ".join(f"{status} {count}" for status, count in ends.most_common()),
        f"{sum(d <= 3.0 for d in away)} of {len(away)}",
        f"{np.median(away):.1f} / {max(away):.1f}" if away else "-",
        f"{reported} of {len(pairs)}" if fault.kinds or fault.text or fault.counted else "(nothing)",
        ", ".join(f"{kind} {count}" for kind, count in others.most_common()) or "-",
        str(bumps),
        f"{np.median(cpu):.1f} / {max(cpu):.1f}" if cpu else "-",
    )
    return f"| {name} | " + " | ".join(cells) + " |"


def _reported(fault: Fault, result: runner.Result) -> bool:
    if fault.counted:
        return bool(result.get("left_out", {}).get(fault.counted))
    texts = [result["said"], *result.get("warnings", []), *(e.get("text", "") for e in result["events"])]
    return bool(
        fault.kinds & {e["kind"] for e in result["events"]}
        or (fault.text and any(fault.text in text for text in texts))
    )


def _others(fault: Fault, result: runner.Result, undisturbed: runner.Result) -> set[str]:
    usual = {e["kind"] for e in undisturbed["events"]} | _FACTS | fault.kinds
    return {e["kind"] for e in result["events"]} - usual


def study(args: argparse.Namespace) -> int:
    """Print the table."""
    faults = FREE if args.target_free else BOARD
    code = runner.fingerprint("vical_daemon", "benchmarks/field_rigs.py", "mocks/vical_mocks")
    kind = ("free" if args.target_free else "board") + ("_zoo" if args.zoo else "")
    print(
        "| fault | answered | status | within 3 sigma | difference, median / largest | right cause "
        "| another cause | bumps | CPU, median / largest |\n|---|---|---|---|---|---|---|---|---|"
    )
    kept = {}
    for name in dict.fromkeys(["none", *(args.case or faults)]):
        work = partial(trial, name, args.seconds, args.zoo, args.target_free)
        store = f"field_{kind}_{runner.slug(name)}"
        kept[name] = runner.run_trials(store, work, runner.seeds_of(args), args, code)
        print(row(name, faults[name], kept[name], kept["none"]), flush=True)
    return 0
