"""Measured consistency of the filter: how much larger its innovations are than it thinks, and for how long.

Lens models that do not quite fit, blur, a board that is not quite flat and an IMU that is not quite linear
move all corners of an image together, and much the same way in the next images. To a filter that takes
corners as independent such errors look like information: on a real recording it then claims a tenth of a
millimetre where two halves of the data differ by some. Two numbers, both from the innovations projected on
the eight smooth modes of a plane's image, make it honest again:

* `scale` multiplies the variance of the corners until the innovations have the size they should have. It
  changes the weight of images against the IMU, so it moves slowly and within bounds.
* `factor` is the long-run over the instantaneous variance of the innovations: errors that last for k images
  are k times less informative than the filter counts. It multiplies the *reported* covariance only; fed back
  into the gain it would run away (less weight for images, more drift, larger innovations).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.unscented import root, solve_lower
from vical_daemon.estimation.significance import OUTLIER_SIGMAS, SURE_SIGMAS

MODES = 8
TELLING = 100  # images; the correlation of neighbours is then known to 0.1
_LAGS = 20
_TAPER = 1.0 - np.arange(1, _LAGS + 1) / (_LAGS + 1)
_FLOOR = 0.5
_GAIN_START, _GAIN_END = 0.1, 0.01
_MAX_SCALE = 16.0
_DEAD_BAND = 1.3
_SETTLE = 10  # images: the first updates of a wide prior are not yet linear
_CUSUM_DRIFT = 1.6
_CUSUM_LIMIT = 9.0


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
    diagonal = L.diagonal()
    if diagonal.min() < 1e-6 * diagonal.max():
        return None
    along = np.concatenate([weighted @ ways, (weighted @ innovation.ravel())[:, None]], axis=1)
    along = solve_lower(L, along)  # Q' of ways and innovation
    if hidden is not None:
        directions, size, _ = np.linalg.svd(along[:, :-1] @ hidden)
        along = directions[:, int(np.count_nonzero(size > 1.0)) :].T @ along
    state = along[:, :-1] @ moves
    out: FloatArray = along[:, -1] / np.sqrt(1.0 + np.einsum("ij,ij->i", state, state))
    return np.minimum(np.maximum(out, -OUTLIER_SIGMAS), OUTLIER_SIGMAS)


@dataclass(slots=True)
class Consistency:
    """Running scale and factor of one camera.

    Attributes:
        memory: Images remembered.
        scale: Multiplies the variance of the corners, >= 1.
        factor: Multiplies the reported covariance, >= 1.
        images: Images taken in.
        alarm: Cumulated excess of the innovations over their usual level; above `alarm_at` the rig changed.
    """

    memory: float = 800.0
    scale: float = 1.0
    factor: float = 1.0
    images: int = 0
    alarm: float = 0.0
    _level: float = 1.0
    _skip: int = _SETTLE
    _weight: float = 0.0
    _lagged: FloatArray = field(default_factory=lambda: np.zeros(_LAGS + 1))
    _recent: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=_LAGS + 1))

    def settle(self) -> None:
        """A filter starts anew with what was learnt: let its first images pass."""
        self._skip, self.alarm = _SETTLE, 0.0
        self._recent.clear()

    @property
    def alarmed(self) -> bool:
        """The innovations have jumped: allowed for by how long this rig's errors usually last, and how large.

        Where lens or board do not fit, the view decides: half a board at the image's edge is no bump.
        """
        return self.images > _LAGS and self.alarm > _CUSUM_LIMIT * self.factor * np.sqrt(self.scale)

    @property
    def level(self) -> float:
        """Usual squared innovation in a mode over its prediction, >= 1."""
        return max(1.0, self._lagged[0] / (MODES * self._weight)) if self._weight else 1.0

    def learn(
        self,
        uv: FloatArray,
        innovation: FloatArray,
        ways: FloatArray,
        moves: FloatArray,
        sigma: FloatArray,
        hidden: FloatArray | None = None,
    ) -> None:
        """Take in the innovation of one image.

        Args:
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
        self.alarm = max(0.0, self.alarm + min(ratio / self.level, 5.0) - _CUSUM_DRIFT)
        self._move_scale(ratio)
        if len(normal) == MODES:
            self._remember(normal)
        else:
            self._recent.clear()

    def _move_scale(self, ratio: float) -> None:
        """Follow the ratio; a level that is 1 within its own scatter stays exactly 1, at no cost."""
        gain = max(_GAIN_END, _GAIN_START / (1.0 + 0.02 * self.images))
        moved = self._level * (1.0 + gain * (min(ratio, 5.0) * self.scale / self._level - 1.0))
        self._level = min(max(moved, 0.5), _MAX_SCALE)
        self.scale = self._level if self._level > _DEAD_BAND else 1.0

    def _remember(self, normal: FloatArray) -> None:
        if self._weight >= self.memory:
            keep = 1.0 - 1.0 / self.memory
            self._weight *= keep
            self._lagged *= keep
        self._weight += 1.0
        self._recent.append(normal)
        self._lagged[: len(self._recent)] += (np.array(self._recent) @ normal)[::-1]
        if self._weight < TELLING:
            return
        total = 2.0 * float(_TAPER @ self._lagged[1:] / self._lagged[0])
        noise = 2.0 * float(np.sqrt(_TAPER @ _TAPER / (MODES * self._weight)))
        self.factor = 1.0 + total if total > max(SURE_SIGMAS * noise, _FLOOR) else 1.0
