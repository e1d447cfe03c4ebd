"""Inertial constraints between consecutive images: relative motion, its derivatives by the biases, its noise.

Preintegration after Forster et al., "On-manifold preintegration for real-time visual-inertial odometry",
2017, eq. (35)-(38) and (44), on top of our own strapdown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer, ImuSegment
from vical_daemon.estimation.inertial.imu_model import Influence, Strapdown, influence, strapdown
from vical_daemon.estimation.measurements import FloatArray, ImuNoise
from vical_daemon.estimation.model.imu_scale import ENTRIES, by_entries, matrices
from vical_daemon.estimation.model.unscented import root as root_of
from vical_daemon.estimation.model.unscented import solve_lower

_MAX_HOLE_S = 0.1  # between readings; nothing is made up for longer
_ROUNDING = 1e-18 * np.eye(9)  # (1e-9 rad, m/s, m)^2: noise densities may be given as zero
_ORDER = np.array([0, 1, 2, 6, 7, 8, 3, 4, 5])  # velocity before position


@dataclass(slots=True)
class PreintegratedLink:
    """Motion from one image to the next, in the imu frame of the first.

    Attributes:
        dt_s: Length, s.
        dR, dv, dp: Relative rotation, and integrals of the specific force without gravity.
        by_imu: Derivatives of [rotation (local), velocity, position] by [gyro, accel] bias, and by the
            sixteen numbers of `imu_scale` where they are estimated, shape (9, 6) or (9, 22).
        root_information: W with W^T W = inverse covariance of [rotation, velocity, position], (9, 9).
        imu: Biases (and numbers) for which it was integrated, shape (6,) or (22,).
    """

    dt_s: float
    dR: FloatArray
    dv: FloatArray
    dp: FloatArray
    by_imu: FloatArray
    root_information: FloatArray
    imu: FloatArray


def make_link(
    buffer: ImuBuffer,
    from_s: float,
    to_s: float,
    imu: FloatArray,
    noise: ImuNoise,
) -> PreintegratedLink | None:
    """Integrate between two instants of the imu's clock.

    Args:
        buffer: Readings.
        from_s: Begin, s.
        to_s: End, s.
        imu: [gyro, accel] bias, rad/s and m/s^2; with the numbers of `imu_scale` where they are estimated.
        noise: Densities.

    Returns:
        The link; None where readings are missing, or none that a device could give.
    """
    segment = buffer.segment(from_s, to_s)
    if segment is None or len(segment.t_s) < 2 or segment.gap_s > _MAX_HOLE_S:
        return None
    motion, errors, by_imu = _integrated(segment, imu[:6], imu[6:])
    covariance = errors.noise(noise)[_ORDER[:, None], _ORDER] + _ROUNDING
    try:
        root = solve_lower(root_of(covariance), np.eye(9))
    except np.linalg.LinAlgError:
        return None
    return PreintegratedLink(
        float(motion.t_s[-1]),
        motion.dR[0, -1],
        motion.dv[0, -1],
        motion.dp[0, -1],
        by_imu[_ORDER],
        root,
        imu.copy(),
    )


def _integrated(
    segment: ImuSegment, bias: FloatArray, numbers: FloatArray
) -> tuple[Strapdown, Influence, FloatArray]:
    """Motion over a segment, what errors do to its end, and its derivatives by bias and numbers."""
    if not len(numbers):
        motion = strapdown(segment, bias[None, :3], bias[None, 3:])
        errors = influence(so3.IDENTITY, motion)
        return motion, errors, errors.by_bias()
    M_g, M_a = matrices(numbers)
    motion = strapdown(segment, bias[None, :3], bias[None, 3:], M_g[None], M_a[None], numbers[ENTRIES:])
    errors = influence(so3.IDENTITY, motion)
    slope = np.zeros_like(segment.accel) if segment.accel_slope is None else segment.accel_slope
    by_lag = errors.by_force(slope @ M_a.T)
    by_imu = np.column_stack([by_entries(errors, segment, bias, M_g, M_a), by_lag])
    return motion, errors, by_imu


class PreintegratedLinks(NamedTuple):
    """Links of a window stacked, for batched arithmetic (m of them)."""

    dt: FloatArray
    dR: FloatArray
    dv: FloatArray
    dp: FloatArray
    by_imu: FloatArray
    root: FloatArray
    imu: FloatArray  # (m, 6) or (m, 22)

    @classmethod
    def stack(cls, links: list[PreintegratedLink]) -> PreintegratedLinks:
        """Put links side by side."""
        return cls(
            np.array([x.dt_s for x in links]),
            np.array([x.dR for x in links]),
            np.array([x.dv for x in links]),
            np.array([x.dp for x in links]),
            np.array([x.by_imu for x in links]),
            np.array([x.root_information for x in links]),
            np.array([x.imu for x in links]),
        )

    def errors(
        self, R: FloatArray, p: FloatArray, v: FloatArray, imu: FloatArray, gravity: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Whitened errors and derivatives of all links.

        Args:
            R: Attitudes at the m + 1 images, shape (m + 1, 3, 3).
            p: Positions in the world, m, shape (m + 1, 3).
            v: Velocities in the world, m/s, shape (m + 1, 3).
            imu: [gyro, accel] bias on each link, and its numbers, shape (m, q), q = 6 or 22.
            gravity: Acceleration of free fall in the world, m/s^2, shape (3,).

        Returns:
            Errors (m, 9), derivatives (m, 9, 18 + q) by [turn p v of the first, turn p v of the second, imu].
        """
        Rt = np.swapaxes(R[:-1], 1, 2)
        off = np.einsum("mij,mj->mi", self.by_imu, imu - self.imu)
        dR = self.dR @ so3.exp(off[:, :3])
        T = self.dt[:, None]
        v_local = np.matmul(Rt, (v[1:] - v[:-1] - T * gravity)[..., None])[..., 0]
        p_local = np.matmul(Rt, (p[1:] - p[:-1] - T * v[:-1] - 0.5 * T * T * gravity)[..., None])[..., 0]
        turn = Rt @ R[1:]
        e_R = so3.log(np.swapaxes(dR, 1, 2) @ turn)
        e = np.concatenate([e_R, v_local - self.dv - off[:, 3:6], p_local - self.dp - off[:, 6:]], axis=1)
        J = np.zeros((len(e), 9, 18 + imu.shape[1]))
        inverse = so3.right_jacobian_inverse(e_R)
        J[:, :3, 0:3] = -inverse @ np.swapaxes(turn, 1, 2)
        J[:, :3, 9:12] = inverse
        J[:, :3, 18:] = -self.by_imu[:, :3]
        J[:, 3:6, 0:3], J[:, 6:, 0:3] = so3.hat(v_local), so3.hat(p_local)
        J[:, 3:6, 6:9], J[:, 3:6, 15:18] = -Rt, Rt
        J[:, 6:, 3:6], J[:, 6:, 12:15] = -Rt, Rt
        J[:, 6:, 6:9] = -Rt * T[..., None]
        J[:, 3:, 18:] = -self.by_imu[:, 3:]
        return np.matmul(self.root, e[..., None])[..., 0], self.root @ J
