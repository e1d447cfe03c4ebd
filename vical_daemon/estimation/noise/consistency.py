"""Measured consistency of the filter: how much larger innovations are than predicted, and how long they last.

Lens models that do not quite fit, blur, a board that is not quite flat and an IMU that is not quite linear
move all corners of an image together, and much the same way in the next images. To a filter that takes
corners as independent such errors look like information: on a real recording it then claims a tenth of a
millimetre where two halves of the data differ by some. Two numbers, both from the innovations projected on
the eight smooth modes of a plane's image, make it honest again:

* `scale` multiplies the variance of the corners until the innovations have the size they should have. It
  changes the weight of images against the IMU, so it moves slowly and within bounds.
* `factor` is the long-run variance of the innovations over the variance that the filter predicts: errors that
  last for k images are k times less informative than it counts. Until images have been seen for 15 s, it is
  extrapolated from shorter sums. It multiplies the *reported* covariance only;
  fed back into the gain it would run away (less weight for images, more drift, larger innovations). It also
  contains what `scale` cannot explain: at few images a second the predicted motion adds more to an innovation
  than the corners do.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.unscented import root, solve_lower
from vical_daemon.estimation.significance import LIKELY_SIGMAS, PERHAPS_SIGMAS, SURE_SIGMAS, chi_square_limit

MODES = 8  # of an image: the degrees of freedom of a homography
_TELLING = 30
"""Images after which a model that fits is believed to: sums over six of them are known to 20 %."""
_LASTS_S = 2.99  # no multiple of usual intervals, where rounding would decide
"""Errors of lens, target and motion change within so long: a board crosses the image, a hand turns back. On
EuRoC stretches of 2 to 4 s move the lever arm by 12 to 16 times the filter's variance; sums over
3 s say 14, those over 1 s 8."""
_SHARE = 0.2  # of all images, at most in one sum: the long-run variance is then known to 18 %
_FLOOR = 0.5  # excess of the long-run variance, as measured, below which sigmas stay: 1.2 times in sigma
_GAIN_START, _GAIN_END = 0.1, 0.01  # an image's share in the scale: memory of 10, later 100 images
_MAX_SCALE = 4.0
"""Corners twice as noisy as they look. What exceeds it at few images a second is the motion: with 16, the
corners of EuRoC at 5 Hz weigh so little that neither lens nor target is found to be off."""
_DEAD_BAND = 1.3  # of the scale: with a memory of 100 images of 8 modes, chance gives less than 1.15
_SETTLE = 10  # images: the first updates of a wide prior are not yet linear
_CUSUM_DRIFT = 1.6  # of the mean square, a step an image: it is 1 where the model holds
_CUSUM_LIMIT = 9.0  # of their sum; by chance below 1e-10 an image, see `learn`
_MOST = 5.0  # that one image counts
_LIMIT = chi_square_limit(MODES, LIKELY_SIGMAS)


def modes(uv: FloatArray) -> FloatArray:
    """Displacements that a change of pose can produce (shift, affine, perspective), RMS about 1.

    Args:
        uv: *Predicted* pixels, shape (n, 2). Over measured ones the modes would contain the very noise
            they are to be distinguished from.

    Returns:
        Columns, shape (2n, 8).
    """
    centred = uv - np.add.reduce(uv, axis=0) / len(uv)
    flat = centred.ravel()
    centred /= math.sqrt(float(flat @ flat) / len(flat)) + 1e-9
    half = 0.5 * centred
    out = np.zeros((len(uv), 2, MODES))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, 0, 2:4] = out[:, 1, 4:6] = centred
    np.multiply(half[:, :1], centred, out=out[:, :, 6])
    np.multiply(half[:, 1:], centred, out=out[:, :, 7])
    return out.reshape(-1, MODES)


def normalised(
    uv: FloatArray,
    innovation: FloatArray,
    ways: FloatArray,
    moves: FloatArray,
    sigma: FloatArray,
    hidden: FloatArray | None = None,
) -> FloatArray | None:
    """Innovation in the eight modes, each over its predicted standard deviation; arguments as `learn`.

    Returns:
        Shape (8,), or fewer where some are hidden, clipped at six; None where the corners do not span the
        modes.
    """
    if len(uv) < MODES:
        return None
    M = modes(uv)
    weighted = (M / np.repeat(sigma * sigma, 2)[:, None]).T
    try:
        L = root(weighted @ M)  # of the modes, Q L'
    except np.linalg.LinAlgError:
        return None
    diagonal = L.diagonal().tolist()
    if min(diagonal) < 1e-6 * max(diagonal):
        return None
    along = np.concatenate([weighted @ ways, (weighted @ innovation.ravel())[:, None]], axis=1)
    along = solve_lower(L, along)  # Q' of ways and innovation
    if hidden is not None:
        directions, size, _ = np.linalg.svd(along[:, :-1] @ hidden)
        along = directions[:, int(np.count_nonzero(size > 1.0)) :].T @ along
    state = along[:, :-1] @ moves
    out: FloatArray = along[:, -1] / np.sqrt(1.0 + np.vecdot(state, state))
    return np.minimum(np.maximum(out, -SURE_SIGMAS), SURE_SIGMAS)


class _Innovation(NamedTuple):
    """Of one image: its instant, s, and its innovation, normalised, shape (8,)."""

    t_s: float
    normal: FloatArray

    def __deepcopy__(self, memo: object) -> _Innovation:
        """Itself: it does not change."""
        return self


@dataclass(slots=True)
class Consistency:
    """Running scale and factor of one camera.

    Attributes:
        memory: Images remembered.
        scale: Multiplies the variance of the corners, >= 1.
        factor: Multiplies the reported covariance, >= 1.
        images: Images taken in.
        alarm: Cumulated excess of the innovations over their usual level; see `alarmed`.
        suspicion: Likewise, with images that were refused; see `suspicious`.
    """

    memory: float = 800.0
    scale: float = 1.0
    factor: float = 1.0
    images: int = 0
    alarm: float = 0.0
    suspicion: float = 0.0
    _level: float = 1.0
    _skip: int = _SETTLE
    _weight: float = 0.0
    _lasting: float = 0.0  # excess of the long-run variance over its standard deviation
    _short: float = 0.0  # sum of the squared innovations of images
    _long: float = 0.0  # of squared sums of the innovations over 3 s, over the number of images in them
    _pairs: float = 0.0  # of the numbers of other images in these sums
    _others: float = 0.0  # other images in 3 s, at the present rate
    _sum: FloatArray = field(default_factory=lambda: np.zeros(MODES))
    _recent: deque[_Innovation] = field(default_factory=deque)

    def settle(self) -> None:
        """A filter restarts with what was learnt: its first images are not counted."""
        self._skip, self.alarm, self.suspicion = _SETTLE, 0.0, 0.0
        self._interrupt()

    def _interrupt(self) -> None:
        self._recent.clear()
        self._sum = np.zeros(MODES)

    @property
    def alarmed(self) -> bool:
        """The innovations have jumped: allowed for by how long this rig's errors usually last, and how large.

        Where lens or board do not fit, the view decides: half a board at the image's edge is no bump.
        """
        return self.alarm > _CUSUM_LIMIT * self.strictness

    @property
    def suspicious(self) -> bool:
        """The innovations may have jumped: half the limit of `alarmed`, with refused images counted, too.

        Or they lie to one side: their sum over 3 s is larger than errors that last make it on this rig. Small
        jumps move many images by less than their noise.
        """
        if self.suspicion > 0.5 * _CUSUM_LIMIT * self.strictness:
            return True
        return float(self._sum @ self._sum) > _LIMIT * self.strictness * len(self._recent)

    @property
    def strictness(self) -> float:
        """By how much evidence must exceed what it would have to be if images were as they are modelled."""
        return self.factor * math.sqrt(self.scale)

    def refused(self) -> None:
        """An image was too far off to be used."""
        self.suspicion += _MOST - _CUSUM_DRIFT

    @property
    def fits(self) -> bool | None:
        """Whether the errors of images neither last nor exceed their noise; None: too few images to tell.

        Errors that last are ruled out where the long-run variance is less than one standard deviation above
        what the filter predicts; sigmas grow where it is `PERHAPS_SIGMAS` above.
        """
        if self.scale != 1.0 or self._lasting >= 1.0:
            return False
        return True if self._weight >= _TELLING else None

    @property
    def level(self) -> float:
        """Usual squared innovation in a mode over its prediction, >= 1."""
        return max(1.0, self._short / (MODES * self._weight)) if self._weight else 1.0

    def learn(
        self,
        t_s: float,
        uv: FloatArray,
        innovation: FloatArray,
        ways: FloatArray,
        moves: FloatArray,
        sigma: FloatArray,
        hidden: FloatArray | None = None,
    ) -> None:
        """Take in the innovation of one image.

        Args:
            t_s: Its instant, s.
            uv: Predicted pixels of the accepted corners, shape (n, 2).
            innovation: Measured minus predicted, px, shape (n, 2).
            ways: How these corners move in each way in which the image can, px, shape (2n, k).
            moves: Square root of how far the state and what corners share move it, shape (k, c).
            sigma: Corner noise as used, px, shape (n,).
            hidden: Square root of what clipped readings leave open in each way, shape (k, c), or None. Where
                that moves the corners by more than their noise, the innovation says nothing about the rest.
        """
        normal = normalised(uv, innovation, ways, moves, sigma, hidden)
        if normal is None:
            return
        if self._skip > 0:
            self._skip -= 1
            return
        self.images += 1
        ratio = float(normal @ normal) / len(normal)
        # One-sided CUSUM: at the usual level it drifts down by 0.6 an image; the chance that eight
        # degrees of freedom drive it to 9 is below 1e-10 an image.
        excess = min(ratio / self.level, _MOST) - _CUSUM_DRIFT
        self.alarm, self.suspicion = max(0.0, self.alarm + excess), max(0.0, self.suspicion + excess)
        self._move_scale(ratio)
        if len(normal) == MODES:
            self._remember(t_s, normal)
        else:
            self._interrupt()

    def _move_scale(self, ratio: float) -> None:
        """Follow the ratio; a level that is 1 within its own scatter stays exactly 1, at no cost."""
        gain = max(_GAIN_END, _GAIN_START / (1.0 + 0.02 * self.images))
        moved = self._level * (1.0 + gain * (min(ratio, _MOST) * self.scale / self._level - 1.0))
        self._level = min(max(moved, 0.5), _MAX_SCALE)
        self.scale = self._level if self._level > _DEAD_BAND else 1.0

    def _remember(self, t_s: float, normal: FloatArray) -> None:
        """Measure the long-run variance: the mean squared sum of the innovations of 3 s, over their number.

        That is the sum of the autocorrelations in Bartlett's window.
        [Newey and West, "A simple, positive semi-definite ... covariance matrix", 1987]
        """
        if self._weight >= self.memory:
            keep = 1.0 - 1.0 / self.memory
            self._weight, self._pairs = keep * self._weight, keep * self._pairs
            self._short, self._long = keep * self._short, keep * self._long
        self._weight += 1.0
        self._recent.append(_Innovation(t_s, normal))
        self._sum += normal
        most = max(1.0, _SHARE * self._weight)
        while len(self._recent) > most or not t_s - _LASTS_S <= self._recent[0].t_s <= t_s:
            self._sum -= self._recent.popleft().normal
        images = len(self._recent)
        self._short += float(normal @ normal)
        self._long += float(self._sum @ self._sum) / images
        self._pairs += images - 1.0
        span_s = t_s - self._recent[0].t_s
        if span_s > 0.0:
            self._others = (images - 1.0) * max(_LASTS_S / span_s, 1.0)
        more = self._long / (MODES * self._weight) - 1.0
        noise = math.sqrt(
            (4.0 * images + 2.0 / images) / (3.0 * MODES * self._weight)
        )  # of white innovations
        self._lasting = more / noise
        lasts = more > max(PERHAPS_SIGMAS * noise, _FLOOR)
        self.factor = 1.0 + more + self._not_seen_to_end() if lasts else 1.0

    def _not_seen_to_end(self) -> float:
        """By how much the long-run variance would be larger, had all sums been over 3 s.

        Early sums are shorter. Errors that last throughout them may last for 3 s: what they add then is in
        proportion to the number of other images in a sum.
        """
        if not self._pairs:
            return 0.0
        lasting = max(self._long - self._short, 0.0) / MODES
        return lasting * max(self._others / self._pairs - 1.0 / self._weight, 0.0)
