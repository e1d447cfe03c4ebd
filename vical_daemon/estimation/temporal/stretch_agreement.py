"""Whether the stretches of a recording agree within their sigmas; if not, the sigmas are too small.

What the noise model does not know (stamps whose delay wanders, errors that last for seconds) shows where each
stretch is solved alone: its answers scatter by more than their sigmas. Their scatter then says how far to
trust the common answer [Birge, "The calculation of errors by the method of least squares", 1932].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.significance import PERHAPS_SIGMAS, chi_square_limit
from vical_daemon.estimation.temporal.drift_smoother import DriftProblem, solve
from vical_daemon.estimation.temporal.td_icp_input import MIN_ORIENTATIONS

STRETCHES = 6  # at most: their scatter is then known to a third


def widening(problem: DriftProblem, used: BoolArray, sensors: int) -> FloatArray:
    """By how much the sigmas of mounting and shift are too small, per sensor; 1 where the stretches agree.

    Args:
        problem: With the noises' sizes set; rows in order of time.
        used: Rows that take part, shape (n,).
        sensors: Their number S; parameters begin with mounting (3) and shift of each.

    Returns:
        Factors of [mounting, shift], at least 1, shape (S, 2).
    """
    found = []
    for rows in _stretches(problem, used, sensors):
        try:
            solution = solve(_part(problem, rows))
        except np.linalg.LinAlgError:
            continue
        p = 4 * sensors
        found.append((solution.x[:p], solution.covariance[:p, :p]))
    return np.array([scatter_factors(found, 4 * i) for i in range(sensors)])


def scatter_factors(found: Sequence[tuple[FloatArray, FloatArray]], first: int = 0) -> tuple[float, float]:
    """Return `scatter_factor` of mounting and shift, the three parameters from `first` on and the next one.

    Args:
        found: Parameters of each stretch, shape (p,), and their covariance, shape (p, p).
        first: Place of the mounting among them.
    """
    mounting, shift = (
        scatter_factor([x[part] for x, _ in found], [P[part, part] for _, P in found])
        for part in (slice(first, first + 3), slice(first + 3, first + 4))
    )
    return mounting, shift


def scatter_factor(values: Sequence[FloatArray], covariances: Sequence[FloatArray]) -> float:
    """Return by how much some values of one quantity scatter more than their covariances say.

    Args:
        values: Of shape (d,) each.
        covariances: Of shape (d, d) each.

    Returns:
        Root of chi-square over its degrees of freedom; 1 where chance alone may have done it.
    """
    if len(values) < 2:
        return 1.0
    information = np.linalg.inv(np.stack(covariances))
    x = np.stack(values)
    mean = np.linalg.solve(information.sum(axis=0), np.einsum("kij,kj->i", information, x))
    chi2 = float(np.einsum("ki,kij,kj->", x - mean, information, x - mean))
    freedom = x.size - x.shape[1]
    return float(np.sqrt(chi2 / freedom)) if chi2 > chi_square_limit(freedom, PERHAPS_SIGMAS) else 1.0


def _stretches(problem: DriftProblem, used: BoolArray, sensors: int) -> list[slice]:
    """Cut the rows so that the information on the shifts is divided evenly: rest is no stretch of its own."""
    count = min(STRETCHES, int(np.count_nonzero(used)) // MIN_ORIENTATIONS)
    if count < 2:
        return []
    by_shift = problem.J[:, :, 3 : 4 * sensors : 4].sum(axis=2)
    total = np.cumsum(np.einsum("ki,kij,kj->k", by_shift, problem.weight, by_shift))
    cuts = np.searchsorted(total, total[-1] * np.arange(1, count) / count)
    edges = np.unique(np.concatenate(([0], cuts, [len(total)])))
    return [
        slice(a, b)
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
        if np.count_nonzero(used[a:b]) >= MIN_ORIENTATIONS // 2
    ]


def _part(problem: DriftProblem, rows: slice) -> DriftProblem:
    steps = slice(rows.start, rows.stop - 1)
    return replace(
        problem,
        e=problem.e[rows],
        J=problem.J[rows],
        H=problem.H[rows],
        weight=problem.weight[rows],
        F=problem.F[steps],
        Q_inverse=problem.Q_inverse[steps],
    )
