"""Whether a wrong unit of the gyro is why rotations do not agree: then no delay fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.units import ImuArrays, gyro_mistake
from vical_daemon.estimation.temporal.td_icp_result import REFUSED, TdIcpResult

FloatArray = npt.NDArray[np.float64]

_APART = 6.0
"""Times that rates differ from which on it is named: rpm for rad/s are 9.5 times, deg/s 57. Of rotations that
were seen at the same time they agree to a third."""
_ALIKE = 1.6  # times; the ranges of a gyro are 2 times apart
_HOLE_S = 0.35  # between images: over longer times a hand turns to and fro
_LEAST = 20  # pairs of images


def with_unit_named(
    result: TdIcpResult,
    imu: ImuArrays,
    t_cam_s: FloatArray | None = None,
    R_world_cam: FloatArray | None = None,
) -> TdIcpResult:
    """Return a result; one that was refused because of the gyro's unit says so.

    Args:
        result: Of the registration.
        imu: Readings of the IMU.
        t_cam_s: Stamps of the camera's orientations, s, shape (n,); None: there are none (tracks).
        R_world_cam: Orientations, shape (n, 3, 3).
    """
    if result.status != REFUSED or result.still or "rad/s" in result.reason:
        return result
    mistake = gyro_mistake(imu)
    if not mistake and t_cam_s is not None and R_world_cam is not None:
        ratio = _ratio(imu, t_cam_s, R_world_cam)
        times = f"{ratio:.2g} times" if ratio > 1.0 else f"only 1/{1.0 / ratio:.2g} of"
        rates = f"the gyro's rates are {times} the camera's"
        if not 1.0 / _APART < ratio < _APART:
            mistake = (
                f"{rates}; rad/s are expected, check its unit (deg/s: multiply by pi/180), and whether this "
                "is the same recording"
            )
        elif not 1.0 / _ALIKE < ratio < _ALIKE:
            mistake = f"{rates}: is its range the one that it was read with? ({result.reason})"
    return replace(result, reason=mistake) if mistake else result


def _ratio(imu: ImuArrays, t_cam_s: FloatArray, R_world_cam: FloatArray) -> float:
    """Compare the larger rates of gyro and camera, which are motion, neither bias nor noise; 1: too few."""
    steps_s = np.diff(t_cam_s)
    near = (steps_s > 0.0) & (steps_s < _HOLE_S)
    if np.count_nonzero(near) < _LEAST:
        return 1.0
    turned = np.swapaxes(R_world_cam[:-1], -1, -2) @ R_world_cam[1:]
    seen = np.linalg.norm(so3.log(turned[near]), axis=-1) / steps_s[near]
    read = np.linalg.norm(imu.gyro_rps - np.median(imu.gyro_rps, axis=0), axis=-1)
    camera, gyro = (float(np.quantile(rates, 0.8)) for rates in (seen, read))
    return max(gyro, 1e-9) / max(camera, 1e-9)
