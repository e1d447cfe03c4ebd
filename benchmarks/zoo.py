"""Random rigs, far from the reference (`vical_mocks.random_rigs`): who is honest?

python -m benchmarks zoo --trials 40
python -m benchmarks zoo --trials 30 --target-free
python -m benchmarks zoo --trials 60 --all-off
    imu, board, clocks, stamps and shutter slightly off at once
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
from scipy.stats import chi2
from vical_mocks.harness.feed import (
    PARAMETERS,
    CalibratorSubject,
    StartErrors,
    assumed_gravity_mps2,
    camera_prior,
    feed,
    imu_noise,
)
from vical_mocks.random_rigs import draw, draw_all_off, draw_sampling

from benchmarks import runner, scores
from benchmarks.montecarlo import lying, summary
from vical_daemon.estimation.measurements import CalibrationOptions

_UNSURE = 1e-4  # probability of an honest answer with a larger normalised error


def trial(target_free: bool, imu_off: bool, all_off: bool, seconds: float, seed: int) -> runner.Result:
    """One rig, nothing given but its noise densities and a lens 3 % off."""
    if all_off:
        run, known, board_m = draw_all_off(seed, seconds, target_free=target_free)
    else:
        run, known = draw(seed, seconds, target_free=target_free, imu_off=imu_off)
        board_m = run.points_m
    prior = camera_prior(run, seed, StartErrors(0.03, 0.01 * run.rig.lens.resolution[0]), exact_lens=known)
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}) if known else frozenset(),
        target_free=target_free,
        gravity_mps2=assumed_gravity_mps2(seed),
        imu_noise=imu_noise(run),
    )
    subject = CalibratorSubject(options, prior, None if target_free else board_m)
    result = summary(feed(run, subject), 7, [])
    sampling = {k: v for k, v in vars(run.options).items() if k in draw_sampling(np.random.default_rng(0))}
    rate = run.rig.trajectory.mean_rate_dps(seconds)
    return result | {"rig": sampling | {"deg/s": rate, "f": run.rig.lens.intrinsics[0], "lens_known": known}}


def print_summary(name: str, results: list[runner.Result]) -> None:
    """One row for all rigs."""
    answered = [r for r in results if r["trace"]["t_s"]]
    last = [r["trace"]["status"][-1] for r in answered]
    ends = [r["trace"]["nees"][-1] / 7.0 for r in answered]
    every = np.concatenate([np.array(r["trace"]["nees"]) for r in answered])
    covered = scores.coverage(answered, 7)
    started = np.median([r["started_s"] for r in answered])
    print("| rigs | answered | converged | first answer s | NEES/7 at the end: median, mean | coverage |")
    print("|---|---|---|---|---|---|")
    print(
        f"| {name} | {len(answered)}/{len(results)} | {last.count('converged')} | {started:.0f} "
        f"| {np.median(ends):.2f}, {np.mean(ends):.2f} | {100 * covered[0]:.2f} % |"
    )
    beyond = float(np.mean(every > chi2.isf(_UNSURE, 7)))
    lies = sum(lying(r) for r in results)
    print(f"\nanswers with a normalised error beyond 1 in 10000: {100 * beyond:.2f} %; ", end="")
    print(f"rigs that ever said converged beyond 5 sigma: {lies}\n")


def print_suspects(results: list[runner.Result], seeds: range) -> None:
    """The rigs with the worst answers, and those without one."""
    for seed, r in zip(seeds, results, strict=True):
        rig = ", ".join(f"{k} {v:.3g}" for k, v in r["rig"].items() if v)
        if not r["trace"]["t_s"]:
            print(f"seed {seed}: no answer ({r['statuses'][-1][2]}); {rig}")
            continue
        error, sigma = (np.array(r["trace"][k])[:, :7] for k in ("error", "sigma"))
        z = np.abs(error) / sigma
        if z.max() > 4.5:
            second, which = np.unravel_index(int(z.argmax()), z.shape)
            at = f"{PARAMETERS[which]} {z.max():.1f} sigma off after {r['trace']['t_s'][second]:.0f} s"
            print(f"seed {seed}: {at}, said {r['trace']['status'][second]}; {rig}")


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks zoo", description=__doc__)
    runner.add_arguments(parser, trials=40, seconds=25.0)
    parser.add_argument("--target-free", action="store_true", help="unknown landmarks instead of a board")
    parser.add_argument("--imu-off", action="store_true", help="imus whose scale and alignment are not true")
    parser.add_argument(
        "--all-off", action="store_true", help="imu, board, clocks, stamps, shutter off at once"
    )
    args = parser.parse_args(argv)
    name = ("free" if args.target_free else "board") + ("_imu_off" if args.imu_off else "")
    name += "_all_off" if args.all_off else ""
    code = runner.fingerprint("vical_daemon/estimation", "benchmarks/zoo.py", "mocks/vical_mocks")
    results = runner.run_trials(
        f"zoo_{name}_{args.seconds:g}s",
        partial(trial, args.target_free, args.imu_off, args.all_off, args.seconds),
        runner.seeds_of(args),
        args,
        code,
    )
    print_summary(name, results)
    print_suspects(results, runner.seeds_of(args))
    return 0
