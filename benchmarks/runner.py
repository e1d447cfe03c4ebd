"""Trials that can be interrupted: parallel over cores, one JSON line per finished trial, never done twice."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Result = dict[str, Any]
Trial = Callable[[int], Result]
_REPOSITORY = Path(__file__).resolve().parents[1]


@cache
def fingerprint(*folders: str) -> str:
    """Hash of the source in some folders or files : results of other code are not reused."""
    digest = hashlib.sha256()
    for folder in folders:
        place = _REPOSITORY / folder
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def add_arguments(parser: argparse.ArgumentParser, *, trials: int, seconds: float) -> None:
    """Options that every Monte-Carlo study has."""
    parser.add_argument("--trials", type=int, default=trials, help=f"trials per case (default {trials})")
    parser.add_argument(
        "--seconds", type=float, default=seconds, help=f"length of a trial (default {seconds:g})"
    )
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("benchmarks/results/raw"), help="where results are kept"
    )
    parser.add_argument("--case", action="append", help="only this case (may be repeated)")
    parser.add_argument("--keep-old", action="store_true", help="accept stored trials made by other code")


def seeds_of(args: argparse.Namespace) -> range:
    """The seeds that the options ask for."""
    return range(args.first_seed, args.first_seed + args.trials)


def slug(name: str) -> str:
    """The name of a case as part of a file's name."""
    return "".join(c if c.isalnum() else "_" for c in name)


def run_trials(
    name: str, trial: Trial, seeds: Iterable[int], args: argparse.Namespace, code: str
) -> list[Result]:
    """Run what is missing, return all results in order of their seeds.

    Args:
        name: Of the file in `args.out` that keeps the results.
        trial: Picklable function of the seed; its result must be JSON (numpy arrays and floats are fine).
        seeds: Trials wanted.
        args: From `add_arguments`.
        code: Fingerprint of the code under test.
    """
    store = args.out / f"{name}.jsonl"
    store.parent.mkdir(parents=True, exist_ok=True)
    done = _stored(store, None if args.keep_old else code)
    wanted = list(seeds)
    missing = [seed for seed in wanted if seed not in done]
    if missing:
        begin = time.monotonic()
        with store.open("a", encoding="utf-8") as file:
            for count, (seed, result) in enumerate(_results(trial, missing, args.jobs), 1):
                done[seed] = result
                line = json.dumps({"seed": seed, "code": code, "result": result}, default=_plain)
                file.write(line + "\n")
                file.flush()
                spent_s = time.monotonic() - begin
                left_s = spent_s / count * (len(missing) - count)
                print(f"\r{name}: {count}/{len(missing)}, {left_s:.0f} s left ", end="", file=sys.stderr)
        print(file=sys.stderr)
    # Through JSON also when fresh: what is reported must not depend on where it came from.
    return [json.loads(json.dumps(done[seed], default=_plain)) for seed in wanted]


def _stored(store: Path, code: str | None) -> dict[int, Result]:
    found: dict[int, Result] = {}
    if store.exists():
        for line in store.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:  # the last line of an interrupted run
                continue
            if code is None or entry["code"] == code:
                found[int(entry["seed"])] = entry["result"]
    return found


def _results(trial: Trial, seeds: Sequence[int], jobs: int) -> Iterable[tuple[int, Result]]:
    if jobs <= 1:
        for seed in seeds:
            yield seed, trial(seed)
        return
    with ProcessPoolExecutor(jobs) as pool:
        futures: dict[Future[Result], int] = {pool.submit(trial, seed): seed for seed in seeds}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.floating | np.integer | np.bool_):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON")


def array(results: Sequence[Result], *keys: str) -> npt.NDArray[np.float64]:
    """One entry of every result as an array (missing numbers are NaN)."""
    values = []
    for result in results:
        value: Any = result
        for key in keys:
            value = value[key]
        values.append(value)
    return np.array(values, dtype=np.float64)
