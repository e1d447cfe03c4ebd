"""`vical demo`, many times: does each end `converged`, inside its own four sigma, and after how long?

    python -m benchmarks demos --trials 100 --seconds 20 --jobs 1     on an idle machine
    python -m benchmarks demos --trials 100 --seconds 20 --jobs 2     with both cores busy

Each finished run is one line of `benchmarks/results/raw/demos_*.jsonl`; a study that was stopped goes on.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from functools import partial

import numpy as np

from benchmarks import runner


def trial(seconds: float, seed: int) -> runner.Result:
    """One demo in a process of its own."""
    command = [sys.executable, "-m", "vical_daemon", "demo", "--json", "--quiet"]
    done = subprocess.run(
        [*command, "--seconds", f"{seconds:g}", "--seed", str(seed)],
        capture_output=True,
        text=True,
        timeout=seconds + 120.0,
        check=False,
    )
    why = done.stderr.strip().splitlines()[-1:] if done.returncode else []
    try:
        result = json.loads(done.stdout.strip().splitlines()[-1])
    except (IndexError, json.JSONDecodeError):
        return {"code": done.returncode, "why": why, "status": "none"}
    trace = result["trace"]
    converged = [p["t_s"] for p in trace if p["status"] == "converged"]
    return {
        "code": done.returncode,
        "why": why,
        "status": result["status"],
        "events": result.get("events", []),
        "first_s": trace[0]["t_s"] if trace else None,
        "converged_s": converged[0] if converged else None,
        "duration_s": result["duration_s"],
        "largest_sigmas": result.get("error", {}).get("largest_sigmas"),
    }


def main(argv: list[str]) -> int:
    """Run the study; 1 if a demo failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks demos", description=__doc__)
    runner.add_arguments(parser, trials=100, seconds=20.0)
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon", "drivers/vical_drivers", "mocks/vical_mocks")
    seeds = runner.seeds_of(args)
    name = f"demos_{args.seconds:g}s_{args.jobs}_at_once"
    results = runner.run_trials(name, partial(trial, args.seconds), seeds, args, code)
    good = [r for r in results if r["code"] == 0 and r["status"] == "converged"]

    def median(key: str) -> float:
        return float(np.median([r[key] for r in good if r.get(key) is not None] or [np.nan]))

    longer = sum(r["duration_s"] > args.seconds + 1.5 for r in good)
    print("| demos | converged | went on | first answer s | converged after s | error / sigma |  (medians)")
    print("|---|---|---|---|---|---|")
    print(
        f"| {args.seconds:g} s, {args.jobs} at once | {len(good)} of {len(results)} | {longer} "
        f"| {median('first_s'):.1f} | {median('converged_s'):.1f} | {median('largest_sigmas'):.1f} |"
    )
    for seed, r in zip(seeds, results, strict=True):
        if r not in good:
            print(f"seed {seed}: {r['status']}, exit {r['code']}: {' '.join(r['why'])}")
    return 0 if len(good) == len(results) else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
