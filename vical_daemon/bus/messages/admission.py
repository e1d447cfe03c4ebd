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
from vical_daemon.bus.messages.verification import VerifyResult, decode_verification
from vical_daemon.estimation import plausible

FASTEST_HZ = 1000.0
"""Images per second: the bound of `calibration.detect_rate_hz`."""


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


def admit_verification(data: bytes) -> VerifyResult:
    """Decode a vical_msgs/VerifyResult and check its values.

    Raises:
        MessageError: Not such a message.
        ImplausibleError: A number that is none, or more images than any camera gives.
    """
    message = decode_verification(data)
    numbers = [x for c in message.changes for x in (c.value, c.sigma, *c.axis)]
    if not all(math.isfinite(x) for x in (message.seconds_used, *numbers)):
        _refuse("a value is not finite")
    if not 0.0 <= message.image_rate_hz <= FASTEST_HZ:
        _refuse(f"{message.image_rate_hz:g} images per second")
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
