"""Allan analysis of five simulated four-hour recordings of a GX3-25 at rest, per axis, and the truth."""

from __future__ import annotations

import argparse
import time

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.tools.noise_densities import FLICKER, allan_curve, fit_noise

RATE_HZ = 100.0
# White noise N (U/sqrt(Hz)) and rate random walk K (U/s/sqrt(Hz)) of each axis: the class of a GX3-25.
# The 15 ms average sampled every 10 ms weights the 5 ms blocks 2/3, 1/3: white noise folds down and its
# density in the samples is sqrt(10/9) of that before. Truth below is what the samples have.
FOLDING = np.sqrt(10.0 / 9.0)
GYRO = {"x": (3.6e-4, 1.2e-5), "y": (4.1e-4, 1.5e-5), "z": (3.8e-4, 1.0e-5)}
ACCEL = {"x": (9.5e-4, 2.4e-5), "y": (1.2e-3, 3.0e-5), "z": (1.5e-3, 2.0e-5)}


def record(rng: np.random.Generator, seconds: float, density: float, walk: float) -> FloatArray:
    """One axis at rest: 1 kHz noise through the device's 15 ms average, every tenth sample, plus a walk.

    Blocks of 5 ms are drawn at once: a 15 ms mean is the mean of three of them, every tenth sample two on.
    """
    count = int(seconds * RATE_HZ)
    blocks = density / FOLDING * np.sqrt(200.0) * rng.standard_normal(2 * count + 1)
    white = (blocks[0:-2:2] + blocks[1:-1:2] + blocks[2::2]) / 3.0
    return white + np.cumsum(walk / np.sqrt(RATE_HZ) * rng.standard_normal(count))


def floor(density: float, walk: float) -> float:
    """Bias instability that white noise and walk alone give: lowest Allan deviation / 0.664."""
    return float(np.sqrt(2.0 * density * walk / np.sqrt(3.0) / FLICKER))


def study(axes: dict[str, tuple[float, float]], units: tuple[str, str], factors: tuple[float, float],
          trials: int, hours: float, seed: int) -> list[list[float]]:  # fmt: skip
    """Analyse every axis and print one table; returns (estimate - truth) / sigma of density and walk."""
    print(
        f"\n| axis | white noise, {units[0]}: truth | mean of {trials} | scatter | reported sigma | "
        f"bias instability, {units[1]}: floor | mean | scatter | rate random walk: truth | mean | scatter | "
        "reported sigma |"
    )
    print("|---|" + "---:|" * 11)
    scores = []
    for number, (axis, (density, walk)) in enumerate(axes.items()):
        fits = []
        for trial in range(trials):
            rng = np.random.default_rng([seed, number, trial])
            fits.append(fit_noise(allan_curve(record(rng, 3600.0 * hours, density, walk), RATE_HZ)))
            fit = fits[-1]
            scores.append([
                (fit.density.value - density) / fit.density.sigma, (fit.walk.value - walk) / fit.walk.sigma
            ])  # fmt: skip
        n, k, b = (
            np.array([getattr(f, name).value for f in fits]) for name in ("density", "walk", "instability")
        )
        n_sigma = np.mean([f.density.sigma for f in fits])
        k_sigma = np.mean([f.walk.sigma for f in fits])
        white, bias = factors
        print(
            f"| {axis} | {white * density:.4g} | {white * n.mean():.4g} | {white * n.std(ddof=1):.2g} | "
            f"{white * n_sigma:.2g} | {bias * floor(density, walk):.3g} | {bias * b.mean():.3g} | "
            f"{bias * b.std(ddof=1):.2g} | {walk:.2e} | {k.mean():.2e} | {k.std(ddof=1):.1e} | "
            f"{k_sigma:.1e} |"
        )
    return scores


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks allan", description=__doc__)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--hours", type=float, default=4.0)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(argv)
    begin_s = time.process_time()
    print(f"{args.trials} trials of {args.hours:g} h at {RATE_HZ:g} Hz, seed {args.seed}")
    scores = study(
        GYRO, ("deg/sqrt(h)", "deg/h"), (60 * 57.29578, 3600 * 57.29578), args.trials, args.hours, args.seed
    )
    scores += study(ACCEL, ("m/s/sqrt(h)", "mg"), (60.0, 101.9716), args.trials, args.hours, args.seed + 1)
    spread = np.sqrt(np.mean(np.square(scores), axis=0))
    print(f"\nRMS of (estimate - truth) / reported sigma: white noise {spread[0]:.2f}, walk {spread[1]:.2f}")
    print(f"CPU: {time.process_time() - begin_s:.0f} s")
    return 0
