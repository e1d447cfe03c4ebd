"""Has a calibration changed? Odds of `unchanged` against `moved`, and against the least change that counts.

Both odds may be looked at after every image: a likelihood ratio exceeds 1/alpha at any time with a
probability of alpha at most, if its denominator is true [Ville 1939]. [docs/math/verify.md, eq. (1) to (4)]
"""

from __future__ import annotations

import math
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
SAME = 0.15
"""Where a model does not quite fit: standard deviation of the differences of a calibration that holds, over
what counts as a change."""
DOF_PER_S = 1.0
"""There, too, all sigmas may be too small by one factor, known as by one degree of freedom a second. On 24
stretches of EuRoC chi-square over its 15 degrees of freedom is 2 to 7 after 4 s, and 1.5 after 10 s."""
_SIZES = (1.0, 3.0, 10.0)  # a change, where there is one, is of the order of one of these times what counts
_DIRECTIONS = 400  # on the sphere; the worst of them is within 6 deg of the worst of all
SURE = 1.645
"""Sigmas: what is called visible is shown by 95 % of recordings."""


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


def visible_sigmas(size: int, dof: float) -> float:
    """Sigmas x from which a change is visible: the ratio of (4) is 1/MISSED where d is 1.645 sigma less.

    Args:
        size: Number of errors.
        dof: Of the scale of the sigmas.
    """
    log = 2.0 * math.log(1.0 / MISSED)
    square = log if math.isinf(dof) else (size + dof) * math.expm1(log / (size + dof))
    return SURE + math.sqrt(SURE**2 + square)


VISIBLE = visible_sigmas(0, math.inf)
"""The same for a model that fits: x^2/2 - 1.645 x = ln(1/MISSED)."""


def odds(
    d: FloatArray, S: FloatArray, stored: FloatArray, counts: FloatArray, seconds: float = math.inf
) -> Odds:
    """Return the odds of a difference between a recording and a stored calibration.

    Args:
        d: Recording minus stored, shape (n,).
        S: Its covariance, that of the stored calibration included, shape (n, n).
        stored: Covariance of the stored calibration alone, shape (n, n).
        counts: What counts as a change, of each error, shape (n,).
        seconds: Length of the recording, s, if the model does not quite fit it; infinite: it fits.
    """
    e, S, dof = d / counts, S / np.outer(counts, counts), DOF_PER_S * seconds
    if not math.isinf(dof):
        S = S + SAME**2 * np.eye(len(d))
    C = stored / np.outer(counts, counts)
    information = np.linalg.inv(S)
    pull = information @ e
    index = np.arange(len(d))
    present = {name: index[block] for name, block in BLOCKS.items() if len(index[block])}
    hypotheses = [
        _weigh(e, S, dof, names, [present[name] for name in names])
        for count in range(1, len(present) + 1)
        for names in combinations(present, count)
    ]
    logs = np.array([h.log for h in hypotheses])
    named = _fewest(hypotheses)
    moved, covariance = _moved(e, S, named.prior)
    stored_information = np.asarray(np.linalg.inv(C))
    holds, visible, floor = {}, {}, {}
    square_of_d, shown = float(e @ pull), visible_sigmas(len(e), dof)
    for name, at in present.items():
        block = np.ix_(at, at)
        ways = _ways(len(at))
        floor[name] = shown / math.sqrt(_least(stored_information[block], ways))
        size = max(1.0, floor[name])
        square = np.einsum("wi,ij,wj->w", ways, information[block], ways)
        away = square_of_d + float((size**2 * square - 2.0 * size * ways @ pull[at]).min())
        holds[name] = _log_density(square_of_d, len(e), dof) - _log_density(away, len(e), dof)
        visible[name] = shown / math.sqrt(float(square.min()))
    log_changed = float(np.logaddexp.reduce(logs) - math.log(len(logs)))
    return Odds(
        log_changed,
        named.names,
        moved * counts,
        covariance * np.outer(counts, counts),
        holds,
        visible,
        floor,
    )


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """Some blocks have changed.

    Attributes:
        log: Log of its odds against `as stored`.
        names: Of the blocks.
        prior: Likeliest covariance of the change, in units of what counts, shape (n, n).
    """

    log: float
    names: tuple[str, ...]
    prior: FloatArray


def _weigh(
    e: FloatArray, S: FloatArray, dof: float, names: tuple[str, ...], places: list[IntArray]
) -> _Hypothesis:
    """Odds of a change of some blocks: small or large, all sizes and kinds of it alike."""
    kinds = [shape * size**2 for shape in _shapes(len(e), places) for size in _SIZES]
    logs = [_log_odds(e, S, W, dof) for W in kinds]
    log = float(np.logaddexp.reduce(logs) - math.log(len(logs)))
    return _Hypothesis(log, names, kinds[int(np.argmax(logs))])


def _shapes(size: int, places: list[IntArray]) -> list[FloatArray]:
    """Covariances of a change of the size that counts, in units of it, shapes (size, size).

    A lens has changed either in what counts (both focal lengths alike, or its centre: it was focused, or has
    shifted), or altogether (it is another one).
    """
    every = np.zeros(size)
    every[np.concatenate(places)] = 1.0
    shapes = [np.diag(every)]
    lens = BLOCKS["lens"].start
    if every[lens:].any():
        ways = np.zeros((3, size))
        ways[:, lens:] = _ways(size - lens)[:3]
        every[lens:] = 0.0
        shapes.append(np.diag(every) + ways.T @ ways)
    return shapes


def _fewest(hypotheses: list[_Hypothesis]) -> _Hypothesis:
    """Return the likeliest of the hypotheses with the fewest blocks that the recording does not rule out.

    A block is named only where the recording cannot be explained without it: the odds against every
    hypothesis with fewer blocks exceed the bound of a false alarm.
    """
    best = max(h.log for h in hypotheses)
    possible = [h for h in hypotheses if h.log > best - math.log(1.0 / FALSE_ALARM)]
    return min(possible, key=lambda h: (len(h.names), -h.log))


def _log_density(square: float, size: int, dof: float) -> float:
    """Logarithm of Student's (or Gauss's) density at a squared distance, up to a constant.

    [Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989]
    """
    return -0.5 * (square if math.isinf(dof) else (dof + size) * math.log1p(square / dof))


def _log_odds(e: FloatArray, S: FloatArray, W: FloatArray, dof: float) -> float:
    """Log t(e; 0, S + W) - log t(e; 0, S): an error may have changed by N(0, W)."""
    root, wider = np.linalg.cholesky(S), np.linalg.cholesky(S + W)
    logs = np.log(np.diag(root)).sum() - np.log(np.diag(wider)).sum()
    near, far = np.linalg.solve(wider, e), np.linalg.solve(root, e)
    size = len(e)
    gain = _log_density(float(near @ near), size, dof) - _log_density(float(far @ far), size, dof)
    return float(logs) + gain


def _moved(e: FloatArray, S: FloatArray, W: FloatArray) -> tuple[FloatArray, FloatArray]:
    gain = np.linalg.solve(S + W, W).T
    return gain @ e, W - gain @ W


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
