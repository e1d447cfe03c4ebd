"""sensor_msgs/Image, CompressedImage and CameraInfo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.bus.messages.cdr import CdrReader, CdrWriter, MessageError

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE_TYPE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"

# ROS name of the pixel format -> (numpy type, channels)
_ENCODINGS = {
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "mono16": ("u2", 1), "16UC1": ("u2", 1),
    "bgr8": ("u1", 3), "rgb8": ("u1", 3), "8UC3": ("u1", 3),
    "bgra8": ("u1", 4), "rgba8": ("u1", 4), "8UC4": ("u1", 4),
    "bayer_rggb8": ("u1", 1), "bayer_bggr8": ("u1", 1), "bayer_gbrg8": ("u1", 1), "bayer_grbg8": ("u1", 1),
    "bayer_rggb16": ("u2", 1), "bayer_bggr16": ("u2", 1), "bayer_gbrg16": ("u2", 1),
    "bayer_grbg16": ("u2", 1), "rgb16": ("u2", 3), "bgr16": ("u2", 3),
}  # fmt: skip
_COLOUR_ROWS = {"nv12": 0.5, "nv21": 0.5, "nv24": 2.0}
"""Formats whose luminance comes first, as an image: how many rows of colour follow, over its own (V4L2)."""
_LUMINANCE = {"yuyv": 0, "yuv422_yuy2": 0, "uyvy": 1, "yuv422": 1}
"""Formats of two bytes a pixel: which of them is its luminance (ROS 2, image_encodings.hpp)."""
# our name of a lens model -> ROS name; radtan is plumb_bob without its fifth coefficient k3
_MODEL_TO_ROS = {"radtan": "plumb_bob"}
_MODEL_FROM_ROS = {"fisheye": "equidistant"}


@dataclass(frozen=True, slots=True)
class ImageMessage:
    """One raw image as it travels.

    Attributes:
        stamp_ns: Middle of the exposure, UNIX ns.
        frame_id: Name of the camera.
        width: Columns.
        height: Rows.
        encoding: ROS name of the pixel format, e.g. mono8.
        big_endian: Byte order of 16-bit pixels.
        step: Bytes from one row to the next.
        data: The rows, `height * step` bytes (of NV12 those of luminance); a view of the message.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    encoding: str
    big_endian: bool
    step: int
    data: memoryview

    def pixels(self) -> npt.NDArray[Any]:
        """Return the image, shape (height, width) or (height, width, channels); a read-only view.

        Of YUV it is the luminance, and 16-bit pixels have the byte order of this computer; those are
        copies.

        Raises:
            MessageError: A pixel format that this program does not know.
        """
        if self.encoding in _LUMINANCE and self.step >= 2 * self.width:
            rows = np.frombuffer(self.data, np.uint8).reshape(self.height, self.step)
            return np.ascontiguousarray(rows[:, _LUMINANCE[self.encoding] : 2 * self.width : 2])
        encoding = "mono8" if self.encoding in _COLOUR_ROWS else self.encoding
        if encoding not in _ENCODINGS:
            raise MessageError(f"pixel format {self.encoding!r} is not supported; use mono8, mono16 or bgr8")
        code, channels = _ENCODINGS[encoding]
        dtype = np.dtype((">" if self.big_endian else "<") + code)
        if self.step < self.width * channels * dtype.itemsize or self.step % dtype.itemsize:
            raise MessageError(
                f"image rows of {self.step} bytes cannot hold {self.width} {self.encoding} pixels"
            )
        rows = np.frombuffer(self.data, dtype).reshape(self.height, self.step // dtype.itemsize)
        image = rows[:, : self.width * channels]
        if not dtype.isnative:
            image = image.astype(dtype.newbyteorder("="))
        return image if channels == 1 else image.reshape(self.height, self.width, channels)


@dataclass(frozen=True, slots=True)
class CompressedImageMessage:
    """One compressed image: `format` names the codec (jpeg, png), `data` is the file."""

    stamp_ns: int
    frame_id: str
    format: str
    data: memoryview


@dataclass(frozen=True, slots=True)
class CameraInfoMessage:
    """Intrinsics of a camera as it travels.

    Attributes:
        stamp_ns: Stamp of the image or estimate it belongs to, UNIX ns.
        frame_id: Name of the camera.
        width: Columns of the image, with binning and region of interest.
        height: Rows of the image, likewise.
        intrinsics: fx fy cx cy of that image, px.
        distortion_model: Our name: radtan (plumb_bob whose k3 is 0), plumb_bob or equidistant; ROS' name
            where we have none.
        distortion: Coefficients as sent (radtan: k1 k2 p1 p2 [0]).
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]
    distortion_model: str
    distortion: tuple[float, ...]


def encode_image(stamp_ns: int, frame_id: str, image: npt.NDArray[Any], encoding: str) -> bytes:
    """Build a sensor_msgs/Image.

    Args:
        stamp_ns: Middle of the exposure, UNIX ns.
        frame_id: Name of the camera.
        image: Pixels, shape (height, width) or (height, width, channels), uint8 or uint16.
        encoding: ROS name of the pixel format, must fit shape and type.

    Raises:
        MessageError: Shape, type and encoding contradict each other.
    """
    code, channels = _ENCODINGS.get(encoding, ("", 0))
    shape_channels = 1 if image.ndim == 2 else image.shape[-1]
    if not code or image.ndim not in (2, 3) or image.dtype != np.dtype(code) or shape_channels != channels:
        raise MessageError(f"image of shape {image.shape}, {image.dtype} cannot be sent as {encoding!r}")
    height, width = image.shape[:2]
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.scalar("I", height)
    writer.scalar("I", width)
    writer.string(encoding)
    writer.scalar("B", 0)
    writer.scalar("I", width * channels * image.itemsize)
    writer.blob(np.ascontiguousarray(image).reshape(-1).view(np.uint8).data)
    return writer.finish()


def decode_image(data: bytes) -> ImageMessage:
    """Read a sensor_msgs/Image (the pixels are not copied).

    Raises:
        MessageError: These bytes are no such message, or fewer pixels than promised.
    """
    reader = CdrReader(data)
    stamp_ns, frame_id = reader.header()
    height, width = reader.scalar("I"), reader.scalar("I")
    encoding, big_endian, step = reader.string(), bool(reader.scalar("B")), reader.scalar("I")
    pixels = reader.blob()
    reader.end()
    size = height * step
    if encoding in _COLOUR_ROWS and len(pixels) == round(size * (1.0 + _COLOUR_ROWS[encoding])):
        pixels = pixels[:size]
    if not height or not width or len(pixels) != size:
        raise MessageError(
            f"{encoding} image of {width} x {height} with rows of {step} bytes "
            f"but {len(pixels)} bytes of data"
        )
    return ImageMessage(stamp_ns, frame_id, width, height, encoding, big_endian, step, pixels)


def encode_compressed_image(stamp_ns: int, frame_id: str, image_format: str, data: bytes) -> bytes:
    """Build a sensor_msgs/CompressedImage from the bytes of a file; `image_format`: jpeg or png."""
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.string(image_format)
    writer.blob(data)
    return writer.finish()


def decode_compressed_image(data: bytes) -> CompressedImageMessage:
    """Read a sensor_msgs/CompressedImage.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    stamp_ns, frame_id = reader.header()
    message = CompressedImageMessage(stamp_ns, frame_id, reader.string(), reader.blob())
    reader.end()
    return message


def encode_camera_info(
    stamp_ns: int,
    frame_id: str,
    resolution: tuple[int, int],
    intrinsics: Sequence[float],
    distortion_model: str,
    distortion: Sequence[float],
) -> bytes:
    """Build a sensor_msgs/CameraInfo of an unrectified camera.

    Args:
        stamp_ns: Stamp of the image or estimate it belongs to, UNIX ns.
        frame_id: Name of the camera.
        resolution: width, height, px.
        intrinsics: fx fy cx cy, px.
        distortion_model: radtan (sent as plumb_bob with k3 = 0), plumb_bob or equidistant.
        distortion: The model's coefficients, or none.
    """
    fx, fy, cx, cy = intrinsics
    coefficients = list(distortion)
    if distortion_model == "radtan" and len(coefficients) == 4:
        coefficients.append(0.0)
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.scalar("I", resolution[1])
    writer.scalar("I", resolution[0])
    writer.string(_MODEL_TO_ROS.get(distortion_model, distortion_model))
    writer.sequence(coefficients)
    writer.fixed([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
    writer.fixed([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    writer.fixed([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
    for _ in range(6):  # binning x, y; region of interest x, y, height, width: none
        writer.scalar("I", 0)
    writer.scalar("B", 0)
    return writer.finish()


def of_the_image(
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    binning: tuple[int, int],
    part: tuple[int, int, int, int],
) -> tuple[tuple[int, int], tuple[float, float, float, float]]:
    """Return size and intrinsics of the images that a sensor delivers with binning and a region of interest.

    Size and matrix of a CameraInfo are those of the whole sensor without binning; the region is given in its
    pixels. [sensor_msgs/CameraInfo; image_geometry/pinhole_camera_model.cpp]

    Args:
        size: width, height of the whole sensor, px.
        intrinsics: fx fy cx cy of the whole sensor, px.
        binning: Pixels that are joined, along x and y; 0: as 1.
        part: x, y, width, height of the region of interest, px; a width or height of 0: the whole sensor.
    """
    x, y, width, height = part
    if not width or not height:
        x, y, (width, height) = 0, 0, size
    by_x, by_y = max(binning[0], 1), max(binning[1], 1)
    fx, fy, cx, cy = intrinsics
    return (width // by_x, height // by_y), (fx / by_x, fy / by_y, (cx - x) / by_x, (cy - y) / by_y)


def decode_camera_info(data: bytes) -> CameraInfoMessage:
    """Read a sensor_msgs/CameraInfo.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    stamp_ns, frame_id = reader.header()
    height, width = reader.scalar("I"), reader.scalar("I")
    model = reader.string()
    distortion = tuple(float(value) for value in reader.sequence())
    k = reader.fixed(9)
    reader.skip(9 * 8 + 12 * 8, 8)  # rectification and projection
    binning_x, binning_y, x, y, part_height, part_width = (reader.scalar("I") for _ in range(6))
    reader.skip(1, 1)
    reader.end()
    full = (float(k[0]), float(k[4]), float(k[2]), float(k[5]))
    part = (x, y, part_width, part_height)
    (width, height), intrinsics = of_the_image((width, height), full, (binning_x, binning_y), part)
    model = _MODEL_FROM_ROS.get(model, model)
    if model == "plumb_bob" and not any(distortion[4:]):
        model = "radtan"
    return CameraInfoMessage(stamp_ns, frame_id, width, height, intrinsics, model, distortion)
