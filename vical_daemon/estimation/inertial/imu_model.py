"""Strapdown integration of inertial readings for a batch of biases, its derivatives and its noise.

Between two samples the measured rate and specific force are cubic in time (Hermite, slopes by central
differences), with the coning term for the attitude; velocity and position are integrated exactly for a
specific force that is cubic in the *start* frame. Averaging two samples as if both lay in one frame would
bias the time shift by tenths of a millisecond; straight lines between samples would shorten a 3 Hz shake by
0.3 % at 100 Hz, which ends up in the lever arm, always in the same direction (see docs/math/filter.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.measurements import FloatArray, ImuNoise

_ROUNDING = 1e-18 * np.eye(9)  # (1e-9 rad, m/s, m)^2: noise densities may be given as zero
_SHORT = 64  # rotation steps up to which doubling the number of factors is quickest


class Motion(NamedTuple):
    """Attitude, position and velocity of the imu in the world, a batch of S; and the two rates at the end.

    Attributes:
        R: R_world_imu, shape (S, 3, 3).
        p: p_world_imu, m, shape (S, 3).
        v: Velocity in the world, m/s, shape (S, 3).
    """

    R: FloatArray
    p: FloatArray
    v: FloatArray


class Strapdown(NamedTuple):
    """Relative motion over a segment for a batch of biases, before gravity and the start pose enter.

    Attributes:
        dR: Rotation from each node to the start, shape (S, n + 1, 3, 3): R_start_node.
        dv: Integral of the specific force in the start frame, m/s, shape (S, n + 1, 3).
        dp: Double integral, m, shape (S, n + 1, 3).
        t_s: Node times since the start, s, shape (n + 1,).
        clipping_sigma: See `ImuSegment`.
        felt: `size_effect` at every node, shape (n + 1, 3, 3); None: all axes of it are at the origin.
    """

    dR: FloatArray
    dv: FloatArray
    dp: FloatArray
    t_s: FloatArray
    clipping_sigma: FloatArray | None = None
    felt: FloatArray | None = None


def strapdown(
    segment: ImuSegment,
    gyro_bias: FloatArray,
    accel_bias: FloatArray,
    gyro_matrix: FloatArray | None = None,
    accel_matrix: FloatArray | None = None,
    accel_lag_s: FloatArray | None = None,
    accel_positions: FloatArray | None = None,
) -> Strapdown:
    """Integrate a segment for a batch of biases (strapdown mechanisation in the start frame).

    omega = M_g (omega_m - b_g), f = M_a (f_m + lag f_m' - b_a);  R' = R hat(omega), v' = R f, p' = v.

    Args:
        segment: Readings.
        gyro_bias: rad/s, shape (S, 3).
        accel_bias: m/s^2, shape (S, 3).
        gyro_matrix: Scale and misalignment M_g, shape (S, 3, 3); None: identity.
        accel_matrix: The same for the accelerometer.
        accel_lag_s: How late its readings are, s, shape (S,); None: not.
        accel_positions: Of its axes x, y, z, m, shape (S, 3, 3); None: all at the origin.

    Returns:
        The relative motion at every node.
    """
    dt = segment.t_s[1:] - segment.t_s[:-1]
    omega = segment.gyro - gyro_bias[:, None, :]
    force = segment.accel - accel_bias[:, None, :]
    if accel_lag_s is not None and segment.accel_slope is not None:
        force = force + accel_lag_s[:, None, None] * segment.accel_slope
    if gyro_matrix is not None:
        omega = omega @ gyro_matrix.swapaxes(-1, -2)
    if accel_matrix is not None:
        force = force @ accel_matrix.swapaxes(-1, -2)
    turn_slope, force_slope, felt = segment.gyro_slope, segment.accel_slope, None
    if turn_slope is not None and gyro_matrix is not None:
        turn_slope = turn_slope @ gyro_matrix[0].T
    if accel_positions is not None and turn_slope is not None:
        # hardly depends on the bias: the first of the batch stands for all
        felt = size_effect(omega[0], turn_slope)
        force = force - np.vecdot(felt, accel_positions[:, None])
    dR = products(rotation_steps(omega, dt, turn_slope))
    f_start = np.matvec(dR, force)
    before, after, h = f_start[:, :-1], f_start[:, 1:], dt[:, None]
    dv, dp = np.zeros((2, *f_start.shape))
    if force_slope is None:
        gained = (before + after) * (0.5 * h)
        moved = (2.0 * before + after) * (h * h / 6.0)
    else:
        # slope of R f: R (omega x f + f'); hardly depends on the bias: the first of the batch stands for all
        slope = np.matvec(so3.hat(omega[0]), force[0])
        slope += force_slope if accel_matrix is None else force_slope @ accel_matrix[0].T
        slope = np.matvec(dR[0], slope)
        first, last = slope[:-1], slope[1:]
        gained = h * (0.5 * (before + after) + (h / 12.0) * (first - last))
        moved = (h * h) * (0.35 * before + 0.15 * after + h * (0.05 * first - last / 30.0))
    np.add.accumulate(gained, axis=1, out=dv[:, 1:])
    np.add.accumulate(dv[:, :-1] * h + moved, axis=1, out=dp[:, 1:])
    return Strapdown(dR, dv, dp, segment.t_s - segment.t_s[0], segment.clipping_sigma, felt)


def size_effect(rate: FloatArray, slope: FloatArray) -> FloatArray:
    """What an accelerometer away from the origin measures besides the force there: hat(alpha) + hat(omega)^2.

    Row i times the position of axis i, m, is what that axis adds, m/s^2. Shape (n, 3, 3).

    Args:
        rate: rad/s, shape (n, 3).
        slope: Its derivative, rad/s^2, shape (n, 3).
    """
    hats = so3.hat(rate)
    return so3.hat(slope) + hats @ hats


def products(steps: FloatArray) -> FloatArray:
    """Products of the first 0, 1, 2, ... rotation steps; shape (S, K, 3, 3) -> (S, K + 1, 3, 3)."""
    S, K = steps.shape[:2]
    dR = np.empty((S, K + 1, 3, 3))
    dR[:, 0] = so3.IDENTITY
    if K > _SHORT:  # pieces of sqrt(K) steps at once, then each from where the one before has ended
        k = int(np.sqrt(K))
        m = -(-K // k)
        pieces = np.empty((S, m * k, 3, 3))
        pieces[:, :K], pieces[:, K:] = steps, so3.IDENTITY
        pieces = np.ascontiguousarray(np.swapaxes(pieces.reshape(S, m, k, 3, 3), 1, 2))
        for step in range(1, k):
            np.matmul(pieces[:, step - 1], pieces[:, step], out=pieces[:, step])
        begin = products(pieces[:, -1])[:, :-1]
        dR[:, 1:] = np.swapaxes(begin[:, None] @ pieces, 1, 2).reshape(S, m * k, 3, 3)[:, :K]
    else:
        dR[:, 1:] = steps
        done = 1  # factors of each product
        while done < K:
            dR[:, done + 1 :] = dR[:, 1:-done] @ dR[:, done + 1 :]
            done *= 2
    return dR


def rotation_steps(omega: FloatArray, dt: FloatArray, slope: FloatArray | None = None) -> FloatArray:
    """Rotation over each interval for a rate linear (or cubic) in time, with the coning term.

    Exp(dt (w0 + w1)/2 + dt^2/12 (w0' - w1') + dt^2/12 w0 x w1) (Magnus expansion).

    Args:
        omega: Rates at the nodes, rad/s, shape (S, n + 1, 3).
        dt: Interval lengths, s, shape (n,).
        slope: Derivatives of the rates at the nodes, rad/s^2, shape (n + 1, 3); None: straight lines.

    Returns:
        Rotations, shape (S, n, 3, 3).
    """
    w0, w1 = omega[:, :-1], omega[:, 1:]
    half = 0.5 * dt[:, None]
    # The coning term hardly depends on the bias: the first of the batch stands for all.
    coning = np.matvec(so3.hat(w0[:1]), w1[:1])
    if slope is not None:
        coning += slope[:-1] - slope[1:]
    return so3.exp(half * (w0 + w1 + coning * (half / 3.0)))


def compose(start: Motion, relative: Strapdown, gravity: FloatArray) -> Motion:
    """Apply the relative motion of the last node to start poses under gravity.

    Args:
        start: Poses at the start, batch of S.
        relative: Output of `strapdown`, same batch.
        gravity: Acceleration of free fall in the world, m/s^2, shape (S, 3).

    Returns:
        Poses at the end of the segment.
    """
    T = relative.t_s[-1]
    p = start.p + T * start.v + (0.5 * T * T) * gravity
    p += np.matvec(start.R, relative.dp[:, -1])
    v = start.v + T * gravity + np.matvec(start.R, relative.dv[:, -1])
    return Motion(np.matmul(start.R, relative.dR[:, -1]), p, v)


class Influence(NamedTuple):
    """What errors of the readings, made at each node of a segment, do to its end.

    Attributes:
        at: [rotation (local, right) 3, position 3, velocity 3] at the end by a rate error (three columns) and
            a force error (three) that act for a second, shape (n + 1, 9, 6).
        weights: Duration that each node stands for (trapezoids), s, shape (n + 1,).
        beyond: By how much trapezoids exaggerate the integral of the squared time to the end, s^3.
        clipping_sigma: See `ImuSegment`.
    """

    at: FloatArray
    weights: FloatArray
    beyond: float
    clipping_sigma: FloatArray | None = None

    def by_bias(self) -> FloatArray:
        """Return the end by constant biases [gyro 3, accel 3], shape (9, 6); Forster et al. 2017, (69)."""
        return -(self.weights @ self.at.reshape(-1, 54)).reshape(9, 6)

    def by_force(self, force: FloatArray) -> FloatArray:
        """Return the end by a force error, m/s^2 at each node, shape (n + 1, 3), in shape (9,)."""
        return np.asarray(self.weights @ np.matvec(self.at[:, :, 3:6], force))

    def noise(self, noise: ImuNoise) -> FloatArray:
        """Covariance of the end by white noise of the readings, and by those clipped, shape (9, 9)."""
        roots = np.sqrt(self.weights)[:, None] * _densities(noise)
        G = (self.at * roots[:, None, :]).transpose(1, 0, 2).reshape(9, -1)
        covariance = G @ G.T
        covariance[3:6, 3:6] -= (noise.accel_density**2 * self.beyond) * so3.IDENTITY
        by_clipping = self.by_clipping()
        if by_clipping is not None:
            covariance += by_clipping @ by_clipping.T
        return covariance + _ROUNDING

    def by_clipping(self) -> FloatArray | None:
        """Return one sigma of the end by what clipped readings of a channel miss, shape (9, 6), or None."""
        if self.clipping_sigma is None:
            return None
        return np.asarray(np.einsum("kij,kj->ij", self.at, self.weights[:, None] * self.clipping_sigma))


def _densities(noise: ImuNoise) -> FloatArray:
    return np.array([noise.gyro_density] * 3 + [noise.accel_density] * 3)


def influence(R_start: FloatArray, relative: Strapdown) -> Influence:
    """Follow an error of rate or force from where it is made to the end of the segment, in closed form.

    A turn d theta at s (imu frame) turns all specific force integrated after it:
    d v_end = -hat(V_end - V(s)) R(s) d theta, d p_end = -hat(P_end - P(s) - V(s) (T - s)) R(s) d theta.
    (tested against a Monte Carlo of the integration, and against differences)

    Args:
        R_start: R_world_imu at the start, shape (3, 3); positions and velocities come out in its world.
        relative: Strapdown of the nominal, batch of 1 (index 0 is used).

    Returns:
        The influence of each node.
    """
    t = relative.t_s
    R = R_start @ relative.dR[0]
    V = relative.dv[0] @ R_start.T
    P = relative.dp[0] @ R_start.T
    at = _influence_at(R, V, P, (t[-1] - t)[:, None], (R[-1], V[-1], P[-1]))
    return Influence(at, *_trapezoids(t), relative.clipping_sigma)


def _influence_at(
    R: FloatArray, V: FloatArray, P: FloatArray, left: FloatArray, end: tuple[FloatArray, ...]
) -> FloatArray:
    """See `Influence.at`: by the motion at each node, the time left until the end (n, 1), and the end."""
    by_turn = np.empty((len(R), 9, 3))  # made in the imu frame at the begin
    by_turn[:, 0:3] = np.swapaxes(end[0], -1, -2)
    by_turn[:, 3:6] = so3.hat(P + V * left - end[2])
    by_turn[:, 6:9] = so3.hat(V - end[1])
    at = np.zeros((len(R), 9, 6))
    np.matmul(by_turn, R, out=at[:, :, 0:3])
    np.multiply(R, left[..., None], out=at[:, 3:6, 3:6])
    at[:, 6:9, 3:6] = R
    return at


def _trapezoids(t: FloatArray) -> tuple[FloatArray, float]:
    """See `Influence.weights` and `Influence.beyond`."""
    dt = t[1:] - t[:-1]
    weights = np.zeros(len(t))
    weights[1:] = half = 0.5 * dt
    weights[:-1] += half
    return weights, float((dt * dt) @ dt) / 6.0


class Intervals(NamedTuple):
    """Relative motion over each of m intervals, in the imu frame at its begin.

    Attributes:
        dt: Length, s, shape (m,).
        dR: Rotation, shape (m, 3, 3).
        dv, dp: Integrals of the specific force, m/s and m, shape (m, 3).
        nodes: The readings of each.
        influences: What their errors do to its end; empty unless asked for.
    """

    dt: FloatArray
    dR: FloatArray
    dv: FloatArray
    dp: FloatArray
    nodes: list[slice]
    influences: list[Influence]


def over_intervals(relative: Strapdown, begin: npt.NDArray[np.intp], *, errors: bool = False) -> Intervals:
    """Take a strapdown over several intervals apart.

    Args:
        relative: Over all of them, batch of 1, see `ImuBuffer.intervals`.
        begin: First node of each, shape (m,).
        errors: Return what errors of the readings do, too.
    """
    t, dR, dv, dp = relative.t_s, relative.dR[0], relative.dv[0], relative.dp[0]
    stop = np.append(begin[1:], len(t))
    first, last = np.repeat(begin, stop - begin), stop - 1
    from_begin = np.swapaxes(dR[first], 1, 2)
    since = (t - t[first])[:, None]
    R = from_begin @ dR
    V = np.matvec(from_begin, dv - dv[first])
    P = np.matvec(from_begin, dp - dp[first] - since * dv[first])
    nodes = [slice(int(a), int(b)) for a, b in zip(begin, stop, strict=True)]
    influences: list[Influence] = []
    if errors:
        end = np.repeat(last, stop - begin)
        at = _influence_at(R, V, P, (t[end] - t)[:, None], (R[end], V[end], P[end]))
        sigma = relative.clipping_sigma
        clipping = [None if sigma is None else sigma[own] for own in nodes]
        influences = [
            Influence(at[own], *_trapezoids(t[own]), clipped)
            for own, clipped in zip(nodes, clipping, strict=True)
        ]
    return Intervals(t[last] - t[begin], R[last], V[last], P[last], nodes, influences)
