"""Which mechanisms of the estimation earn their place: each is taken away in turn.

    python -m benchmarks ablation                              all data, all mechanisms (hours)
    python -m benchmarks ablation --data euroc,rigs            some data
    python -m benchmarks ablation --only "noise scale"         some mechanisms (may be repeated)
    python -m benchmarks ablation --table                      the tables of what has been run
    python -m benchmarks ablation --firing                     how often target-free rules change a decision

Nothing in the product knows of it: `ablation_patches` changes the estimation while the study runs. It can
be interrupted; what has been run is in the folder --out.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import ablation_data as data
from benchmarks import runner, target_free
from benchmarks.ablation_board import BOARD
from benchmarks.ablation_disturbances import DISTURBANCES, disturbed
from benchmarks.ablation_firing import counted
from benchmarks.ablation_free import FREE
from benchmarks.ablation_patches import without
from benchmarks.ablation_tables import print_tables

NOTHING = "nothing (as it is)"
MECHANISMS = BOARD | FREE
Trial = tuple[str, str, int, "partial[runner.Result]"]
"""Data, case, seed, and what runs it."""
_EUROC = {"fixed": 0, "free": 0, "tracks": 0}
_RIGS, _FREE_RIGS, _OWN, _SEEDS = range(301, 305), range(301, 311), range(2), range(1)


def trials(wanted: set[str], name: str, compared: Collection[str] = ()) -> Iterator[Trial]:
    """What is to be run without a mechanism, or as it is.

    Args:
        wanted: Kinds of data.
        name: Of the mechanism, or `NOTHING`.
        compared: Mechanisms with which the estimation as it is will be compared; none: all.
    """
    asked = [name] if name in MECHANISMS else [m for m in MECHANISMS if not compared or m in compared]
    board = any(not MECHANISMS[m].free for m in asked)
    free = any(MECHANISMS[m].free or m in SHARED for m in asked)
    if "euroc" in wanted:
        for mode in _EUROC:
            if free if mode == "tracks" else board:
                yield "euroc", mode, 0, partial(data.euroc, mode)
    if "rigs" in wanted and board:
        for seed in _RIGS:
            yield "rigs", "", seed, partial(data.random_rig, False, seed)
    if "free_rigs" in wanted and free:
        for seed in _FREE_RIGS:
            yield "free_rigs", "", seed, partial(data.random_rig, True, seed)
    if "free_recordings" in wanted and free:
        for case in target_free.CASES:
            yield "free_recordings", case, 0, partial(data.recording, case)
    own = {fault for m in asked for fault in MECHANISMS[m].faults}
    for fault in data.FAULTS:
        kind = "free_faults" if fault.startswith("free:") else "faults"
        for seed in _OWN if kind in wanted and fault in own else ():
            yield kind, fault, seed, partial(data.faulty_rig, fault, seed)
    cases = {case for m in asked for case in MECHANISMS[m].disturbances}
    for kind, on, without_board in (("disturbances", board, False), ("free_disturbances", free, True)):
        for seed in _SEEDS if kind in wanted and on else ():
            for case in DISTURBANCES:
                if case in cases:
                    yield kind, case, seed, partial(disturbed, case, name, without_board, seed)


SHARED = {
    "camera clock set",
    "imu stamps remapped",
    "imu clipped",
    "imu spikes",
    "imu repeated",
    "images repeated",
}
"""Mechanisms with a board that also serve without."""
DATA = (
    *("euroc", "rigs", "faults", "disturbances"),
    *("free_rigs", "free_recordings", "free_faults", "free_disturbances"),
)


def main(argv: list[str]) -> int:
    """Run what is missing; print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks ablation", description=__doc__)
    parser.add_argument("--data", default=",".join(DATA), help=f"which data (default: {','.join(DATA)})")
    parser.add_argument("--only", action="append", help="only this mechanism (may be repeated)")
    parser.add_argument("--table", action="store_true", help="run nothing")
    parser.add_argument("--firing", action="store_true", help="count decisions that target-free rules change")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/raw"))
    parser.add_argument("--keep-old", action="store_true", help="accept stored results of other code")
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon/estimation", "mocks/vical_mocks")
    accepted = None if args.keep_old else code
    unknown = (set(args.data.split(",")) - set(DATA)) | (set(args.only or ()) - set(MECHANISMS))
    if unknown:
        parser.error(f"not known: {', '.join(sorted(unknown))}; mechanisms: {', '.join(MECHANISMS)}")
    if args.firing:
        _fire(args.data.split(","), args.only or list(FREE))
        return 0
    store = args.out / "ablation.jsonl"
    if not args.table:
        if "euroc" in args.data and not data.euroc_halves.FOLDER.is_dir():
            print(f"no recording at {data.euroc_halves.FOLDER}: leave euroc out with --data", file=sys.stderr)
            return 1
        _run(store, args.data.split(","), [NOTHING, *(args.only or MECHANISMS)], code, accepted)
    print_tables(_stored(store, accepted), NOTHING)
    return 0


def _run(store: Path, wanted: list[str], names: list[str], code: str, accepted: str | None) -> None:
    store.parent.mkdir(parents=True, exist_ok=True)
    done = {(r["mechanism"], r["data"], r["case"], r["seed"]) for r in _stored(store, accepted)}
    with store.open("a", encoding="utf-8") as file:
        for kind in wanted:
            for name in names:
                begin = time.process_time()
                with without(MECHANISMS.get(name)):
                    for which, case, seed, run in trials({kind}, name, names):
                        if (name, which, case, seed) in done:
                            continue
                        row = {"mechanism": name, "data": which, "case": case, "seed": seed, "code": code}
                        try:
                            row["result"] = run()
                        except (
                            np.linalg.LinAlgError,
                            ValueError,
                            AssertionError,
                            OverflowError,
                            KeyError,
                        ) as error:
                            row["result"] = {"failed": f"{type(error).__name__}: {error}"}
                        file.write(json.dumps(row, default=runner._plain) + "\n")
                        file.flush()
                print(f"{kind}, without {name}: {time.process_time() - begin:.0f} s", file=sys.stderr)


def _fire(wanted: list[str], names: list[str]) -> None:
    """Count on each piece of data; recordings and rigs without a board."""
    print("| data | runs | decisions changed by |\n|---|---|---|")
    for kind in wanted:
        total: Counter[str] = Counter()
        runs = 0
        for which, case, seed, run in trials({kind}, NOTHING, names):
            if which == "euroc" and case != "tracks":
                continue
            with counted() as counts:
                run()
            if +counts:
                print(f"{which} {case} {seed}: {dict(+counts)}", file=sys.stderr, flush=True)
            runs += 1
            total.update(dict.fromkeys(+counts, 1))
        print(f"| {kind} | {runs} | {', '.join(f'{k}: {n} runs' for k, n in total.items())} |", flush=True)


def _stored(store: Path, code: str | None) -> list[runner.Result]:
    """Results made by this code; None: by any."""
    if not store.exists():
        return []
    rows = []
    for line in store.read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:  # the last line of an interrupted run
            continue
    return [row for row in rows if code in (None, row.get("code"))]
