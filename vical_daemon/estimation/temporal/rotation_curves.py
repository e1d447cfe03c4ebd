"""Orientation as a function of time: integrated from a gyro, or interpolated from measured orientations.

Both kinds answer `at(times)` with the orientation, the rotation rate and what an error of the gyro bias does
to the orientation, for any times inside their span and for all times in one call. `R_ref_imu` maps imu
vectors into a frame `ref` that is fixed in the world but otherwise arbitrary (the imu's attitude at its first
sample).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import GAP_PERIODS
from vical_daemon.estimation.inertial.imu_model import products, rotation_steps
from vical_daemon.estimation.measurements import FloatArray


def running_integral(dt_s: FloatArray, values: FloatArray) -> FloatArray:
    """Integral of values over time up to each of them, by trapezoids; dt_s (m - 1,), values (m, ...)."""
    out = np.zeros_like(values)
    steps = dt_s.reshape(-1, *(1,) * (values.ndim - 1))
    np.cumsum(0.5 * steps * (values[:-1] + values[1:]), axis=0, out=out[1:])
    return out


def _turn(rate: FloatArray, slope: FloatArray, s: FloatArray) -> FloatArray:
    """Rotation vector of a rate that changes linearly over s seconds, with the coning term (third order)."""
    s = s[..., None]
    return np.asarray(s * (rate + 0.5 * s * slope) + (s**3 / 12.0) * so3.cross(rate, slope))


@dataclass(frozen=True)
class GyroCurve:
    """Orientation of the imu by integrating a gyro whose rate is linear between samples.

    Attributes:
        t_s: Stamps, increasing, s, shape (m,).
        rate_rps: Bias-corrected rates in the imu frame, shape (m, 3).
        R_ref_imu: Orientation at the samples, shape (m, 3, 3).
        integral: Integral of R_ref_imu over time, s, shape (m, 3, 3): minus the effect of a bias error.
        hole_variance: Variance per axis gathered in holes of the data up to each sample, rad^2, shape (m,).
    """

    t_s: FloatArray
    rate_rps: FloatArray
    R_ref_imu: FloatArray
    integral: FloatArray
    hole_variance: FloatArray

    @classmethod
    def integrate(cls, t_s: FloatArray, gyro_rps: FloatArray, bias_rps: FloatArray) -> GyroCurve:
        """Integrate a gyro.

        Args:
            t_s: Stamps, strictly increasing, s, shape (m,), m >= 2.
            gyro_rps: Measured rates in the imu frame, shape (m, 3).
            bias_rps: Bias, subtracted first, shape (3,).
        """
        rate = gyro_rps - bias_rps
        dt = np.diff(t_s)
        R = products(rotation_steps(rate[None], dt))[0]
        integral = running_integral(dt, R)
        # in a hole the rate is unknown: it may have differed from the straight line by its own usual size
        hole = np.where(dt > GAP_PERIODS * np.median(dt), dt, 0.0)
        extra = np.mean(np.vecdot(rate, rate)) / 3.0 * hole**2
        return cls(t_s, rate, R, integral, np.concatenate(([0.0], np.cumsum(extra))))

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant of the curve, s."""
        return float(self.t_s[0]), float(self.t_s[-1])

    def _segment(self, times_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray]:
        k = np.clip(np.searchsorted(self.t_s, times_s, side="right") - 1, 0, len(self.t_s) - 2)
        slope = (self.rate_rps[k + 1] - self.rate_rps[k]) / (self.t_s[k + 1] - self.t_s[k])[..., None]
        return k, np.asarray(times_s - self.t_s[k]), slope

    def quaternion(self, times_s: FloatArray) -> FloatArray:
        """Return q_ref_imu at times inside the span, shape (..., 4)."""
        k, s, slope = self._segment(times_s)
        turn = so3.quat_from_rotvec(_turn(self.rate_rps[k], slope, s))
        return so3.quat_multiply(self._q_ref_imu[k], turn)

    @cached_property
    def _q_ref_imu(self) -> FloatArray:
        """Orientation at the samples, shape (m, 4)."""
        return so3.quat_from_matrix(self.R_ref_imu)

    def at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return R_ref_imu (..., 3, 3), rate in the imu frame (..., 3), integral of R_ref_imu (..., 3, 3)."""
        k, s, slope = self._segment(times_s)
        R_k = self.R_ref_imu[k]
        R = R_k @ so3.exp(_turn(self.rate_rps[k], slope, s))
        rate = self.rate_rps[k] + slope * s[..., None]
        return R, rate, self.integral[k] + 0.5 * s[..., None, None] * (R_k + R)

    def matrix_effect(self, times_s: FloatArray) -> FloatArray:
        """Return the integral of R_ref_imu E_ij rate: the effect of an error of the gyro's scale matrix.

        If the true rate is `(I + S) rate`, the orientation is off by `matrix_effect @ S.ravel()` (left, rad).

        Returns:
            shape (..., 3, 9), columns in the order of S row by row.
        """
        flow = (self.R_ref_imu[:, :, :, None] * self.rate_rps[:, None, None, :]).reshape(-1, 27)
        total = running_integral(np.diff(self.t_s), flow)
        k, s, _ = self._segment(times_s)
        share = (s / (self.t_s[k + 1] - self.t_s[k]))[..., None]
        return np.reshape(total[k] + share * (total[k + 1] - total[k]), (*times_s.shape, 3, 9))

    def variance(self, times_s: FloatArray, density: float) -> FloatArray:
        """Return the variance per axis gathered since the start: white gyro noise is a random walk in angle.

        Args:
            times_s: Instants, s.
            density: Gyro noise density, rad/s/sqrt(Hz).
        """
        by_holes = np.interp(times_s, self.t_s, self.hole_variance)
        return np.asarray(density**2 * (times_s - self.t_s[0]) + by_holes)


@dataclass(frozen=True)
class OrientationCurve:
    """Orientation interpolated between measured orientations: cubic Hermite in the tangent space.

    Attributes:
        t_s: Stamps, strictly increasing, s, shape (m,), m >= 3.
        q_ref_body: Measured orientations, shape (m, 4).
        rate_rps: Rates in the body frame at the samples, from a local quadratic fit, shape (m, 3).
    """

    t_s: FloatArray
    q_ref_body: FloatArray
    rate_rps: FloatArray

    @classmethod
    def interpolate(cls, t_s: FloatArray, q_ref_body: FloatArray) -> OrientationCurve:
        """Prepare the interpolation of a stream of orientations (w x y z)."""
        dt = np.diff(t_s)
        turn = so3.turn_between(q_ref_body[:-1], q_ref_body[1:])
        mean = turn / dt[:, None]
        rate = np.empty((len(t_s), 3))
        # three-point derivative: the neighbour intervals' mean rates, the nearer one weighs more
        rate[1:-1] = (mean[:-1] * dt[1:, None] + mean[1:] * dt[:-1, None]) / (dt[1:] + dt[:-1])[:, None]
        rate[0], rate[-1] = 1.5 * mean[0] - 0.5 * rate[1], 1.5 * mean[-1] - 0.5 * rate[-2]
        return cls(t_s, so3.quat_normalise(q_ref_body), rate)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant of the curve, s."""
        return float(self.t_s[0]), float(self.t_s[-1])

    def _turn(self, times_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray]:
        """Segment, rotation vector from its start, and its time derivative."""
        k = np.clip(np.searchsorted(self.t_s, times_s, side="right") - 1, 0, len(self.t_s) - 2)
        h = self.t_s[k + 1] - self.t_s[k]
        u = ((times_s - self.t_s[k]) / h)[..., None]
        h = h[..., None]
        whole = so3.turn_between(self.q_ref_body[k], self.q_ref_body[k + 1])
        v0 = self.rate_rps[k] * h
        v1 = np.einsum("...ij,...j->...i", so3.right_jacobian_inverse(whole), self.rate_rps[k + 1]) * h
        a, b = 3.0 * whole - 2.0 * v0 - v1, v0 + v1 - 2.0 * whole
        return k, u * (v0 + u * (a + u * b)), (v0 + u * (2.0 * a + 3.0 * u * b)) / h

    def quaternion(self, times_s: FloatArray) -> FloatArray:
        """Return q_ref_body at times inside the span, shape (..., 4)."""
        k, turn, _ = self._turn(times_s)
        return so3.quat_multiply(self.q_ref_body[k], so3.quat_from_rotvec(turn))

    def at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return R_ref_body (..., 3, 3), rate in the body frame (..., 3), and zeros (no bias to speak of)."""
        k, turn, derivative = self._turn(times_s)
        R = so3.matrix_from_quat(so3.quat_multiply(self.q_ref_body[k], so3.quat_from_rotvec(turn)))
        rate = np.einsum("...ij,...j->...i", so3.right_jacobian(turn), derivative)
        return R, rate, np.zeros_like(R)

    def matrix_effect(self, times_s: FloatArray) -> FloatArray:
        """Return zeros: there is no gyro."""
        return np.zeros((*times_s.shape, 3, 9))

    def variance(self, times_s: FloatArray, density: float) -> FloatArray:
        """Return a small drift: measured orientations do not walk; their noise is the caller's to add."""
        return np.asarray((0.02 * density) ** 2 * (times_s - self.t_s[0]))


RotationCurve = GyroCurve | OrientationCurve
"""What registration needs: the methods that both have."""
