"""Inertial constraints between consecutive images: relative motion, its derivatives by the biases, its noise.

Preintegration after Forster et al., "On-manifold preintegration for real-time visual-inertial odometry",
2017, eq. (35)-(38) and (44), on top of our own strapdown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation import so3
from vical_daemon.estimation.imu_buffer import ImuBuffer
from vical_daemon.estimation.imu_model import influence, strapdown
from vical_daemon.estimation.measurements import FloatArray, ImuNoise

_MAX_HOLE_S = 0.1  # between readings; nothing is made up for longer
_EYE = np.eye(3)
_ORDER = np.array([0, 1, 2, 6, 7, 8, 3, 4, 5])  # velocity before position


@dataclass(slots=True)
class Link:
    """Motion from one image to the next, in the imu frame of the first.

    Attributes:
        dt_s: Length, s.
        dR, dv, dp: Relative rotation, and integrals of the specific force without gravity.
        by_bias: Derivatives of [rotation (local), velocity, position] by [gyro, accel] bias, shape (9, 6).
        root_information: W with W^T W = inverse covariance of [rotation, velocity, position], (9, 9).
        gyro_bias, accel_bias: Where it was integrated.
        rate_begin, rate_end: Measured rates (bias not removed) at both ends, rad/s.
    """

    dt_s: float
    dR: FloatArray
    dv: FloatArray
    dp: FloatArray
    by_bias: FloatArray
    root_information: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray
    rate_begin: FloatArray
    rate_end: FloatArray


def make_link(
    buffer: ImuBuffer,
    from_s: float,
    to_s: float,
    gyro_bias: FloatArray,
    accel_bias: FloatArray,
    noise: ImuNoise,
) -> Link | None:
    """Integrate between two instants of the imu's clock; None where readings are missing."""
    segment = buffer.segment(from_s, to_s)
    if segment is None or len(segment.t_s) < 2 or segment.gap_s > _MAX_HOLE_S:
        return None
    motion = strapdown(segment, gyro_bias[None], accel_bias[None])
    errors = influence(_EYE, motion)
    root = np.linalg.inv(np.linalg.cholesky(errors.noise(noise)[_ORDER[:, None], _ORDER]))
    return Link(
        float(motion.t_s[-1]),
        motion.dR[0, -1],
        motion.dv[0, -1],
        motion.dp[0, -1],
        errors.by_bias()[_ORDER],
        root,
        gyro_bias.copy(),
        accel_bias.copy(),
        segment.gyro[0],
        segment.gyro[-1],
    )


class Links(NamedTuple):
    """Links of a window stacked, for batched arithmetic (m of them)."""

    dt: FloatArray
    dR: FloatArray
    dv: FloatArray
    dp: FloatArray
    by_bias: FloatArray
    root: FloatArray
    bias: FloatArray  # (m, 6)

    @classmethod
    def stack(cls, links: list[Link]) -> Links:
        """Put links side by side."""
        return cls(
            np.array([x.dt_s for x in links]),
            np.array([x.dR for x in links]),
            np.array([x.dv for x in links]),
            np.array([x.dp for x in links]),
            np.array([x.by_bias for x in links]),
            np.array([x.root_information for x in links]),
            np.array([np.concatenate([x.gyro_bias, x.accel_bias]) for x in links]),
        )

    def errors(
        self, R: FloatArray, p: FloatArray, v: FloatArray, bias: FloatArray, gravity: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Whitened errors and derivatives of all links.

        Args:
            R: Attitudes at the m + 1 images, shape (m + 1, 3, 3).
            p: Positions in the world, m, shape (m + 1, 3).
            v: Velocities in the world, m/s, shape (m + 1, 3).
            bias: [gyro, accel] bias in force on each link, shape (m, 6).
            gravity: Acceleration of free fall in the world, m/s^2, shape (3,).

        Returns:
            Errors (m, 9), derivatives (m, 9, 24) by [turn p v of the first, turn p v of the second, bias].
        """
        Rt = np.swapaxes(R[:-1], 1, 2)
        off = np.einsum("mij,mj->mi", self.by_bias, bias - self.bias)
        dR = self.dR @ so3.exp(off[:, :3])
        T = self.dt[:, None]
        v_local = np.matmul(Rt, (v[1:] - v[:-1] - T * gravity)[..., None])[..., 0]
        p_local = np.matmul(Rt, (p[1:] - p[:-1] - T * v[:-1] - 0.5 * T * T * gravity)[..., None])[..., 0]
        turn = Rt @ R[1:]
        e_R = so3.log(np.swapaxes(dR, 1, 2) @ turn)
        e = np.concatenate([e_R, v_local - self.dv - off[:, 3:6], p_local - self.dp - off[:, 6:]], axis=1)
        J = np.zeros((len(e), 9, 24))
        inverse = so3.right_jacobian_inverse(e_R)
        J[:, :3, 0:3] = -inverse @ np.swapaxes(turn, 1, 2)
        J[:, :3, 9:12] = inverse
        J[:, :3, 18:] = -self.by_bias[:, :3]
        J[:, 3:6, 0:3], J[:, 6:, 0:3] = so3.hat(v_local), so3.hat(p_local)
        J[:, 3:6, 6:9], J[:, 3:6, 15:18] = -Rt, Rt
        J[:, 6:, 3:6], J[:, 6:, 12:15] = -Rt, Rt
        J[:, 6:, 6:9] = -Rt * T[..., None]
        J[:, 3:, 18:] = -self.by_bias[:, 3:]
        return np.matmul(self.root, e[..., None])[..., 0], self.root @ J
