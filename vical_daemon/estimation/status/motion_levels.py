"""How a rig moved in the last seconds: errors of an IMU that depend on its motion look like biases.

No gyro's scale is quite linear, and most respond to acceleration. To and fro such errors leave a mean, and
the filter takes it for a bias. When the rig comes to rest, or is held another way, that bias is another.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, G_SENSITIVITY_S_PER_M
from vical_daemon.estimation.significance import EVERY_S, STRETCH_S

_SPAN_S = 6.0 * STRETCH_S  # longer than any change takes to be confirmed, after a stretch before it


class _Second(NamedTuple):
    """Sums over the images of a second: when it began, s; number; of squared rates; of forces."""

    t_s: float
    images: int
    squared: FloatArray
    force: FloatArray


@dataclass(slots=True)
class MotionLevels:
    """Motion of the last half minute, second by second."""

    _seconds: deque[_Second] = field(default_factory=deque)

    def look(self, f: CalibrationFilter) -> None:
        """Take the motion of the filter's present state."""
        state, rates = f.state, f.rates
        force = (rates.accel - state.gravity) @ state.R_world_imu
        now = _Second(state.t_s, 1, rates.omega**2, force)
        last = self._seconds[-1] if self._seconds else None
        if last is not None and last.t_s <= now.t_s < last.t_s + EVERY_S:
            squared, forces = last.squared + now.squared, last.force + force
            self._seconds[-1] = _Second(last.t_s, last.images + 1, squared, forces)
            return
        self._seconds.append(now)
        while self._seconds[0].t_s < now.t_s - _SPAN_S:
            self._seconds.popleft()

    def bias_sigmas(self, before_s: float, since_s: float) -> FloatArray:
        """How far biases may differ by what depends on the motion, one sigma.

        By the prior of the errors of scale, of how far the RMS rate and the mean force of each axis have
        changed, and by the response of a gyro to the force.

        Args:
            before_s: The last stretch before this instant, s,
            since_s: and all images since this one.

        Returns:
            Of gyro, rad/s, and accelerometer, m/s^2, shape (6,); zeros where one of them was not seen.
        """
        before = self._mean(before_s - STRETCH_S, before_s)
        after = self._mean(since_s, math.inf)
        if before is None or after is None:
            return np.zeros(6)
        rate, force = (np.abs(a - b) for a, b in zip(after, before, strict=True))
        by_force = G_SENSITIVITY_S_PER_M * np.linalg.norm(force)
        return np.concatenate([np.hypot(ENTRY_SIGMA * rate, by_force), ENTRY_SIGMA * force])

    def _mean(self, from_s: float, to_s: float) -> tuple[FloatArray, FloatArray] | None:
        """RMS rate about each axis of the imu, rad/s, and mean specific force, m/s^2, shapes (3,)."""
        seconds = [x for x in self._seconds if from_s <= x.t_s < to_s]
        images = sum(x.images for x in seconds)
        if not images:
            return None
        squared = np.sum([x.squared for x in seconds], axis=0) / images
        return np.sqrt(squared), np.sum([x.force for x in seconds], axis=0) / images
