"""Has a calibration changed? Odds of `unchanged` against `moved`, and against the least change that counts.

Both odds may be looked at after every image: a likelihood ratio exceeds 1/alpha at any time with a
probability of alpha at most, if its denominator is true [Ville 1939]. [docs/math/verify.md, eq. (1) to (4)]
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.estimation.significance import CALIBRATIONS_DISAGREE
from vical_daemon.results.known import BLOCKS

FALSE_ALARM = CALIBRATIONS_DISAGREE
"""Bound of the probability to say `changed` of a calibration that holds."""
MISSED = 1e-2
"""Bound of the probability to say `holds` of a calibration of which one block has changed by what counts."""
PRIOR = 0.05
"""Probability of a change before the recording, one recording in twenty; for `probability_changed` alone."""
_WIDE = 3.0  # a change, where there is one, is of the order of this many times what counts
_DIRECTIONS = 400  # on the sphere; the worst of them is within 6 deg of the worst of all
_SURE = 1.645  # sigmas: what is called visible is shown by 95 % of recordings
VISIBLE = _SURE + math.sqrt(_SURE**2 + 2.0 * math.log(1.0 / MISSED))
"""Sigmas x from which a change is visible: x^2/2 - 1.645 x = ln(1/MISSED)."""


@dataclass(frozen=True, slots=True)
class Counts:
    """What counts as a change of one block.

    Attributes:
        rotation_rad: Angle.
        position_m: Distance.
        timeshift_s: Of the time shift.
        lens_share: Of the focal length: of fx and fy together, of cx, or of cy.
    """

    rotation_rad: float = float(np.deg2rad(0.2))
    position_m: float = 2e-3
    timeshift_s: float = 1e-3
    lens_share: float = 5e-3

    def of_errors(self, focal_px: float, size: int) -> FloatArray:
        """Of each error in its unit, shape (size,); of a distortion what moves the border as much.

        (The border lies at 0.7 focal lengths of a lens of 70 deg: k1 there moves a point by k1 * 0.7^2.)
        """
        pose = [self.position_m] * 3 + [self.rotation_rad] * 3 + [self.timeshift_s]
        lens = [self.lens_share * focal_px] * 4 + [2.0 * self.lens_share] * max(size - 11, 0)
        return np.array(pose + lens)[:size]


@dataclass(frozen=True, slots=True)
class Odds:
    """What one recording says up to now.

    Attributes:
        log_changed: Log of the odds of `changed` (all ways alike) against `as stored`, before any prior.
        blocks: Those that have moved, where something has: the fewest that explain the recording.
        moved: Change of every error under that hypothesis, in its unit, shape (n,).
        moved_covariance: Of it.
        log_holds: By block, log of the odds of `as stored` against the likeliest change that counts.
        visible: By block, the smallest change (in units of what counts) that would be seen.
        floor: By block, likewise if the recording were perfect: what the stored calibration leaves open.
    """

    log_changed: float
    blocks: tuple[str, ...]
    moved: FloatArray
    moved_covariance: FloatArray
    log_holds: dict[str, float]
    visible: dict[str, float]
    floor: dict[str, float]

    @property
    def probability(self) -> float:
        """Of a change, with `PRIOR`."""
        return 1.0 / (1.0 + (1.0 - PRIOR) / PRIOR * math.exp(-min(self.log_changed, 700.0)))

    @property
    def undecided(self) -> list[str]:
        """Blocks of which it is not known that they hold."""
        return [name for name, odds in self.log_holds.items() if odds < math.log(1.0 / MISSED)]


def odds(d: FloatArray, S: FloatArray, stored: FloatArray, counts: FloatArray) -> Odds:
    """Return the odds of a difference between a recording and a stored calibration.

    Args:
        d: Recording minus stored, shape (n,).
        S: Its covariance, that of the stored calibration included, shape (n, n).
        stored: Covariance of the stored calibration alone, shape (n, n).
        counts: What counts as a change, of each error, shape (n,).
    """
    e, S = d / counts, S / np.outer(counts, counts)
    C = stored / np.outer(counts, counts)
    information = np.linalg.inv(S)
    pull = information @ e
    index = np.arange(len(d))
    present = {name: index[block] for name, block in BLOCKS.items() if len(index[block])}
    hypotheses = [
        (_log_odds(e, S, places), names, places)
        for count in range(1, len(present) + 1)
        for names in combinations(present, count)
        for places in [np.concatenate([present[name] for name in names])]
    ]
    logs = np.array([log for log, _, _ in hypotheses])
    _, names, places = _fewest(hypotheses)
    moved, covariance = _moved(e, S, places)
    stored_information = np.asarray(np.linalg.inv(C))
    holds, visible, floor = {}, {}, {}
    for name, at in present.items():
        block = np.ix_(at, at)
        ways = _ways(len(at))
        floor[name] = VISIBLE / math.sqrt(_least(stored_information[block], ways))
        size = max(1.0, floor[name])
        square = np.einsum("wi,ij,wj->w", ways, information[block], ways)
        holds[name] = float((0.5 * size**2 * square - size * ways @ pull[at]).min())
        visible[name] = VISIBLE / math.sqrt(float(square.min()))
    log_changed = float(np.logaddexp.reduce(logs) - math.log(len(logs)))
    return Odds(
        log_changed,
        names,
        moved * counts,
        covariance * np.outer(counts, counts),
        holds,
        visible,
        floor,
    )


def _fewest(
    hypotheses: list[tuple[float, tuple[str, ...], IntArray]],
) -> tuple[float, tuple[str, ...], IntArray]:
    """Return the likeliest of the hypotheses with the fewest blocks that the recording does not rule out.

    A block is named only where the recording cannot be explained without it: the odds against every
    hypothesis with fewer blocks exceed the bound of a false alarm.
    """
    best = max(log for log, _, _ in hypotheses)
    possible = [h for h in hypotheses if h[0] > best - math.log(1.0 / FALSE_ALARM)]
    return min(possible, key=lambda h: (len(h[1]), -h[0]))


def _log_odds(e: FloatArray, S: FloatArray, places: Iterable[int]) -> float:
    """Log N(e; 0, S + W) - log N(e; 0, S), where some errors may have changed, N(0, W)."""
    with_change = S + _wide(len(e), places)
    root, wider = np.linalg.cholesky(S), np.linalg.cholesky(with_change)
    logs = np.log(np.diag(root)).sum() - np.log(np.diag(wider)).sum()
    squares = np.linalg.solve(root, e) @ np.linalg.solve(root, e)
    squares -= np.linalg.solve(wider, e) @ np.linalg.solve(wider, e)
    return float(logs + 0.5 * squares)


def _moved(e: FloatArray, S: FloatArray, places: Iterable[int]) -> tuple[FloatArray, FloatArray]:
    W = _wide(len(e), places)
    gain = np.linalg.solve(S + W, W).T
    return gain @ e, W - gain @ W


def _wide(size: int, places: Iterable[int]) -> FloatArray:
    variance = np.zeros(size)
    variance[list(places)] = _WIDE**2
    return np.diag(variance)


def _least(information: FloatArray, ways: FloatArray) -> float:
    return float(np.einsum("wi,ij,wj->w", ways, information, ways).min())


def _ways(size: int) -> FloatArray:
    """Changes that count of one block, in units of what counts, shape (w, size)."""
    if size == 1:
        return np.array([[1.0], [-1.0]])
    if size == 3:  # an even spiral on the sphere
        z = np.linspace(-1.0, 1.0, _DIRECTIONS)
        angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(_DIRECTIONS)
        r = np.sqrt(1.0 - z * z)
        return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    lens = np.zeros((3, size))
    lens[0, :2] = lens[1, 2] = lens[2, 3] = 1.0
    return np.concatenate([lens, -lens])
