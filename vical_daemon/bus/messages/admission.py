"""Where messages enter a role: read, and refused if they hold what no device measures.

`decode_*` says what a message holds, for whoever looks at logs; `admit_*` says what a role may work with.
Bounds, their units and sources: `estimation.plausible`. Stamps are judged by stream, see `stamp_gate`.
"""

from __future__ import annotations

import math

from vical_daemon.bus.messages.calibration import CalibrationMessage, decode_calibration
from vical_daemon.bus.messages.cdr import MessageError
from vical_daemon.bus.messages.image import ImageMessage, decode_image
from vical_daemon.bus.messages.imu import ImuMessage, decode_imu
from vical_daemon.bus.messages.points import PointsMessage, decode_points
from vical_daemon.estimation import plausible


class ImplausibleError(MessageError):
    """A message that is well formed and says what cannot be."""


def admit_imu(data: bytes) -> ImuMessage:
    """Read a sensor_msgs/Imu to work with.

    Raises:
        MessageError: No such message.
        ImplausibleError: No device reads this.
    """
    message = decode_imu(data)
    _refuse(plausible.imu_problem(message.gyro_rps, message.specific_force_mps2))
    return message


def admit_points(data: bytes) -> PointsMessage:
    """Read a vical_msgs/TargetPoints or FeatureTracks to work with.

    Raises:
        MessageError: No such message.
        ImplausibleError: No image shows this.
    """
    message = decode_points(data)
    _refuse(plausible.points_problem(message.ids, message.uv_px, message.sigma_px, message.image_size))
    return message


def admit_image(data: bytes) -> ImageMessage:
    """Read a sensor_msgs/Image to work with.

    Raises:
        MessageError: No such message.
        ImplausibleError: No camera has this many pixels.
    """
    message = decode_image(data)
    _refuse(plausible.image_size_problem((message.width, message.height)))
    return message


def admit_calibration(data: bytes) -> CalibrationMessage:
    """Read a vical_msgs/CalibrationEstimate to work with.

    Raises:
        MessageError: No such message.
        ImplausibleError: No camera is like this.
    """
    message = decode_calibration(data)
    known = message.camera_estimate
    _refuse("" if known is None else plausible.camera_problem(known))
    return message


def admit_stamp_sigma_s(microseconds: str) -> float:
    """Read what a driver says of its stamps in its status, as s.

    Raises:
        ImplausibleError: No number, or none that a driver can mean.
    """
    try:
        sigma_s = 1e-6 * float(microseconds)
    except ValueError:
        sigma_s = math.nan
    _refuse(plausible.stamp_sigma_problem(sigma_s))
    return sigma_s


def _refuse(problem: str) -> None:
    if problem:
        raise ImplausibleError(problem)
