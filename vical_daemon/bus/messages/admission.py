"""Decoding with plausibility checks, for messages that enter a role.

`decode_*` returns any well-formed message, for reading logs. `admit_*` also refuses values that no device
measures. Bounds, their units and sources: `estimation.plausible`. Stamps are checked per stream, see
`stamp_gate`.
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
    """A well-formed message with values that cannot be true."""


def admit_imu(data: bytes) -> ImuMessage:
    """Decode a sensor_msgs/Imu and check its values.

    Raises:
        MessageError: Not such a message.
        ImplausibleError: No device measures such values.
    """
    message = decode_imu(data)
    _refuse(plausible.imu_problem(message.gyro_rps, message.specific_force_mps2))
    return message


def admit_points(data: bytes) -> PointsMessage:
    """Decode a vical_msgs/TargetPoints or FeatureTracks and check its values.

    Raises:
        MessageError: Not such a message.
        ImplausibleError: No image has such points.
    """
    message = decode_points(data)
    _refuse(plausible.points_problem(message.ids, message.uv_px, message.sigma_px, message.image_size))
    return message


def admit_image(data: bytes) -> ImageMessage:
    """Decode a sensor_msgs/Image and check its size.

    Raises:
        MessageError: Not such a message.
        ImplausibleError: No camera has this many pixels.
    """
    message = decode_image(data)
    _refuse(plausible.image_size_problem((message.width, message.height)))
    return message


def admit_calibration(data: bytes) -> CalibrationMessage:
    """Decode a vical_msgs/CalibrationEstimate and check its values.

    Raises:
        MessageError: Not such a message.
        ImplausibleError: No camera has such a calibration.
    """
    message = decode_calibration(data)
    known = message.camera_estimate
    _refuse("" if known is None else plausible.camera_problem(known))
    return message


def admit_stamp_sigma_s(microseconds: str) -> float:
    """Return the stamp sigma that a driver reports in its status, s.

    Raises:
        ImplausibleError: Not a number, or not plausible.
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
