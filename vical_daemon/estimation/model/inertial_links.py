"""Inertial constraints between consecutive images: relative motion, its derivatives by the biases, its noise.

Preintegration after Forster et al., "On-manifold preintegration for real-time visual-inertial odometry",
2017, eq. (35)-(38) and (44), on top of our own strapdown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import GAP_S, ImuBuffer
from vical_daemon.estimation.inertial.imu_model import over_intervals, size_effect, strapdown
from vical_daemon.estimation.measurements import FloatArray, ImuNoise
from vical_daemon.estimation.model.imu_scale import APART, by_apart, by_entries, matrices, positions_m

RELINK_S = 3e-4  # of change of the time shift: links are integrated again between the new instants
DONE = 1.0  # the last step of an adjustment is one with a smaller predicted reduction of the sum of squares
_ORDER = np.array([0, 1, 2, 6, 7, 8, 3, 4, 5])  # velocity before position


def make_links(
    buffer: ImuBuffer, t_s: FloatArray, imu: FloatArray, noise: ImuNoise
) -> PreintegratedLinks | None:
    """Integrate between consecutive instants of the imu's clock.

    Args:
        buffer: Readings.
        t_s: Instants in order, at least two, s, shape (m + 1,).
        imu: Of each link [gyro, accel] bias, rad/s and m/s^2; with the numbers of `imu_scale` where they are
            estimated; shape (m, 6), (m, 22) or (m, 28).
        noise: Densities.

    Returns:
        The links; None where readings are missing for one, or none that a device could give.
    """
    found = buffer.intervals(t_s)
    # a window bridges twice what the filter does: it would have to restart
    if found is None or found[0].gap_s > 2.0 * GAP_S:
        return None
    segment, begin = found
    counts = np.diff(np.append(begin, len(segment.t_s)))
    of = np.repeat(np.arange(len(imu)), counts)
    M_g, M_a = matrices(imu[:, 6:])
    numbers = imu[of, 6:]
    rate, force = segment.gyro - imu[of, :3], segment.accel - imu[of, 3:6]
    turn_slope, force_slope = segment.gyro_slope, segment.accel_slope
    assert turn_slope is not None
    assert force_slope is not None
    felt = np.zeros((0, 3, 3))
    if numbers.size:
        as_read, lag_s = np.concatenate([rate, force], axis=1), numbers[:, -1:]
        rate, turn_slope = (np.matvec(M_g[of], x) for x in (rate, turn_slope))
        force, force_slope = (np.matvec(M_a[of], x) for x in (force + lag_s * force_slope, force_slope))
        if numbers[:, APART].size:
            felt = size_effect(rate, turn_slope)
            force -= np.einsum("nij,nij->ni", felt, positions_m(numbers[:, APART]))
    zero = np.zeros((1, 3))
    even = segment._replace(gyro=rate, accel=force, gyro_slope=turn_slope, accel_slope=force_slope)
    motion = over_intervals(strapdown(even, zero, zero), begin, errors=True)
    covariance = np.array([e.noise(noise) for e in motion.influences])[:, _ORDER[:, None], _ORDER]
    try:
        root = np.linalg.inv(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        return None
    by_imu = [e.by_bias() for e in motion.influences]
    if numbers.size:
        by_imu = [
            np.column_stack(
                [
                    by_entries(e, as_read[own], g, a),
                    *([by_apart(e, felt[own])] if felt.size else []),
                    e.by_force(force_slope[own]),
                ]
            )
            for e, own, g, a in zip(motion.influences, motion.nodes, M_g, M_a, strict=True)
        ]
    return PreintegratedLinks(
        motion.dt, motion.dR, motion.dv, motion.dp, np.array(by_imu)[:, _ORDER], root, imu.copy()
    )


class PreintegratedLinks(NamedTuple):
    """Motion from one image to the next, m times, each in the imu frame of the first of both.

    Attributes:
        dt: Lengths, s, shape (m,).
        dR, dv, dp: Relative rotations (m, 3, 3), and integrals of the specific force without gravity (m, 3).
        by_imu: Derivatives of [rotation (local), velocity, position] by [gyro, accel] bias, and by the
            numbers of `imu_scale` where they are estimated, shape (m, 9, q).
        root: W with W^T W = inverse covariance of [rotation, velocity, position], shape (m, 9, 9).
        imu: Biases (and numbers) for which they were integrated, shape (m, 6), (m, 22) or (m, 28).
    """

    dt: FloatArray
    dR: FloatArray
    dv: FloatArray
    dp: FloatArray
    by_imu: FloatArray
    root: FloatArray
    imu: FloatArray

    @classmethod
    def none(cls, numbers: int) -> PreintegratedLinks:
        """No links, of so many `imu` each."""
        shapes = ((), (3, 3), (3,), (3,), (9, numbers), (9, 9), (numbers,))
        return cls(*(np.zeros((0, *shape)) for shape in shapes))

    def plus(self, more: PreintegratedLinks) -> PreintegratedLinks:
        """These, and then more."""
        return PreintegratedLinks(*(np.concatenate(pair) for pair in zip(self, more, strict=True)))

    def errors(
        self, R: FloatArray, p: FloatArray, v: FloatArray, imu: FloatArray, gravity: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Whitened errors and derivatives of all links.

        Args:
            R: Attitudes at the m + 1 images, shape (m + 1, 3, 3).
            p: Positions in the world, m, shape (m + 1, 3).
            v: Velocities in the world, m/s, shape (m + 1, 3).
            imu: [gyro, accel] bias on each link, and its numbers, shape (m, q), q = 6, 22 or 28.
            gravity: Acceleration of free fall in the world, m/s^2, shape (3,).

        Returns:
            Errors (m, 9), derivatives (m, 9, 18 + q) by [turn p v of the first, turn p v of the second, imu].
        """
        Rt = np.swapaxes(R[:-1], 1, 2)
        off = np.einsum("mij,mj->mi", self.by_imu, imu - self.imu)
        dR = self.dR @ so3.exp(off[:, :3])
        T = self.dt[:, None]
        v_local = np.matvec(Rt, v[1:] - v[:-1] - T * gravity)
        p_local = np.matvec(Rt, p[1:] - p[:-1] - T * v[:-1] - 0.5 * T * T * gravity)
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
        return np.matvec(self.root, e), self.root @ J
