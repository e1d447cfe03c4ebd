"""What motion is missing, in words: from the covariance of a calibration and from how the rig turned.

A direction whose sigma is above its limit is named, in words that a person holding the rig understands (the
optical axis, the image's x axis), together with the motion that would reveal it. Which motion that is follows
from observability (docs/math/observability.md): the lever arm needs rotation about two axes, the mounting
too, the delay needs a rate that changes. Live: feed `RunningMotion` with the gyro and ask `guidance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.measurements import ConvergenceTargets

FloatArray = npt.NDArray[np.float64]

_DEG = np.pi / 180.0
WIDE = ConvergenceTargets(0.005, 0.5 * _DEG, 0.5e-3)  # beyond: a direction counts as not observed at all
_STILL_RPS = 3.0 * _DEG
_SLOW_RPS = 12.0 * _DEG
_ONE_AXIS = (
    0.03  # second over first eigenvalue of the rates' scatter below which the rig turned about one axis
)
_BLOCK_S = 0.1
_ALONG = 0.85  # cosine above which two directions are called the same
_TURNS = ("the image's x axis (nod)", "the image's y axis (shake)", "the optical axis (roll)")
_STEADY = "the rotation rate hardly changes; turn to and fro instead of steadily round"


@dataclass(frozen=True)
class Missing:
    """One direction that is not known, and what would reveal it.

    Attributes:
        block: lever_arm, rotation or timeshift.
        direction: In words, e.g. "the optical axis"; empty for the time shift.
        axis_cam: The direction in the camera frame, unit length, shape (3,); zeros for the time shift.
        sigma: Standard deviation along it, m, rad or s.
        motion: The motion that would reveal it.
        limit: Above which sigma it counts as unknown.
    """

    block: str
    direction: str
    axis_cam: FloatArray
    sigma: float
    motion: str
    limit: float

    @property
    def name(self) -> str:
        """What is not known, e.g. "lever arm along the optical axis"."""
        return {
            "lever_arm": f"lever arm along {self.direction}",
            "rotation": f"rotation about {self.direction}",
            "timeshift": "time shift",
        }[self.block]

    @property
    def excess(self) -> float:
        """Its sigma over the limit; above 1."""
        return self.sigma / self.limit

    @property
    def said(self) -> str:
        """Name and figure."""
        figure = {
            "lever_arm": f"{1e3 * self.sigma:.1f} mm",
            "rotation": f"{self.sigma / _DEG:.2f} deg",
            "timeshift": f"{1e3 * self.sigma:.2f} ms",
        }[self.block]
        return f"{self.name}: +-{figure}"

    def __str__(self) -> str:
        """One line for a person."""
        return f"{self.name}: {self.motion}"


class RunningMotion:
    """How the rig turned of late: what `guidance` needs to know of the gyro, kept for next to nothing.

    Rates are averaged over tenths of a second, so that the gyro's noise is not taken for acceleration.

    Args:
        memory_s: Older motion counts less and less, with this time constant, s.
    """

    def __init__(self, memory_s: float = 20.0) -> None:
        self._keep = float(np.exp(-_BLOCK_S / memory_s))
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
        if not t_s - self._begin_s < _BLOCK_S:  # also at the first reading
            self._finish_block(t_s)

    def _finish_block(self, t_s: float) -> None:
        rate = np.array(self._sum) / self._count
        dt, self._begin_s = t_s - self._begin_s, t_s
        self._sum, self._count = [0.0, 0.0, 0.0], 0
        self._weight = self._keep * self._weight + 1.0
        self._mean += (rate - self._mean) / self._weight
        self._scatter += (np.outer(rate, rate) - self._scatter) / self._weight
        if self._last is not None and dt < 3.0 * _BLOCK_S:
            self._changes = self._keep * self._changes + 1.0
            square = float(np.sum((rate - self._last) ** 2)) / dt**2
            self._change += (square - self._change) / self._changes
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


def guidance(
    pose_covariance: FloatArray,
    R_imu_cam: FloatArray,
    timeshift_sigma_s: float,
    motion: RunningMotion,
    limits: ConvergenceTargets,
    bias_rps: FloatArray | None = None,
) -> list[Missing]:
    """Name what is not known well enough, worst first, with the motion that would reveal it.

    Args:
        pose_covariance: Of T_imu_cam, order [p r], m and rad (rotation local), shape (6, 6).
        R_imu_cam: Present mounting, shape (3, 3).
        timeshift_sigma_s: Standard deviation of the time shift, s.
        motion: How the rig turned.
        limits: What is good enough.
        bias_rps: The gyro's bias, shape (3,).

    Returns:
        The gaps; empty when everything is known well enough.
    """
    covariance = np.zeros((7, 7))
    covariance[:6, :6], covariance[6, 6] = pose_covariance, timeshift_sigma_s**2
    scatter = motion.scatter(bias_rps)
    found = missing_motion(covariance, R_imu_cam, scatter, motion.rate_change_rps2, limits)
    return sorted(found, key=lambda m: -m.excess)


def shortcoming(
    motion: RunningMotion, R_imu_cam: FloatArray | None, bias_rps: FloatArray | None = None
) -> str:
    """What is wrong with the motion as a whole, and what to do; empty where it is rich enough.

    Args:
        motion: How the rig turned of late.
        R_imu_cam: Present mounting, for naming axes, shape (3, 3); None: not known yet.
        bias_rps: The gyro's bias, shape (3,).
    """
    turning = _Turning.of(motion.scatter(bias_rps), np.eye(3) if R_imu_cam is None else R_imu_cam)
    if turning.rms_rps < _SLOW_RPS:
        return turning._general()
    if turning.one_axis:
        about = "one axis" if R_imu_cam is None else axis_words(turning.axis_cam)
        return f"so far it turned about {about} only; rotate about another axis too"
    steady = motion.rate_change_rps2
    if steady is not None and steady < 0.3 * turning.rms_rps:
        return _STEADY
    return ""


def axis_words(axis_cam: FloatArray) -> str:
    """Name a direction given in the camera frame (x right, y down, z forward)."""
    axis = np.asarray(axis_cam, dtype=np.float64) / np.linalg.norm(axis_cam)
    names = ("the image's x axis", "the image's y axis", "the optical axis")
    i = int(np.argmax(np.abs(axis)))
    if abs(axis[i]) > _ALONG:
        return names[i]
    j = int(np.argsort(np.abs(axis))[1])
    if abs(axis[i]) ** 2 + abs(axis[j]) ** 2 > _ALONG**2 and abs(axis[j]) > 0.3:
        short = ("x", "y", "optical")
        return f"a line between the camera's {short[min(i, j)]} and {short[max(i, j)]} axes"
    return "a line oblique to all axes of the camera"


def missing_motion(
    covariance: FloatArray,
    R_imu_cam: FloatArray,
    rate_scatter: FloatArray,
    rate_change_rps2: float | None = None,
    limits: ConvergenceTargets = WIDE,
) -> list[Missing]:
    """Say which directions of a calibration are not known, and what motion would reveal them.

    Args:
        covariance: Of [p_imu_cam (3, imu frame, m), R_imu_cam (3, local, rad), time shift (s)], shape (7, 7).
        R_imu_cam: Mounting, shape (3, 3).
        rate_scatter: Mean of w w' over the data, w the bias-free rate in the imu frame, (rad/s)^2, shape (3,
            3).
        rate_change_rps2: RMS angular acceleration, rad/s^2; None: not known.
        limits: Above which sigma a direction counts as unknown.

    Returns:
        The directions, worst first within each block; empty when all is known.
    """
    turning = _Turning.of(rate_scatter, R_imu_cam)
    found: list[Missing] = []
    in_cam = R_imu_cam.T @ covariance[:3, :3] @ R_imu_cam
    for sigma, axis in _beyond(in_cam, limits.position_m):
        advice = turning.advice_lever_arm(axis)
        found.append(Missing("lever_arm", axis_words(axis), axis, sigma, advice, limits.position_m))
    for sigma, axis in _beyond(covariance[3:6, 3:6], limits.rotation_rad):
        advice = turning.advice_rotation(axis)
        found.append(Missing("rotation", axis_words(axis), axis, sigma, advice, limits.rotation_rad))
    sigma_t = float(np.sqrt(covariance[6, 6]))
    if sigma_t > limits.timeshift_s:
        advice = turning.advice_timeshift(rate_change_rps2)
        found.append(Missing("timeshift", "", np.zeros(3), sigma_t, advice, limits.timeshift_s))
    return found


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

    def _general(self) -> str:
        if self.rms_rps < _STILL_RPS:
            return "the rig hardly turns; turn it to and fro about two axes at 20 to 60 deg/s"
        if self.rms_rps < _SLOW_RPS:
            rate = f"{self.rms_rps / _DEG:.0f} deg/s"
            return f"it turns at only {rate}; turn faster, 20 to 60 deg/s, about two axes"
        return ""

    def _about_others(self, axis: FloatArray) -> str:
        """Rotations across a direction: those that show what lies along it."""
        along = int(np.argmax(np.abs(axis)))
        return " and ".join(f"about {_TURNS[i]}" for i in range(3) if i != along)

    def advice_lever_arm(self, axis: FloatArray) -> str:
        if self.one_axis and self.rms_rps >= _STILL_RPS:
            about = axis_words(self.axis_cam)
            if abs(float(axis @ self.axis_cam)) > _ALONG:
                return f"so far it turned about {about} only; rotate about another axis"
            return f"so far it turned about {about} only; rotate about another axis too, and faster"
        return self._general() or f"rotate {self._about_others(axis)}"

    def advice_rotation(self, axis: FloatArray) -> str:
        if self.one_axis and self.rms_rps >= _STILL_RPS and abs(float(axis @ self.axis_cam)) > 0.5:
            return f"so far it turned about {axis_words(self.axis_cam)} only; rotate about another axis"
        return self._general() or f"rotate {self._about_others(axis)}"

    def advice_timeshift(self, rate_change_rps2: float | None) -> str:
        if self.rms_rps < _STILL_RPS:
            return "without rotation the delay hardly shows; turn the rig to and fro"
        if rate_change_rps2 is not None and rate_change_rps2 < 0.3 * self.rms_rps:
            return _STEADY
        return self._general() or "turn the rig back and forth faster, changing direction"
