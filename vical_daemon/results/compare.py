"""The verdict on two calibrations: same or changed, and which part; docs/math/verify.md."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.estimation.significance import CALIBRATIONS_DISAGREE
from vical_daemon.results.difference import Difference
from vical_daemon.results.known import BLOCKS, keys

FALSE_ALARM = CALIBRATIONS_DISAGREE
"""Probability of `changed` for two calibrations of the same rig, if their sigmas are right."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a comparison says.

    Attributes:
        changed: The difference is more than chance.
        chi_square: Of all errors together.
        dof: Its degrees of freedom.
        probability: Of a larger one by chance.
        blocks: The fewest blocks that must differ; empty: none.
    """

    changed: bool
    chi_square: float
    dof: int
    probability: float
    blocks: tuple[str, ...]


def judge(difference: Difference) -> Verdict:
    """Test whether the difference is zero, and if not, which blocks are to blame."""
    everything = np.arange(len(difference.d))
    square, probability = _test(difference, everything)
    changed = probability < FALSE_ALARM
    blocks = _blocks(difference) if changed else ()
    return Verdict(changed, square, len(everything), probability, blocks)


@dataclass(frozen=True, slots=True)
class Direction:
    """The difference along one direction.

    Attributes:
        name: Of the block or parameter.
        unit: Of its values.
        axis: Unit vector, of position in the imu frame, of rotation in the camera frame; None: one number.
        value: Of B minus A along it.
        sigma: Joint standard deviation of that: what both leave open.
    """

    name: str
    unit: str
    axis: FloatArray | None
    value: float
    sigma: float

    @property
    def z(self) -> float:
        """The difference in joint sigmas."""
        return self.value / self.sigma


def directions(difference: Difference) -> list[Direction]:
    """Return the difference along the directions that both together know worst to best, and of the rest."""
    plain = difference.sigma / np.sqrt(np.diag(difference.covariance))
    S = difference.covariance * np.outer(plain, plain)
    found = []
    for name, unit in (("position", "m"), ("rotation", "rad")):
        at = BLOCKS[name]
        variances, axes = np.linalg.eigh(S[at, at])
        for k, word in zip((2, 1, 0), ("worst", "middle", "best"), strict=True):
            axis, value = axes[:, k], float(axes[:, k] @ difference.d[at])
            sign = 1.0 if value >= 0.0 else -1.0
            sigma = float(np.sqrt(variances[k]))
            found.append(Direction(f"{name}, {word} known", unit, sign * axis, sign * value, sigma))
    names = keys(difference.model, lens=difference.has_lens)
    for k in range(6, len(difference.d)):
        label, _, unit = names[k].partition("_") if k > 6 else ("time shift", "", "s")
        found.append(Direction(label, unit, None, float(difference.d[k]), float(difference.sigma[k])))
    return found


def _blocks(difference: Difference) -> tuple[str, ...]:
    """The fewest blocks without which the rest agrees; of as many, those that leave the best agreement."""
    present = [name for name in BLOCKS if name != "lens" or difference.has_lens]
    index = np.arange(len(difference.d))
    for count in range(1, len(present)):
        scored = []
        for blamed in combinations(present, count):
            out = np.concatenate([index[BLOCKS[name]] for name in blamed])
            scored.append((_test(difference, np.setdiff1d(index, out))[1], blamed))
        best, blamed = max(scored)
        if best >= FALSE_ALARM:
            return blamed
    return tuple(present)


def _test(difference: Difference, kept: IntArray) -> tuple[float, float]:
    """Sum of squares of some errors in joint sigmas, and the probability of a larger one."""
    d, S = difference.d[kept], difference.covariance[np.ix_(kept, kept)]
    scale = np.sqrt(np.diag(S))
    e = d / scale
    square = float(e @ np.linalg.solve(S / np.outer(scale, scale) + 1e-12 * np.eye(len(e)), e))
    return square, float(chdtrc(len(kept), square))
