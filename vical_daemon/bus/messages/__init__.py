"""The messages on the bus: ROS 2 messages in CDR, built and read without ROS.

The bytes on the bus are the bytes in the log. `encode_*` builds a message, `decode_*` reads one into a
small frozen dataclass with our names and units. It raises only `MessageError`, for any bytes.
`admit_*` also refuses values that no device measures. Roles use `admit_*`.
"""

from vical_daemon.bus.messages.admission import (
    ImplausibleError,
    admit_calibration,
    admit_image,
    admit_imu,
    admit_points,
    admit_stamp_sigma_s,
    admit_verification,
)
from vical_daemon.bus.messages.calibration import (
    CALIBRATION_TYPE,
    CalibrationMessage,
    decode_calibration,
    encode_calibration,
    merge_calibrations,
)
from vical_daemon.bus.messages.cdr import MessageError
from vical_daemon.bus.messages.decoders import check_message
from vical_daemon.bus.messages.diagnostics import (
    DIAGNOSTICS_TYPE,
    STRING_TYPE,
    DiagnosticsMessage,
    DiagnosticStatus,
    Level,
    decode_diagnostics,
    decode_string,
    encode_diagnostics,
    encode_string,
)
from vical_daemon.bus.messages.image import (
    CAMERA_INFO_TYPE,
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    CameraInfoMessage,
    CompressedImageMessage,
    ImageMessage,
    decode_camera_info,
    decode_compressed_image,
    decode_image,
    encode_camera_info,
    encode_compressed_image,
    encode_image,
)
from vical_daemon.bus.messages.imu import IMU_TYPE, ImuMessage, decode_imu, encode_imu, imu_encoder
from vical_daemon.bus.messages.points import (
    POINTS_TYPE,
    TRACKS_TYPE,
    PointsMessage,
    decode_points,
    encode_points,
)
from vical_daemon.bus.messages.poses import (
    POSE_TYPE,
    TF_TYPE,
    PoseMessage,
    Transform,
    decode_pose,
    decode_transforms,
    encode_pose,
    encode_transforms,
)
from vical_daemon.bus.messages.schemas import ros2_schema
from vical_daemon.bus.messages.verification import (
    VERIFY_TYPE,
    Change,
    CheckState,
    VerifyResult,
    decode_verification,
    encode_verification,
)

__all__ = [
    "CALIBRATION_TYPE",
    "CAMERA_INFO_TYPE",
    "COMPRESSED_IMAGE_TYPE",
    "DIAGNOSTICS_TYPE",
    "IMAGE_TYPE",
    "IMU_TYPE",
    "POINTS_TYPE",
    "POSE_TYPE",
    "STRING_TYPE",
    "TF_TYPE",
    "TRACKS_TYPE",
    "VERIFY_TYPE",
    "CalibrationMessage",
    "CameraInfoMessage",
    "Change",
    "CheckState",
    "CompressedImageMessage",
    "DiagnosticStatus",
    "DiagnosticsMessage",
    "ImageMessage",
    "ImplausibleError",
    "ImuMessage",
    "Level",
    "MessageError",
    "PointsMessage",
    "PoseMessage",
    "Transform",
    "VerifyResult",
    "admit_calibration",
    "admit_image",
    "admit_imu",
    "admit_points",
    "admit_stamp_sigma_s",
    "admit_verification",
    "check_message",
    "decode_calibration",
    "decode_camera_info",
    "decode_compressed_image",
    "decode_diagnostics",
    "decode_image",
    "decode_imu",
    "decode_points",
    "decode_pose",
    "decode_string",
    "decode_transforms",
    "decode_verification",
    "encode_calibration",
    "encode_camera_info",
    "encode_compressed_image",
    "encode_diagnostics",
    "encode_image",
    "encode_imu",
    "encode_points",
    "encode_pose",
    "encode_string",
    "encode_transforms",
    "encode_verification",
    "imu_encoder",
    "merge_calibrations",
    "ros2_schema",
]
