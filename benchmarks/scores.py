"""What is made of many trials: RMSE and the bound, honesty of the sigmas, coverage, tables and plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from benchmarks.runner import Result

FloatArray = npt.NDArray[np.float64]
BLOCKS = {
    "lever arm mm": (slice(0, 3), 1e3),
    "mounting deg": (slice(3, 6), 180 / np.pi),
    "time shift us": (slice(6, 7), 1e6),
}
LENS_BLOCKS = {"f px": (slice(7, 9), 1.0), "c px": (slice(9, 11), 1.0)}


def band(count: int, dof: int, level: float = 0.95) -> tuple[float, float]:
    """Interval in which the mean NEES per degree of freedom of `count` honest trials lies."""
    tail = (1 - level) / 2
    n = count * dof
    return float(chi2.ppf(tail, n) / n), float(chi2.ppf(1 - tail, n) / n)


@dataclass(frozen=True)
class Score:
    """One case at one time.

    Attributes:
        t_s: Time.
        trials: With an answer by then, of `asked`.
        asked: All trials.
        rmse: Per parameter (15).
        bound: Root mean square of the trials' bounds, per parameter.
        ratio: RMS of error over that trial's bound, per parameter.
        sigma_ratio: RMS of the claimed sigma over the bound.
        anees: Mean NEES of the block per degree of freedom.
        dof: Size of the block (7, or 15 with the lens).
    """

    t_s: float
    trials: int
    asked: int
    rmse: FloatArray
    bound: FloatArray
    ratio: FloatArray
    sigma_ratio: FloatArray
    anees: float
    dof: int


def score(results: Sequence[Result], t_s: float, dof: int) -> Score:
    """Scores at one of the times at which the trials hold a bound."""
    key = f"{t_s:g}"
    rows = [r["at"][key] for r in results if r["at"].get(key) is not None]
    error = np.array([row["error"] for row in rows]).reshape(-1, 15)
    sigma = np.array([row["sigma"] for row in rows]).reshape(-1, 15)
    bound = np.array([row["bound"] for row in rows]).reshape(-1, 15)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, sigma_ratio = rms(error / bound), rms(sigma / bound)
    anees = float(np.mean([row["nees"] for row in rows])) / dof if rows else float("nan")
    return Score(t_s, len(rows), len(results), rms(error), rms(bound), ratio, sigma_ratio, anees, dof)


def rms(x: FloatArray) -> FloatArray:
    """Root mean square over the trials; NaN where there are none."""
    return np.asarray(np.sqrt(np.mean(x**2, axis=0))) if len(x) else np.full(15, np.nan)


def coverage(results: Sequence[Result], dof: int, k: float = 3.0) -> tuple[float, float]:
    """Share of all (trial, second, parameter) errors within k sigma; and of the worst parameter."""
    inside = []
    for r in results:
        error, sigma = (np.array(r["trace"][name]).reshape(-1, 15)[:, :dof] for name in ("error", "sigma"))
        inside.append(np.abs(error) <= k * sigma)
    flat = np.concatenate(inside) if inside else np.zeros((0, dof))
    if not len(flat):
        return float("nan"), float("nan")
    return float(flat.mean()), float(flat.mean(axis=0).min())


HEADER = (
    "| case | t s | trials | lever arm mm: RMSE (bound) ratio | mounting deg | time shift us | f px | c px "
    "| worst ratio | largest reported sigma / bound | ANEES/dof [95 % band] | 3 sigma coverage |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def row(name: str, s: Score, covered: tuple[float, float]) -> str:
    """A Markdown row of the table that `HEADER` opens."""
    blocks = BLOCKS | (LENS_BLOCKS if s.dof == 15 else {})
    cells = []
    for where, unit in blocks.values():
        ratio = float(np.sqrt(np.mean(s.ratio[where] ** 2)))
        cells.append(f"{_number(s.rmse[where], unit)} ({_number(s.bound[where], unit)}) {ratio:.2f}")
    cells += ["-"] * (5 - len(cells))
    low, high = band(max(s.trials, 1), s.dof)
    worst, stated = (float(np.max(x[: min(s.dof, 11)])) for x in (s.ratio, s.sigma_ratio))
    honest = f"{s.anees:.2f} [{low:.2f}, {high:.2f}]"
    cover = f"{100 * covered[0]:.2f} % (worst {100 * covered[1]:.1f} %)"
    return (
        f"| {name} | {s.t_s:g} | {s.trials}/{s.asked} | "
        + " | ".join(cells)
        + f" | {worst:.2f} | {stated:.2f} | {honest} | {cover} |"
    )


def _number(values: FloatArray, unit: float) -> str:
    """RMS over the components of a block, in its unit."""
    return f"{unit * float(np.sqrt(np.mean(values**2))):.3g}"


def plot(results: Sequence[Result], dof: int, title: str, path: Path) -> None:
    """RMSE, claimed sigma and bound over time, and the NEES, as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    seconds = sorted({t for r in results for t in r["trace"]["t_s"]})
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), sharex=True)
    blocks: dict[str, Any] = dict(BLOCKS)
    for axis, (label, (where, unit)) in zip(axes.flat, blocks.items(), strict=False):
        curves: dict[str, list[float]] = {"RMSE": [], "claimed sigma": []}
        for t in seconds:
            at = [(r["trace"], r["trace"]["t_s"].index(t)) for r in results if t in r["trace"]["t_s"]]
            for name, key in (("RMSE", "error"), ("claimed sigma", "sigma")):
                values = np.array([trace[key][i][where] for trace, i in at])
                curves[name].append(unit * float(np.sqrt(np.mean(values**2))))
        for name, values_at in curves.items():
            axis.semilogy(seconds, values_at, label=name)
        keys = sorted({k for r in results for k, v in r["at"].items() if v is not None}, key=float)
        limits = [[r["at"][k]["bound"][where] for r in results if r["at"].get(k)] for k in keys]
        axis.semilogy(
            [float(k) for k in keys],
            [unit * float(np.sqrt(np.mean(np.square(v)))) for v in limits],
            "ko",
            label="bound",
        )
        axis.set_ylabel(label)
        axis.grid(visible=True, which="both", alpha=0.3)
    axes.flat[0].legend()
    honest = axes.flat[3]
    mean = [
        np.mean([r["trace"]["nees"][r["trace"]["t_s"].index(t)] for r in results if t in r["trace"]["t_s"]])
        / dof
        for t in seconds
    ]
    low, high = band(len(results), dof)
    honest.plot(seconds, mean, label="ANEES per dof")
    honest.axhspan(low, high, alpha=0.2, label="95 % band")
    honest.set_ylim(0, 3)
    honest.legend()
    for axis in axes[1]:
        axis.set_xlabel("time, s")
    figure.suptitle(title)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
