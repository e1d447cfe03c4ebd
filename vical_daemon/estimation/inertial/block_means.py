"""Means of fast readings over 5 ms: noise of single readings would pass for motion.

The time shift shows in how the rate changes between two images. From 1000 readings a second, one at either
image, that change is mostly noise where the rig moves slowly, and noise squared counts as information: the
time shift stays where it began, at a sigma that is far too small. A mean over a block is what the gyro turned
in that time. It is less than the rate in the middle of a swing, by 0.04 % of a motion at 3 Hz,
(pi f T)^2 / 6. The buffer adds that again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.inertial.faulty_readings import Six
from vical_daemon.estimation.inertial.imu_buffer import BLOCK_S


class Mean(NamedTuple):
    """Mean of a block: instant, s; rates and forces, rad/s and m/s^2; `Bridged.clipping_sigma`.

    `spread_s2` is the variance of the instants of its readings, s^2.
    """

    t_s: float
    six: Sequence[float]
    clipping_sigma: Sequence[float] | None
    spread_s2: float = 0.0


class BlockMeans:
    """Joins readings that follow each other within 5 ms."""

    def __init__(self) -> None:
        self._block: list[Mean] = []
        self._before_s = -np.inf

    def take(self, t_s: float, six: Sequence[float], clipping_sigma: Six | None) -> Mean | None:
        """Take a reading; return the mean of the block that it completes, or None."""
        interval_s, self._before_s = t_s - self._before_s, t_s
        self._block.append(Mean(t_s, six, clipping_sigma))
        return self.rest() if t_s - self._block[0].t_s + 2.0 * interval_s > BLOCK_S else None

    def rest(self) -> Mean | None:
        """End the block, and return its mean; None where it is empty."""
        block, self._block = self._block, []
        if len(block) < 2:
            return block[0] if block else None
        clipped = [x.clipping_sigma for x in block if x.clipping_sigma is not None]
        sigma = np.sum(clipped, axis=0) / len(block) if clipped else None
        t_s = [x.t_s for x in block]
        return Mean(
            float(np.mean(t_s)),
            np.mean([x.six for x in block], axis=0).tolist(),
            None if sigma is None else sigma.tolist(),
            float(np.var(t_s)),
        )
