"""How the gyro turned: its readings integrated once, for attitudes at any instant between them."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_model import products, rotation_steps
from vical_daemon.estimation.measurements import FloatArray


class Attitudes:
    """Attitude of the imu relative to the first sample, integrated once for a bias.

    Args:
        t_s: Instants of the gyro samples, s, shape (m,).
        gyro: rad/s, shape (m, 3).
        bias: Subtracted, rad/s, shape (3,).
    """

    def __init__(self, t_s: FloatArray, gyro: FloatArray, bias: FloatArray) -> None:
        self.t_s = t_s
        self.rate = gyro - bias
        self.R = R = products(rotation_steps(self.rate[None], np.diff(t_s)))[0]
        middle = R[:-1] @ so3.exp(0.25 * (self.rate[:-1] + self.rate[1:]) * np.diff(t_s)[:, None])
        self.area = np.zeros((len(t_s), 3, 3))
        np.cumsum(middle * np.diff(t_s)[:, None, None], axis=0, out=self.area[1:])

    def at(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Attitude (k, 3, 3), rate (k, 3) and integral of the attitude (k, 3, 3) at instants inside."""
        k = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        h = t_s - self.t_s[k]
        share = (h / (self.t_s[k + 1] - self.t_s[k]))[:, None]
        rate = self.rate[k] * (1 - share) + self.rate[k + 1] * share
        R = self.R[k] @ so3.exp(0.5 * (self.rate[k] + rate) * h[:, None])
        return R, rate, self.area[k] + 0.5 * (self.R[k] + R) * h[:, None, None]
