"""Misfit of a lens model, measured by the lenses of several windows.

No lens model fits exactly. What it leaves over depends on where in the image the features are. So each window
has a lens of its own, l + d with d ~ N(0, s^2 (J'J)^-1). J are the derivatives by the lens at those of 48
patches of the image in which the window has features (`lens_limit.patches`): each patch is off by s. Windows
estimate d together with the common lens l (`smoother/normal.py`), so that errors of the model neither bias l
nor contradict the mounting. s is the size under which the data of the windows are most likely [Patterson and
Thompson, "Recovery of inter-block information when block sizes are unequal", 1971].
[docs/math/target_free.md]
"""

from __future__ import annotations

from collections import deque

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.noise.lens_limit import SYSTEMATIC_PX

_SIZES_PX = SYSTEMATIC_PX * 1.1 ** np.arange(80)  # to 5.6 px: lenses guessed from the resolution are nearer
WINDOWS = 40  # the newest that count, here and for their agreement


class LensMisfit:
    """Running size of the misfit of one camera's lens.

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
