"""The V4L2 kernel interface as bytes: structures, request numbers, flags.

Source: the kernel's user-space header ``linux/videodev2.h`` (a frozen ABI). Only what a single-planar,
memory-mapped grabber needs. Layouts are those of 64-bit Linux; sizes are asserted when this module is
imported and compared with the installed header by the tests.
"""

from __future__ import annotations

import ctypes
import struct
from ctypes import c_char, c_int32, c_int64, c_uint8, c_uint32, c_uint64, c_void_p

BUF_TYPE_VIDEO_CAPTURE = 1
BUF_TYPE_META_CAPTURE = 13
MEMORY_MMAP = 1
FIELD_NONE = 1

CAP_VIDEO_CAPTURE = 0x00000001
CAP_VIDEO_CAPTURE_MPLANE = 0x00001000
CAP_META_CAPTURE = 0x00800000
CAP_STREAMING = 0x04000000
CAP_DEVICE_CAPS = 0x80000000
CAP_TIMEPERFRAME = 0x1000

BUF_FLAG_ERROR = 0x00000040
BUF_FLAG_TIMESTAMP_MASK = 0x0000E000
BUF_FLAG_TIMESTAMP_UNKNOWN = 0x00000000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x00002000
BUF_FLAG_TSTAMP_SRC_MASK = 0x00070000
BUF_FLAG_TSTAMP_SRC_SOE = 0x00010000

FRMSIZE_TYPE_DISCRETE = 1
FRMIVAL_TYPE_DISCRETE = 1

CTRL_TYPE_INTEGER = 1
CTRL_TYPE_BOOLEAN = 2
CTRL_TYPE_MENU = 3
CTRL_TYPE_BUTTON = 4
CTRL_TYPE_INTEGER64 = 5
CTRL_TYPE_INTEGER_MENU = 9
CTRL_FLAG_DISABLED = 0x0001
CTRL_FLAG_READ_ONLY = 0x0004
CTRL_FLAG_WRITE_ONLY = 0x0040
CTRL_FLAG_NEXT_CTRL = 0x80000000
CTRL_WHICH_CUR_VAL = 0

CID_AUTO_WHITE_BALANCE = 0x0098090C
CID_AUTOGAIN = 0x00980912
CID_GAIN = 0x00980913
CID_EXPOSURE_AUTO = 0x009A0901
CID_EXPOSURE_ABSOLUTE = 0x009A0902
CID_EXPOSURE_AUTO_PRIORITY = 0x009A0903
CID_FOCUS_AUTO = 0x009A090C
CID_IMAGE_STABILIZATION = 0x009A0916
CID_ANALOGUE_GAIN = 0x009E0903
EXPOSURE_MANUAL = 1
EXPOSURE_SHUTTER_PRIORITY = 2
EXPOSURE_UNIT_NS = 100_000
"""One step of CID_EXPOSURE_ABSOLUTE is 100 us."""

EVENT_CTRL = 3


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FmtDesc(ctypes.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class MetaFormat(ctypes.Structure):
    """struct v4l2_meta_format (its first two members; the rest is padding of the union)."""

    _fields_ = (("dataformat", c_uint32), ("buffersize", c_uint32))


class _FormatUnion(ctypes.Union):
    _fields_ = (("pix", PixFormat), ("meta", MetaFormat), ("raw", c_uint8 * 200), ("align", c_void_p))


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Fract(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class _FrmSizeUnion(ctypes.Union):
    # discrete: width, height; stepwise: min, max, step of width, then of height
    _fields_ = (("discrete", c_uint32 * 2), ("stepwise", c_uint32 * 6))


class FrmSizeEnum(ctypes.Structure):
    """struct v4l2_frmsizeenum."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("size", _FrmSizeUnion),
        ("reserved", c_uint32 * 2),
    )


class _FrmIvalUnion(ctypes.Union):
    _fields_ = (("discrete", Fract), ("stepwise", Fract * 3))


class FrmIvalEnum(ctypes.Structure):
    """struct v4l2_frmivalenum."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("ival", _FrmIvalUnion),
        ("reserved", c_uint32 * 2),
    )


class CaptureParm(ctypes.Structure):
    """struct v4l2_captureparm."""

    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fract),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _ParmUnion(ctypes.Union):
    _fields_ = (("capture", CaptureParm), ("raw", c_uint8 * 200))


class StreamParm(ctypes.Structure):
    """struct v4l2_streamparm."""

    _fields_ = (("type", c_uint32), ("parm", _ParmUnion))


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class _BufferMemory(ctypes.Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_uint64), ("fd", c_int32))


class Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("tv_sec", c_int64),
        ("tv_usec", c_int64),
        ("timecode", c_uint8 * 16),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferMemory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class QueryExtCtrl(ctypes.Structure):
    """struct v4l2_query_ext_ctrl."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int64),
        ("maximum", c_int64),
        ("step", c_uint64),
        ("default_value", c_int64),
        ("flags", c_uint32),
        ("elem_size", c_uint32),
        ("elems", c_uint32),
        ("nr_of_dims", c_uint32),
        ("dims", c_uint32 * 4),
        ("reserved", c_uint32 * 32),
    )


class QueryMenu(ctypes.Structure):
    """struct v4l2_querymenu (packed, to no effect); an integer menu has its int64 at the start of `name`."""

    _fields_ = (("id", c_uint32), ("index", c_uint32), ("name", c_char * 32), ("reserved", c_uint32))


class ExtControl(ctypes.Structure):
    """struct v4l2_ext_control (packed); 32-bit controls use the low half of `value64`."""

    _layout_ = "ms"  # the only layout that Python 3.14 packs; without bit fields it is that of gcc
    _pack_ = 1
    _fields_ = (("id", c_uint32), ("size", c_uint32), ("reserved2", c_uint32), ("value64", c_int64))


class ExtControls(ctypes.Structure):
    """struct v4l2_ext_controls."""

    _fields_ = (
        ("which", c_uint32),
        ("count", c_uint32),
        ("error_idx", c_uint32),
        ("request_fd", c_int32),
        ("reserved", c_uint32),
        ("controls", ctypes.POINTER(ExtControl)),
    )


class EventSubscription(ctypes.Structure):
    """struct v4l2_event_subscription."""

    _fields_ = (("type", c_uint32), ("id", c_uint32), ("flags", c_uint32), ("reserved", c_uint32 * 5))


class Event(ctypes.Structure):
    """struct v4l2_event; of the union only its bytes (`changes` is the first word of a control event)."""

    _fields_ = (
        ("type", c_uint32),
        ("union", c_uint64 * 8),
        ("pending", c_uint32),
        ("sequence", c_uint32),
        ("tv_sec", c_int64),
        ("tv_nsec", c_int64),
        ("id", c_uint32),
        ("reserved", c_uint32 * 8),
    )


class BufferType(ctypes.Structure):
    """The bare enum v4l2_buf_type that STREAMON and STREAMOFF take."""

    _fields_ = (("value", c_int32),)


SIZES: dict[str, tuple[type[ctypes.Structure], int]] = {
    "v4l2_capability": (Capability, 104),
    "v4l2_fmtdesc": (FmtDesc, 64),
    "v4l2_pix_format": (PixFormat, 48),
    "v4l2_format": (Format, 208),
    "v4l2_frmsizeenum": (FrmSizeEnum, 44),
    "v4l2_frmivalenum": (FrmIvalEnum, 52),
    "v4l2_streamparm": (StreamParm, 204),
    "v4l2_requestbuffers": (RequestBuffers, 20),
    "v4l2_buffer": (Buffer, 88),
    "v4l2_query_ext_ctrl": (QueryExtCtrl, 232),
    "v4l2_querymenu": (QueryMenu, 44),
    "v4l2_ext_control": (ExtControl, 20),
    "v4l2_ext_controls": (ExtControls, 32),
    "v4l2_event_subscription": (EventSubscription, 32),
    "v4l2_event": (Event, 136),
}
"""C name -> (our structure, bytes on 64-bit Linux)."""

for _name, (_structure, _size) in SIZES.items():
    if ctypes.sizeof(_structure) != _size:
        raise ImportError(
            f"{_name} has {ctypes.sizeof(_structure)} bytes here, not {_size}: 64-bit Linux only"
        )

_WRITE, _READ = 1, 2


def _request(direction: int, number: int, structure: type[ctypes.Structure]) -> int:
    # _IOC of asm-generic/ioctl.h: dir(2) size(14) type(8) nr(8)
    return direction << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


VIDIOC_QUERYCAP = _request(_READ, 0, Capability)
VIDIOC_ENUM_FMT = _request(_READ | _WRITE, 2, FmtDesc)
VIDIOC_G_FMT = _request(_READ | _WRITE, 4, Format)
VIDIOC_S_FMT = _request(_READ | _WRITE, 5, Format)
VIDIOC_REQBUFS = _request(_READ | _WRITE, 8, RequestBuffers)
VIDIOC_QUERYBUF = _request(_READ | _WRITE, 9, Buffer)
VIDIOC_QBUF = _request(_READ | _WRITE, 15, Buffer)
VIDIOC_DQBUF = _request(_READ | _WRITE, 17, Buffer)
VIDIOC_STREAMON = _request(_WRITE, 18, BufferType)
VIDIOC_STREAMOFF = _request(_WRITE, 19, BufferType)
VIDIOC_G_PARM = _request(_READ | _WRITE, 21, StreamParm)
VIDIOC_S_PARM = _request(_READ | _WRITE, 22, StreamParm)
VIDIOC_QUERYMENU = _request(_READ | _WRITE, 37, QueryMenu)
VIDIOC_G_EXT_CTRLS = _request(_READ | _WRITE, 71, ExtControls)
VIDIOC_S_EXT_CTRLS = _request(_READ | _WRITE, 72, ExtControls)
VIDIOC_ENUM_FRAMESIZES = _request(_READ | _WRITE, 74, FrmSizeEnum)
VIDIOC_ENUM_FRAMEINTERVALS = _request(_READ | _WRITE, 75, FrmIvalEnum)
VIDIOC_DQEVENT = _request(_READ, 89, Event)
VIDIOC_SUBSCRIBE_EVENT = _request(_WRITE, 90, EventSubscription)
VIDIOC_QUERY_EXT_CTRL = _request(_READ | _WRITE, 103, QueryExtCtrl)


def fourcc(name: str) -> int:
    """Return the number of a four-character code; shorter names are padded with blanks.

    >>> hex(fourcc("GREY"))
    '0x59455247'
    """
    return int(struct.unpack("<I", name.ljust(4).encode("ascii"))[0])


def fourcc_name(code: int) -> str:
    """Return the four characters of a code, without trailing blanks.

    >>> fourcc_name(fourcc("Y16"))
    'Y16'
    """
    return struct.pack("<I", code & 0x7FFFFFFF).decode("ascii", "replace").rstrip()
