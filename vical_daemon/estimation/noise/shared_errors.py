"""Errors that all corners of an image share, measured: a late stamp, and a shift of the whole image.

A stamp that is late by e moves every corner by e times its speed in the image; a camera that shakes, or a
detector that is drawn to one side, moves all alike. How much one image moved in these ways is known as well
as corners and predicted pose are; how much images vary beyond that are the variances here. Both are
estimated together, since each can be taken for the other.
[docs/math/filter.md, eq. (12)]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, SURE
from vical_daemon.estimation.model.state import ATTITUDE, Layout, State
from vical_daemon.estimation.noise.variance_components import SIZE, Observed, grid, of_images, posterior
from vical_daemon.estimation.significance import SURE_SIGMAS

MEMORY = 400  # images by which a noise is known
_TELLING = 50  # images; the correlation of neighbours is then known to 0.14
_EVERY = 20  # images that are added together; nothing is said before, unless a start said it
JITTERS_S = grid(5e-5)  # up to 8 ms
SHIFTS_PX = grid(2e-2)  # up to 3 px
_WANDERS_PX = 1.0  # five times what errors of the lens show on EuRoC; stabilisation moves images by some px
_WANDERS_S = 5e-4  # three times what they show there; an exposure that varies moves the time shift by ms
_BY_SCALE = 3.0 * ENTRY_SIGMA
"""Share of the interval between two images by which an IMU's errors of scale make the second look late."""
_MOST_ALIKE = 1.5
"""Correlation of delays, as measured. Wrong lenses and clipped readings move images for longer: 2 to 3."""
WAYS = 3  # late, to the side, down
ANNOUNCED_S = 3e-4
"""From here on a jitter is announced, s: what to do about it is often a setting of the camera's driver."""
PERSISTENT = 0.5
"""Correlation of what neighbouring images are late by: nearer to that of a model error (1) than to that of a
jitter (0)."""


@dataclass(slots=True)
class SharedErrors:
    """Running estimate of one camera.

    Attributes:
        jitter_s: Standard deviation of a stamp, s: root of the mean variance.
        shift_px: Standard deviation by which a whole image is off, per axis, px; likewise.
        jitter_found_s: The jitter where there surely is one, s; else 0.
        wander_px: The shift where it is large and that of neighbours alike (image stabilisation, a loose
            lens, a board that moves); else 0.
        wander_s: Likewise of the delays of the images (an exposure that adapts to the light), also while
            their correlation is not known yet.
        correlation_known: There are enough images to know the correlation of neighbours.
        images: Images taken in.
        until_s: Stamp (s) up to which images are known from the start, and are not to count again; -inf once
            they have passed.
    """

    jitter_s: float = 0.0
    shift_px: float = 0.0
    jitter_found_s: float = 0.0
    wander_px: float = 0.0
    wander_s: float = 0.0
    correlation_known: bool = False
    images: int = 0
    until_s: float = -math.inf
    _added_s: float = math.inf  # stamp of the last image that was added
    _interval_s: float = 0.0  # between images
    _likelihood: FloatArray = field(default_factory=lambda: np.zeros((SIZE, SIZE)))
    _A: FloatArray = field(default_factory=lambda: np.zeros((MEMORY, WAYS, WAYS)))
    _C: FloatArray = field(default_factory=lambda: np.zeros((MEMORY, WAYS, WAYS)))
    _b: FloatArray = field(default_factory=lambda: np.zeros((MEMORY, WAYS)))

    def begin(self, likelihood: FloatArray, until_s: float) -> None:
        """Go on from what the images of a start say together.

        Args:
            likelihood: See `variance_components.of_window`.
            until_s: Stamp of the last of them, s.
        """
        self._likelihood, self.until_s = likelihood, until_s
        self._look()

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations in the three ways, shape (3,)."""
        return np.array([self.jitter_s, self.shift_px, self.shift_px])

    def learn(
        self, t_cam_s: float, innovation: FloatArray, ways: FloatArray, state: FloatArray, level: float = 1.0
    ) -> None:
        """Take in one image before it is used.

        Args:
            t_cam_s: Its stamp, s.
            innovation: Measured minus predicted, over the corner noise, shape (m,).
            ways: Derivatives of the whitened pixels by a late stamp (1/s; zeros where the time shift is
                held) and by shifts (1/px), shape (m, 3).
            state: `ways`' times H S of the whitened pixels (what states add to the sums), shape (3, c).
            level: By how much innovations of any kind exceed their variances: where the model does not fit,
                that in these ways is nothing of its own.
        """
        if t_cam_s <= self.until_s:
            return
        self.until_s = -math.inf  # a clock that is set back later hides no image
        A = ways.T @ ways
        if not A.any():
            return
        place = self.images % MEMORY
        self._A[place], self._b[place] = A, innovation @ ways
        self._C[place] = level * (A + state @ state.T)
        self.images += 1
        if self.images % _EVERY == 0:
            self._interval_s = max(t_cam_s - self._added_s, 0.0) / _EVERY
            self._added_s = t_cam_s
            self._add(slice(place + 1 - _EVERY, place + 1))

    def _add(self, new: slice) -> None:
        """Add images to the likelihood; those of long ago are forgotten."""
        if self.images > MEMORY:
            self._likelihood *= 1.0 - _EVERY / MEMORY
        observed = Observed(self._b[new], self._A[new], self._C[new])
        self._likelihood = self._likelihood + of_images(observed, JITTERS_S, SHIFTS_PX)
        self._look()

    def _look(self) -> None:
        known = posterior(self._likelihood, JITTERS_S, SHIFTS_PX)
        self.jitter_s, self.shift_px = np.sqrt(known.mean).tolist()
        surely, alike = 1.0 - known.absent[0] > SURE, self._alike(0, self.jitter_s)
        self.jitter_found_s = self.jitter_s if surely and alike < PERSISTENT else 0.0
        self.correlation_known = math.isfinite(alike)
        varies = (
            surely
            and self.jitter_s > max(_WANDERS_S, _BY_SCALE * self._interval_s)
            and (not self.correlation_known or PERSISTENT < alike < _MOST_ALIKE)
        )
        self.wander_s = self.jitter_s if varies else 0.0
        wanders = self.shift_px > _WANDERS_PX and PERSISTENT < self._alike(1, self.shift_px) < math.inf
        self.wander_px = self.shift_px if wanders else 0.0

    def _alike(self, way: int, sigma: float) -> float:
        """Correlation of what neighbouring images are off by in a way; infinite while too few are known.

        A lens, a board or an imu that is off makes images look late or early, too, but neighbours
        alike.
        """
        n = min(self.images, MEMORY)
        size = self._A[:n, way, way]
        if n < _TELLING or not (size > 0.0).all() or sigma == 0.0:
            return math.inf
        late, usual = self._b[:n, way] / size, self._C[:n, way, way] / size**2
        weight = 1.0 / (usual + sigma**2)
        most = SURE_SIGMAS / np.sqrt(weight)  # one outlier is no correlation
        late = np.clip(late, -most, most)
        pairs = weight[1:] * weight[:-1]
        newest = self.images % MEMORY  # where the oldest follows the newest
        if self.images > MEMORY and newest:
            pairs[newest - 1] = 0.0
        return float((pairs * late[1:] * late[:-1]).sum() / pairs.sum()) / sigma**2


def shared_ways(state: State, layout: Layout, camera: str) -> FloatArray:
    """Errors of the state that move an image as a late stamp (by the second) and shifts (by the px) do.

    A shift is an error of the principal point; where the lens is held, nearly a small turn.

    Returns:
        Shape (size, 3).
    """
    where, known = layout.cameras[camera], state.cameras[camera]
    ways = np.zeros((layout.size, WAYS))
    if where.timeshift is not None:
        ways[where.timeshift, 0] = 1.0
    if where.intrinsics is not None:
        ways[where.intrinsics.start + 2, 1] = ways[where.intrinsics.start + 3, 2] = 1.0
    else:
        ways[ATTITUDE, 1:] = known.R_imu_cam[:, [1, 0]] / known.intrinsics[:2]
    return ways
