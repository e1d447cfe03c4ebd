"""What motion is missing, in words: from the covariance of a calibration and from how the rig turned.

A direction whose sigma is above its limit is named, in words that a person holding the rig understands (the
optical axis, the image's x axis), together with the motion that would reveal it. Which motion that is follows
from observability (docs/math/observability.md): the lever arm needs rotation about two axes, the mounting
too, the delay needs a rate that changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_DEG = np.pi / 180.0
_STILL_RPS = 3.0 * _DEG
_SLOW_RPS = 12.0 * _DEG
_ONE_AXIS = (
    0.03  # second over first eigenvalue of the rates' scatter below which the rig turned about one axis
)
_ALONG = 0.85  # cosine above which two directions are called the same


@dataclass(frozen=True)
class Limits:
    """Sigmas above which a direction counts as unknown."""

    lever_arm_m: float = 0.005
    rotation_rad: float = 0.5 * _DEG
    timeshift_s: float = 0.5e-3


@dataclass(frozen=True)
class Missing:
    """One direction that is not known, and what would reveal it.

    Attributes:
        block: lever_arm, rotation or timeshift.
        direction: In words, e.g. "the optical axis"; empty for the time shift.
        axis_cam: The direction in the camera frame, unit length, shape (3,); zeros for the time shift.
        sigma: Standard deviation along it, m, rad or s.
        advice: The motion to make.
    """

    block: str
    direction: str
    axis_cam: FloatArray
    sigma: float
    advice: str

    def __str__(self) -> str:
        """One line for a person."""
        what = {
            "lever_arm": f"lever arm along {self.direction}",
            "rotation": f"rotation about {self.direction}",
            "timeshift": "time shift",
        }[self.block]
        return f"{what}: {self.advice}"


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
    limits: Limits | None = None,
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
    limits = limits or Limits()
    turning = _Turning.of(rate_scatter, R_imu_cam)
    found: list[Missing] = []
    in_cam = R_imu_cam.T @ covariance[:3, :3] @ R_imu_cam
    for sigma, axis in _beyond(in_cam, limits.lever_arm_m):
        found.append(Missing("lever_arm", axis_words(axis), axis, sigma, turning.advice_lever_arm(axis)))
    for sigma, axis in _beyond(covariance[3:6, 3:6], limits.rotation_rad):
        found.append(Missing("rotation", axis_words(axis), axis, sigma, turning.advice_rotation(axis)))
    sigma_t = float(np.sqrt(covariance[6, 6]))
    if sigma_t > limits.timeshift_s:
        advice = turning.advice_timeshift(rate_change_rps2)
        found.append(Missing("timeshift", "", np.zeros(3), sigma_t, advice))
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
        return "keep turning to and fro about all axes"

    def advice_lever_arm(self, axis: FloatArray) -> str:
        if self.one_axis and self.rms_rps >= _STILL_RPS:
            about = axis_words(self.axis_cam)
            if abs(float(axis @ self.axis_cam)) > _ALONG:
                return f"so far it turned about {about} only; rotate about another axis"
            return f"so far it turned about {about} only; rotate about another axis too, and faster"
        return self._general()

    def advice_rotation(self, axis: FloatArray) -> str:
        if self.one_axis and self.rms_rps >= _STILL_RPS and abs(float(axis @ self.axis_cam)) > 0.5:
            return f"so far it turned about {axis_words(self.axis_cam)} only; rotate about another axis"
        return self._general()

    def advice_timeshift(self, rate_change_rps2: float | None) -> str:
        if self.rms_rps < _STILL_RPS:
            return "without rotation the delay hardly shows; turn the rig to and fro"
        if rate_change_rps2 is not None and rate_change_rps2 < 0.3 * self.rms_rps:
            return "the rotation rate hardly changes; turn to and fro instead of steadily round"
        return self._general()
