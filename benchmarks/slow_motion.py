"""Slow motion before a board: is the lever arm where its sigmas say?

The reference rig, moved at several mean angular rates. Error of the lever arm along the optical axis over its
stated sigma (mean and RMS over the trials), and the mean stated sigma over the Cramér-Rao bound.
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
from vical_mocks.cramer_rao.bound import bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from benchmarks import runner
from vical_daemon.estimation.measurements import CalibrationOptions

RATES_DPS = (10.0, 15.0, 20.0, 30.0, 55.0)
CORNER_SIGMA_PX = 0.2


def trial(rate_dps: float, seconds: float, seed: int) -> runner.Result:
    """Error, sigma and bound of the lever arm along the optical axis at the end, m."""
    rig = reference_rig(seed, mean_rate_dps=rate_dps, timeshift_cam_imu_s=0.02)
    run = simulate(seed, seconds, rig=rig, corner_sigma_px=CORNER_SIGMA_PX, camera_rate_hz=10.0)
    prior = camera_prior(run, seed, StartErrors(), exact_lens=True)
    record = feed(run, CalibratorSubject(CalibrationOptions(imu_noise=imu_noise(run)), prior, run.points_m))
    if not record.snapshots:
        return {"status": "no start"}
    last, axis = record.snapshots[-1], np.asarray(rig.R_imu_cam)[:, 2]
    bound = bounds(run, BoundOptions(corner_sigma_px=CORNER_SIGMA_PX))[-1].block("p_imu_cam")
    return {
        "status": last.status,
        "error_m": float(axis @ last.error[:3]),
        "sigma_m": float(np.sqrt(axis @ last.covariance[:3, :3] @ axis)),
        "bound_m": float(np.sqrt(axis @ bound @ axis)),
    }


def main(argv: list[str]) -> int:
    """Print one row for each rate."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks slow_motion", description=__doc__)
    runner.add_arguments(parser, trials=8, seconds=20.0)
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon", "benchmarks/slow_motion.py", "mocks/vical_mocks")
    print("| mean rate deg/s | started | converged | error mm, mean | z, mean | z, RMS | sigma over bound |")
    print("|---|---|---|---|---|---|---|")
    for rate_dps in RATES_DPS:
        name = f"slow_motion_{rate_dps:g}_{args.seconds:g}s"
        work = partial(trial, rate_dps, args.seconds)
        results = runner.run_trials(name, work, runner.seeds_of(args), args, code)
        own = [r for r in results if "error_m" in r]
        if not own:
            continue
        error, sigma, bound = (np.array([r[k] for r in own]) for k in ("error_m", "sigma_m", "bound_m"))
        z, converged = error / sigma, sum(r["status"] == "converged" for r in own)
        print(
            f"| {rate_dps:g} | {len(own)}/{len(results)} | {converged} | {1e3 * error.mean():.1f} "
            f"| {z.mean():.1f} | {np.sqrt(np.mean(z**2)):.1f} | {np.mean(sigma / bound):.2f} |",
            flush=True,
        )
    return 0
