"""libdc1394 2.2 as bytes: its structures, numbers and functions; the library is loaded when it is used.

Source: the library's public headers (soname 25; 22 has the same structures). Sizes and offsets are those
of 64-bit Linux and are asserted.
"""

from __future__ import annotations

import ctypes
import logging
from ctypes import POINTER, c_char_p, c_float, c_int, c_int32, c_uint16, c_uint32, c_uint64, c_void_p
from typing import Any

from vical_drivers.errors import MissingLibraryError

_log = logging.getLogger(__name__)

SONAMES = ("libdc1394.so.25", "libdc1394.so.22")
SUCCESS = 0
ON, OFF = 1, 0
ISO_SPEED_400, ISO_SPEED_800 = 2, 3
OPERATION_MODE_1394B = 481
FEATURE_SHUTTER, FEATURE_GAIN, FEATURE_FRAME_RATE = 423, 424, 431
FEATURE_MODE_MANUAL = 736
POLICY_POLL = 673
CAPTURE_FLAGS_DEFAULT = 4
USE_RECOMMENDED = -3
FRAMERATES_HZ = {32: 1.875, 33: 3.75, 34: 7.5, 35: 15.0, 36: 30.0, 37: 60.0, 38: 120.0, 39: 240.0}
CODINGS = {"mono8": 352, "yuv422": 354, "rgb8": 356, "mono16": 357, "raw8": 361}
BAYER_ORDERS = {512: "RGGB", 513: "GBRG", 514: "GRBG", 515: "BGGR"}
FORMAT7_FIRST, FORMAT7_LAST = 88, 95
MODES: dict[int, tuple[int, int, str]] = {
    65: (320, 240, "yuv422"), 67: (640, 480, "yuv422"), 68: (640, 480, "rgb8"),
    69: (640, 480, "mono8"), 70: (640, 480, "mono16"), 71: (800, 600, "yuv422"),
    72: (800, 600, "rgb8"), 73: (800, 600, "mono8"), 74: (1024, 768, "yuv422"),
    75: (1024, 768, "rgb8"), 76: (1024, 768, "mono8"), 77: (800, 600, "mono16"),
    78: (1024, 768, "mono16"), 79: (1280, 960, "yuv422"), 80: (1280, 960, "rgb8"),
    81: (1280, 960, "mono8"), 82: (1600, 1200, "yuv422"), 83: (1600, 1200, "rgb8"),
    84: (1600, 1200, "mono8"), 85: (1280, 960, "mono16"), 86: (1600, 1200, "mono16"),
}  # fmt: skip
"""Fixed video modes whose pixels we understand: width, height, coding."""


class Camera(ctypes.Structure):
    """dc1394camera_t up to what is used; 200 bytes in all."""

    _fields_ = (
        ("guid", c_uint64),
        ("unit", c_int),
        ("unit_spec_id", c_uint32),
        ("_to_iidc_version", ctypes.c_uint8 * 120),
        ("iidc_version", c_uint32),
        ("_pad", c_uint32),
        ("vendor", c_char_p),
        ("model", c_char_p),
        ("vendor_id", c_uint32),
        ("model_id", c_uint32),
        ("bmode_capable", c_uint32),
        ("_rest", ctypes.c_uint8 * 28),
    )


class VideoFrame(ctypes.Structure):
    """dc1394video_frame_t."""

    _fields_ = (
        ("image", c_void_p),
        ("size", c_uint32 * 2),
        ("position", c_uint32 * 2),
        ("color_coding", c_uint32),
        ("color_filter", c_uint32),
        ("yuv_byte_order", c_uint32),
        ("data_depth", c_uint32),
        ("stride", c_uint32),
        ("video_mode", c_uint32),
        ("total_bytes", c_uint64),
        ("image_bytes", c_uint32),
        ("padding_bytes", c_uint32),
        ("packet_size", c_uint32),
        ("packets_per_frame", c_uint32),
        ("timestamp_us", c_uint64),
        ("frames_behind", c_uint32),
        ("camera", c_void_p),
        ("frame_id", c_uint32),
        ("allocated_image_bytes", c_uint64),
        ("little_endian", c_uint32),
        ("data_in_padding", c_uint32),
    )


class CameraId(ctypes.Structure):
    """dc1394camera_id_t."""

    _fields_ = (("unit", c_uint16), ("guid", c_uint64))


class CameraList(ctypes.Structure):
    """dc1394camera_list_t."""

    _fields_ = (("num", c_uint32), ("ids", POINTER(CameraId)))


class VideoModes(ctypes.Structure):
    """dc1394video_modes_t."""

    _fields_ = (("num", c_uint32), ("modes", c_uint32 * 32))


class Framerates(ctypes.Structure):
    """dc1394framerates_t."""

    _fields_ = (("num", c_uint32), ("framerates", c_uint32 * 8))


LAYOUT = {
    "sizeof dc1394camera_t": (ctypes.sizeof(Camera), 200),
    "dc1394camera_t.iidc_version": (Camera.iidc_version.offset, 136),
    "dc1394camera_t.vendor": (Camera.vendor.offset, 144),
    "dc1394camera_t.bmode_capable": (Camera.bmode_capable.offset, 168),
    "sizeof dc1394video_frame_t": (ctypes.sizeof(VideoFrame), 120),
    "dc1394video_frame_t.data_depth": (VideoFrame.data_depth.offset, 36),
    "dc1394video_frame_t.timestamp": (VideoFrame.timestamp_us.offset, 72),
    "dc1394video_frame_t.id": (VideoFrame.frame_id.offset, 96),
    "sizeof dc1394camera_id_t": (ctypes.sizeof(CameraId), 16),
    "dc1394camera_id_t.guid": (CameraId.guid.offset, 8),
    "sizeof dc1394video_modes_t": (ctypes.sizeof(VideoModes), 132),
    "sizeof dc1394framerates_t": (ctypes.sizeof(Framerates), 36),
}
"""What was computed here, and what the C compiler says."""

_C, _U32P, _FP = POINTER(Camera), POINTER(c_uint32), POINTER(c_float)
_PROTOTYPES: dict[str, tuple[Any, list[Any]]] = {
    "new": (c_void_p, []),
    "free": (None, [c_void_p]),
    "camera_enumerate": (c_int, [c_void_p, POINTER(POINTER(CameraList))]),
    "camera_free_list": (None, [POINTER(CameraList)]),
    "camera_new": (_C, [c_void_p, c_uint64]),
    "camera_free": (None, [_C]),
    "camera_reset": (c_int, [_C]),
    "get_control_registers": (c_int, [_C, c_uint64, _U32P, c_uint32]),
    "set_control_registers": (c_int, [_C, c_uint64, _U32P, c_uint32]),
    "video_get_supported_modes": (c_int, [_C, POINTER(VideoModes)]),
    "video_get_supported_framerates": (c_int, [_C, c_uint32, POINTER(Framerates)]),
    "video_get_mode": (c_int, [_C, _U32P]),
    "video_set_mode": (c_int, [_C, c_uint32]),
    "video_get_framerate": (c_int, [_C, _U32P]),
    "video_set_framerate": (c_int, [_C, c_uint32]),
    "video_set_iso_speed": (c_int, [_C, c_uint32]),
    "video_set_operation_mode": (c_int, [_C, c_uint32]),
    "video_set_transmission": (c_int, [_C, c_uint32]),
    "video_get_transmission": (c_int, [_C, _U32P]),
    "get_image_size_from_video_mode": (c_int, [_C, c_uint32, _U32P, _U32P]),
    "format7_get_max_image_size": (c_int, [_C, c_uint32, _U32P, _U32P]),
    "format7_get_unit_size": (c_int, [_C, c_uint32, _U32P, _U32P]),
    "format7_get_packet_parameters": (c_int, [_C, c_uint32, _U32P, _U32P]),
    "format7_get_color_coding": (c_int, [_C, c_uint32, _U32P]),
    "format7_set_roi": (c_int, [_C, c_uint32, c_uint32, *[c_int32] * 5]),
    "feature_is_present": (c_int, [_C, c_uint32, _U32P]),
    "feature_has_absolute_control": (c_int, [_C, c_uint32, _U32P]),
    "feature_set_power": (c_int, [_C, c_uint32, c_uint32]),
    "feature_get_mode": (c_int, [_C, c_uint32, _U32P]),
    "feature_set_mode": (c_int, [_C, c_uint32, c_uint32]),
    "feature_set_absolute_control": (c_int, [_C, c_uint32, c_uint32]),
    "feature_get_absolute_boundaries": (c_int, [_C, c_uint32, _FP, _FP]),
    "feature_get_absolute_value": (c_int, [_C, c_uint32, _FP]),
    "feature_set_absolute_value": (c_int, [_C, c_uint32, c_float]),
    "feature_get_boundaries": (c_int, [_C, c_uint32, _U32P, _U32P]),
    "feature_get_value": (c_int, [_C, c_uint32, _U32P]),
    "feature_set_value": (c_int, [_C, c_uint32, c_uint32]),
    "capture_setup": (c_int, [_C, c_uint32, c_uint32]),
    "capture_stop": (c_int, [_C]),
    "capture_get_fileno": (c_int, [_C]),
    "capture_dequeue": (c_int, [_C, c_uint32, POINTER(POINTER(VideoFrame))]),
    "capture_enqueue": (c_int, [_C, POINTER(VideoFrame)]),
}
_LogHandler = ctypes.CFUNCTYPE(None, c_int, c_char_p, c_void_p)
_library: Any = None


def _forward_log(_kind: int, message: bytes, _user: object) -> None:
    # it prints to stderr otherwise; what matters is raised as an error with the device's name
    _log.debug("libdc1394: %s", message.decode("utf-8", "replace").strip())


_log_handler = _LogHandler(_forward_log)


def load() -> Any:
    """Return the library with typed functions.

    Raises:
        MissingLibraryError: It is not installed; names the package.
    """
    global _library
    if _library is not None:
        return _library
    for name, (found, expected) in LAYOUT.items():
        if found != expected:
            raise MissingLibraryError(
                f"FireWire cameras need 64-bit Linux: {name} is {found}, not {expected}"
            )
    for soname in SONAMES:
        try:
            library = ctypes.CDLL(soname, use_errno=True)
            break
        except OSError:
            continue
    else:
        raise MissingLibraryError("FireWire cameras need libdc1394: sudo apt install libdc1394-25")
    for name, (result, arguments) in _PROTOTYPES.items():
        function = getattr(library, f"dc1394_{name}")
        function.restype, function.argtypes = result, arguments
    library.dc1394_log_register_handler.argtypes = [c_int, _LogHandler, c_void_p]
    for level in (768, 769):
        library.dc1394_log_register_handler(level, _log_handler, None)
    _library = library
    return library
