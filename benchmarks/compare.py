"""Are the differences that `vical compare` finds as large as it says? Independent halves of rigs of the zoo.

python -m benchmarks compare --trials 30
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
from vical_mocks.harness.feed import CAMERA, StartErrors, camera_prior
from vical_mocks.random_rigs import draw

from benchmarks import runner
from benchmarks.verify import estimate
from vical_daemon.estimation.result import Status
from vical_daemon.results.compare import FALSE_ALARM, judge
from vical_daemon.results.difference import difference
from vical_daemon.results.export import rig_from_estimate
from vical_daemon.results.known import keys, known_cameras

_MEDIAN_Z = 0.6745  # median of |z| of a normal distribution


def trial(target_free: bool, seconds: float, seed: int) -> runner.Result:
    """One rig, calibrated on two days: motion, biases and noise are independent."""
    known, statuses = [], []
    for day in (0, 1):
        run, _ = draw(seed, seconds, target_free=target_free, day=day)
        prior = camera_prior(run, seed, StartErrors(), exact_lens=True)
        last = estimate(run, prior, target_free=target_free)
        statuses.append(str(last.status))
        if not last.cameras:
            return {"z": None, "statuses": statuses}
        known.append(known_cameras(rig_from_estimate(last), "half")[CAMERA])
    apart = difference(*known)
    verdict = judge(apart)
    z = (apart.d / apart.sigma).tolist()
    return {
        "z": z,
        "statuses": statuses,
        "names": keys(apart.model, lens=True),
        "chi_square": verdict.chi_square,
        "p": verdict.probability,
    }


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks compare", description=__doc__)
    runner.add_arguments(parser, trials=30, seconds=12.0)
    parser.add_argument("--target-free", action="store_true", help="unknown landmarks instead of a board")
    args = parser.parse_args(argv)
    name = f"compare_{'free' if args.target_free else 'board'}_{args.seconds:g}s"
    code = runner.fingerprint("vical_daemon", "benchmarks", "mocks/vical_mocks")
    work = partial(trial, args.target_free, args.seconds)
    everything = runner.run_trials(name, work, runner.seeds_of(args), args, code)
    results = [r for r in everything if r["z"] and Status.INCONSISTENT not in r["statuses"]]
    without = sum(r["z"] is None for r in everything)
    print(
        f"no result: {without} pairs; inconsistent: {len(everything) - without - len(results)}; the others:\n"
    )
    z, p = runner.array(results, "z"), runner.array(results, "p")
    print(
        "| pairs | RMS of z (by its median): position | rotation | time shift | lens "
        "| chi2 / 15: median, mean | changed |"
    )
    print("|---|---|---|---|---|---|---|")
    rms = [
        f"{np.sqrt(np.mean(z[:, at] ** 2)):.2f} ({np.median(np.abs(z[:, at])) / _MEDIAN_Z:.2f})"
        for at in (slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 15))
    ]
    ratio = runner.array(results, "chi_square") / 15.0
    print(
        f"| {len(results)} | {' | '.join(rms)} | {np.median(ratio):.2f}, {np.mean(ratio):.2f} "
        f"| {int(np.sum(p < FALSE_ALARM))} |"
    )
    return 0
