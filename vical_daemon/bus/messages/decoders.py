"""Table of decoders by type, to check that bytes are a valid message of their type."""

from __future__ import annotations

from collections.abc import Callable

from vical_daemon.bus.messages.calibration import CALIBRATION_TYPE, decode_calibration
from vical_daemon.bus.messages.diagnostics import (
    DIAGNOSTICS_TYPE,
    STRING_TYPE,
    decode_diagnostics,
    decode_string,
)
from vical_daemon.bus.messages.image import (
    CAMERA_INFO_TYPE,
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    decode_camera_info,
    decode_compressed_image,
    decode_image,
)
from vical_daemon.bus.messages.imu import IMU_TYPE, decode_imu
from vical_daemon.bus.messages.points import POINTS_TYPE, TRACKS_TYPE, decode_points
from vical_daemon.bus.messages.poses import POSE_TYPE, TF_TYPE, decode_pose, decode_transforms
from vical_daemon.bus.messages.verification import VERIFY_TYPE, decode_verification

DECODERS: dict[str, Callable[[bytes], object]] = {
    CALIBRATION_TYPE: decode_calibration,
    CAMERA_INFO_TYPE: decode_camera_info,
    COMPRESSED_IMAGE_TYPE: decode_compressed_image,
    DIAGNOSTICS_TYPE: decode_diagnostics,
    IMAGE_TYPE: decode_image,
    IMU_TYPE: decode_imu,
    POINTS_TYPE: decode_points,
    POSE_TYPE: decode_pose,
    STRING_TYPE: decode_string,
    TF_TYPE: decode_transforms,
    TRACKS_TYPE: decode_points,
    VERIFY_TYPE: decode_verification,
}


def check_message(type_name: str, data: bytes) -> None:
    """Raise unless these bytes are a message of this type.

    Args:
        type_name: ROS 2 name of a type in the table of topics.
        data: CDR bytes.

    Raises:
        MessageError: They are not; rosbags, mcap-ros2 or our own readers would fail on them.
    """
    DECODERS[type_name](data)
