"""What motion is missing: from the covariance of a calibration and from how the rig turned.

A direction whose sigma is above its limit is given together with the motion that would reveal it. Which
motion that is follows from observability (docs/math/observability.md): the lever arm needs rotation about
two axes, the mounting too, the delay needs a rate that changes. Live: feed `RunningMotion` with the gyro and
ask `weak_directions`. `wording` names directions and motions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.guidance import AXES, Axis, Block, Guidance, Lack, Verb, WeakDirection
from vical_daemon.estimation.measurements import ConvergenceTargets, FloatArray
from vical_daemon.estimation.model.rates import RATE_BLOCK_S
from vical_daemon.estimation.temporal.rotation_turns import MIN_RATE_RPS
from vical_daemon.estimation.wording import ALONG

WIDE = ConvergenceTargets(0.005, math.radians(0.5), 0.5e-3)
"""Beyond, a direction counts as not observed at all."""
_SLOW_RPS = 4.0 * MIN_RATE_RPS  # rms; below, guidance asks for faster turns
_ONE_AXIS = 0.03
"""Second over first eigenvalue of the rates' scatter, below which the rig turned about one axis."""
_STEADY = 0.3  # change of the rate in a second over the rate, below which it turns steadily
_NEAR = 0.5  # cosine above which turning about an axis is much the same as about a direction
_GOOD_AXES: tuple[Axis, ...] = ("x", "y")  # any two will do; with these the target stays in view
ALL_WAYS = Guidance(Verb.TURN_AND_MOVE, AXES)


class RunningMotion:
    """How the rig turned lately: what `weak_directions` needs to know of the gyro, at little cost.

    Rates are averaged over tenths of a second, so that the gyro's noise is not taken for acceleration.

    Args:
        memory_s: Older motion counts less and less, with this time constant, s.
    """

    def __init__(self, memory_s: float = 20.0) -> None:
        self._keep = float(np.exp(-RATE_BLOCK_S / memory_s))
        self._begin_s = float("nan")
        self._sum, self._count = [0.0, 0.0, 0.0], 0
        self._last: FloatArray | None = None
        self._weight = self._changes = 0.0
        self._mean, self._scatter, self._change = np.zeros(3), np.zeros((3, 3)), 0.0

    def add(self, t_s: float, gyro_rps: Sequence[float] | FloatArray) -> None:
        """Take one reading (s; rad/s in the imu frame)."""
        total = self._sum
        total[0] += gyro_rps[0]
        total[1] += gyro_rps[1]
        total[2] += gyro_rps[2]
        self._count += 1
        if not t_s - self._begin_s < RATE_BLOCK_S:  # also at the first reading
            self._finish_block(t_s)

    def _finish_block(self, t_s: float) -> None:
        rate = np.array(self._sum) / self._count
        dt, self._begin_s = t_s - self._begin_s, t_s
        self._sum, self._count = [0.0, 0.0, 0.0], 0
        self._weight = self._keep * self._weight + 1.0
        self._mean += (rate - self._mean) / self._weight
        self._scatter += (rate[:, None] * rate - self._scatter) / self._weight
        if self._last is not None and dt < 3.0 * RATE_BLOCK_S:
            self._changes = self._keep * self._changes + 1.0
            change = (rate - self._last) / dt
            self._change += (float(change @ change) - self._change) / self._changes
        self._last = rate

    def scatter(self, bias_rps: FloatArray | None = None) -> FloatArray:
        """Mean of w w', w the rate less the gyro's bias, (rad/s)^2, shape (3, 3)."""
        b = np.zeros(3) if bias_rps is None else np.asarray(bias_rps, dtype=np.float64)
        cross = np.outer(self._mean, b)
        return self._scatter - cross - cross.T + np.outer(b, b)

    @property
    def rate_change_rps2(self) -> float | None:
        """RMS angular acceleration, rad/s^2; None before there are two blocks."""
        return float(np.sqrt(self._change)) if self._changes else None


def excitation_advice(
    motion: RunningMotion, R_imu_cam: FloatArray | None, bias_rps: FloatArray | None = None
) -> Guidance:
    """What is wrong with the motion as a whole, and what to do; nothing where it is rich enough.

    Args:
        motion: How the rig turned lately.
        R_imu_cam: Present mounting, for naming axes, shape (3, 3); None: not known yet.
        bias_rps: The gyro's bias, shape (3,).
    """
    turning = _Turning.of(motion.scatter(bias_rps), np.eye(3) if R_imu_cam is None else R_imu_cam)
    if turning.rms_rps < _SLOW_RPS:
        return turning.too_little(_GOOD_AXES)
    if turning.one_axis:
        if R_imu_cam is None:
            return Guidance(Verb.TURN, _GOOD_AXES, Lack.ONE_AXIS)
        return turning.about_another(Verb.TURN)
    if turning.steady(motion.rate_change_rps2):
        return Guidance(Verb.TURN_TO_AND_FRO, _GOOD_AXES, Lack.STEADY_RATE)
    return Guidance()


def weak_directions(
    pose_covariance: FloatArray,
    R_imu_cam: FloatArray,
    timeshift_sigma_s: float,
    motion: RunningMotion,
    limits: ConvergenceTargets = WIDE,
    bias_rps: FloatArray | None = None,
) -> list[WeakDirection]:
    """Find which directions of a calibration are not known, worst first, and what motion would reveal them.

    Args:
        pose_covariance: Of T_imu_cam, order [p r], m and rad (rotation local), shape (6, 6).
        R_imu_cam: Present mounting, shape (3, 3).
        timeshift_sigma_s: Standard deviation of the time shift, s.
        motion: How the rig turned.
        limits: Above which sigma a direction counts as unknown.
        bias_rps: The gyro's bias, shape (3,).
    """
    turning = _Turning.of(motion.scatter(bias_rps), R_imu_cam)
    found: list[WeakDirection] = []
    in_cam = R_imu_cam.T @ pose_covariance[:3, :3] @ R_imu_cam
    for sigma, axis in _beyond(in_cam, limits.position_m):
        advice = turning.for_lever_arm(axis)
        found.append(WeakDirection(Block.LEVER_ARM, _plain(axis), sigma, limits.position_m, advice))
    for sigma, axis in _beyond(pose_covariance[3:, 3:], limits.rotation_rad):
        advice = turning.for_rotation(axis)
        found.append(WeakDirection(Block.ROTATION, _plain(axis), sigma, limits.rotation_rad, advice))
    if timeshift_sigma_s > limits.timeshift_s:
        advice = turning.for_timeshift(motion.rate_change_rps2)
        nowhere = (0.0, 0.0, 0.0)
        found.append(WeakDirection(Block.TIMESHIFT, nowhere, timeshift_sigma_s, limits.timeshift_s, advice))
    return sorted(found, key=lambda m: -m.excess)


def _plain(axis: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(a) for a in axis)
    return x, y, z


def _beyond(block: FloatArray, limit: float) -> list[tuple[float, FloatArray]]:
    """Principal directions of a covariance whose sigma is above a limit, worst first."""
    values, vectors = np.linalg.eigh(0.5 * (block + block.T))
    sigmas = np.sqrt(np.maximum(values, 0.0))
    return [(float(sigmas[i]), vectors[:, i]) for i in (2, 1, 0) if not sigmas[i] <= limit]


@dataclass(frozen=True)
class _Turning:
    """How the rig turned: RMS rate, the axis it turned about most (camera frame), and whether only that."""

    rms_rps: float
    axis_cam: FloatArray
    one_axis: bool

    @classmethod
    def of(cls, rate_scatter: FloatArray, R_imu_cam: FloatArray) -> _Turning:
        values, vectors = np.linalg.eigh(0.5 * (rate_scatter + rate_scatter.T))
        rms = float(np.sqrt(max(float(np.trace(rate_scatter)), 0.0)))
        one = bool(values[1] < _ONE_AXIS * values[2])
        return cls(rms, R_imu_cam.T @ vectors[:, 2], one)

    def too_little(self, axes: tuple[Axis, ...]) -> Guidance:
        """What to do where it hardly turns, or slowly; nothing where it turns fast enough."""
        if self.rms_rps < MIN_RATE_RPS:
            return Guidance(Verb.TURN, axes, Lack.STILL, rate_rps=self.rms_rps)
        if self.rms_rps < _SLOW_RPS:
            return Guidance(Verb.TURN_FASTER, axes, Lack.SLOW, rate_rps=self.rms_rps)
        return Guidance()

    def about_another(self, verb: Verb) -> Guidance:
        """Turn about another axis than so far."""
        alike = np.abs(self.axis_cam)
        axes = tuple(a for a, c in zip(AXES, alike, strict=True) if c < _NEAR) or (
            AXES[int(np.argmin(alike))],
        )
        return Guidance(verb, axes, Lack.ONE_AXIS, _plain(self.axis_cam))

    def steady(self, rate_change_rps2: float | None) -> bool:
        """Whether the rate hardly changes."""
        return rate_change_rps2 is not None and rate_change_rps2 < _STEADY * self.rms_rps

    def _about_others(self, axis: FloatArray) -> Guidance:
        """Rotations across a direction: those that show what lies along it."""
        along = int(np.argmax(np.abs(axis)))
        others = tuple(AXES[i] for i in range(3) if i != along)
        return self.too_little(others) or Guidance(Verb.TURN, others)

    def for_lever_arm(self, axis: FloatArray) -> Guidance:
        if self.one_axis and self.rms_rps >= MIN_RATE_RPS:
            along = abs(float(axis @ self.axis_cam)) > ALONG
            return self.about_another(Verb.TURN if along else Verb.TURN_FASTER)
        return self._about_others(axis)

    def for_rotation(self, axis: FloatArray) -> Guidance:
        if self.one_axis and self.rms_rps >= MIN_RATE_RPS and abs(float(axis @ self.axis_cam)) > _NEAR:
            return self.about_another(Verb.TURN)
        return self._about_others(axis)

    def for_timeshift(self, rate_change_rps2: float | None) -> Guidance:
        if self.rms_rps < MIN_RATE_RPS:
            return Guidance(Verb.TURN_TO_AND_FRO, _GOOD_AXES, Lack.STILL, rate_rps=self.rms_rps)
        if self.steady(rate_change_rps2):
            return Guidance(Verb.TURN_TO_AND_FRO, _GOOD_AXES, Lack.STEADY_RATE)
        return self.too_little(_GOOD_AXES) or Guidance(Verb.TURN_TO_AND_FRO, _GOOD_AXES, Lack.FAST_CHANGES)
