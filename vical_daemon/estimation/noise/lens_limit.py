"""What a lens is never known better than: the bias of detectors, and the misfit of its model over windows."""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import numpy as np

from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.next_term import UNSEEN_PX, Numbers, lens_slopes, rounded
from vical_daemon.estimation.model.state import CameraState

SYSTEMATIC_PX = 0.003
"""Constant error that corners of one patch of the image share, px; the curvature of edges alone makes up to
0.005 px at the border of a picture (docs/detection.md)."""


def limit(camera: CameraState) -> FloatArray:
    """Standard deviations below which no lens is known: fx fy cx cy (px), distortion; shape (n,).

    Least squares of the lens to patches, eight by six over the image, that are each off by as much. It hardly
    depends on the lens: rounded to three digits, it rarely has to be computed again.

    A number that no patch shows gets 0: a lens that is far off may have rays for hardly any of them.
    """
    return np.asarray(SYSTEMATIC_PX * _by_one_px(*rounded(camera)))


def patches(camera: CameraState, seen: BoolArray | None = None) -> FloatArray:
    """R with R'R = J'J, J the derivatives of the patches by fx fy cx cy and the distortion, shape (n, n).

    Args:
        camera: Its lens counts.
        seen: Patches that are left out count next to nothing, shape (48,); None: all count.
    """
    by = lens_slopes(*rounded(camera))
    if seen is not None:
        by = np.where(seen[:, None, None], by, 1.0 / UNSEEN_PX * by)
    return np.asarray(np.linalg.qr(by.reshape(-1, by.shape[-1]))[1])


@lru_cache(maxsize=64)
def _by_one_px(K: Numbers, D: Numbers, model: str, resolution: tuple[int, int]) -> FloatArray:
    by = lens_slopes(K, D, model, resolution)
    return np.asarray(np.linalg.norm(np.linalg.pinv(by.reshape(-1, by.shape[-1])), axis=1))


_SIZES_PX = SYSTEMATIC_PX * 1.1 ** np.arange(80)  # to 5.6 px: lenses guessed from the resolution are nearer
WINDOWS = 40  # the newest that count, here and for their agreement


class LensMisfit:
    """Running size of the misfit of one camera's lens, measured by the lenses of several windows.

    What a lens model leaves over depends on where in the image the features are. So each window has a lens of
    its own, l + d with d ~ N(0, s^2 (J'J)^-1), J the derivatives of the patches in which it has features:
    each patch is off by s. d and the common l are estimated together (`smoother/normal.py`). s is the size
    under which the data of the windows are most likely [Patterson and Thompson, "Recovery of inter-block
    information when block sizes are unequal", 1971]. [docs/math/target_free.md]

    Attributes:
        px: Error of a patch of the image, one sigma, px; at least what detectors leave open.
    """

    def __init__(self) -> None:
        self.px = SYSTEMATIC_PX
        self._logs: deque[FloatArray] = deque(maxlen=WINDOWS)

    def learn(self, root: FloatArray, information: FloatArray, weighted: FloatArray) -> None:
        """Take in what one window says of its own lens, apart from the prior of that.

        Args:
            root: R with R'R = J'J, see `lens_limit.patches`, shape (n, n).
            information: L, of its data about d, shape (n, n).
            weighted: L times their estimate of d, shape (n,).
        """
        inverse = np.linalg.inv(root)
        values, vectors = np.linalg.eigh(inverse.T @ information @ inverse)
        square = (vectors.T @ (inverse.T @ weighted)) ** 2
        size = _SIZES_PX[:, None] ** 2
        gain = 1.0 + size * np.maximum(values, 0.0)
        self._logs.append((0.5 * square * size / gain - 0.5 * np.log(gain)).sum(axis=1))
        self.px = float(_SIZES_PX[int(np.argmax(np.sum(self._logs, axis=0)))])
