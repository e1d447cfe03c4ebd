"""Pixel formats: what a camera delivers -> mono8, mono16 or bgr8 arrays, by numpy alone.

JPEG is decompressed by a decoder that the caller gives (`ImageDecoder`), so that drivers need no
image library.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
Bytes = npt.NDArray[np.uint8]


class ImageDecoder(Protocol):
    """Decompresses one JPEG or PNG."""

    def __call__(self, data: Bytes, *, colour: bool) -> npt.NDArray[np.uint8]:
        """Return (h, w) uint8, or (h, w, 3) uint8 BGR if `colour`; raise ValueError on corrupt data."""
        ...


class Layout(Enum):
    """How the bytes of a format lie."""

    GREY = "grey"
    PACKED_YUV = "packed yuv"
    PLANAR_YUV = "planar yuv"
    RGB = "rgb"
    BAYER = "bayer"
    JPEG = "jpeg"


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """One format by its V4L2 four-character code.

    Attributes:
        name: Four-character code without trailing blanks.
        layout: Family.
        bits: Significant bits of a sample (8, 10, 12, 16; more than 8: 16-bit little endian).
        order: PACKED_YUV: positions of Y0 U Y1 V; RGB: "rgb" or "bgr"; BAYER: colours of the first
            2 x 2 pixels in reading order; PLANAR_YUV: "uv", "vu" (interleaved) or "u,v" (two planes).
    """

    name: str
    layout: Layout
    bits: int = 8
    order: str = ""

    @property
    def bytes_per_pixel(self) -> int:
        """Bytes from one pixel of the first plane to the next (0: compressed)."""
        per_layout = {Layout.PACKED_YUV: 2, Layout.RGB: 3, Layout.JPEG: 0, Layout.PLANAR_YUV: 1}
        return per_layout.get(self.layout, 1 if self.bits == 8 else 2)


def _bayer(name: str, bits: int, order: str) -> PixelFormat:
    return PixelFormat(name, Layout.BAYER, bits, order)


FORMATS: dict[str, PixelFormat] = {
    f.name: f
    for f in (
        PixelFormat("GREY", Layout.GREY),
        PixelFormat("Y10", Layout.GREY, 10),
        PixelFormat("Y12", Layout.GREY, 12),
        PixelFormat("Y16", Layout.GREY, 16),
        PixelFormat("YUYV", Layout.PACKED_YUV, order="0123"),
        PixelFormat("UYVY", Layout.PACKED_YUV, order="1032"),
        PixelFormat("YVYU", Layout.PACKED_YUV, order="0321"),
        PixelFormat("NV12", Layout.PLANAR_YUV, order="uv"),
        PixelFormat("NV21", Layout.PLANAR_YUV, order="vu"),
        PixelFormat("YU12", Layout.PLANAR_YUV, order="u,v"),
        PixelFormat("BGR3", Layout.RGB, order="bgr"),
        PixelFormat("RGB3", Layout.RGB, order="rgb"),
        _bayer("BA81", 8, "BGGR"),
        _bayer("GBRG", 8, "GBRG"),
        _bayer("GRBG", 8, "GRBG"),
        _bayer("RGGB", 8, "RGGB"),
        _bayer("BG10", 10, "BGGR"),
        _bayer("GB10", 10, "GBRG"),
        _bayer("BA10", 10, "GRBG"),
        _bayer("RG10", 10, "RGGB"),
        _bayer("BG12", 12, "BGGR"),
        _bayer("GB12", 12, "GBRG"),
        _bayer("BA12", 12, "GRBG"),
        _bayer("RG12", 12, "RGGB"),
        _bayer("BYR2", 16, "BGGR"),
        _bayer("GB16", 16, "GBRG"),
        _bayer("GR16", 16, "GRBG"),
        _bayer("RG16", 16, "RGGB"),
        PixelFormat("MJPG", Layout.JPEG),
        PixelFormat("JPEG", Layout.JPEG),
    )
}
"""In order of preference: cheap and exact first, compressed last."""

ENCODINGS = ("mono8", "mono16", "bgr8")


class CorruptImageError(ValueError):
    """The bytes of a frame are not the image they should be; the frame is counted and skipped."""


class FrameDecoder:
    """Turns the bytes of one frame into an image of the wanted encoding.

    Args:
        pixel_format: What the camera delivers.
        width: Pixels.
        height: Pixels.
        stride: Bytes from row to row of the first plane; 0: no padding.
        encoding: mono8, mono16 (formats with more than 8 bits only) or bgr8.
        decoder: Decompressor; needed for JPEG formats.

    Raises:
        ValueError: The encoding cannot be made from this format, or the decompressor is missing.
    """

    def __init__(
        self,
        pixel_format: PixelFormat,
        width: int,
        height: int,
        *,
        stride: int = 0,
        encoding: str = "mono8",
        decoder: ImageDecoder | None = None,
    ) -> None:
        if encoding not in ENCODINGS:
            raise ValueError(f"unknown encoding {encoding!r}: one of {', '.join(ENCODINGS)}")
        if encoding == "mono16" and (pixel_format.bits == 8 or pixel_format.layout is not Layout.GREY):
            raise ValueError(f"mono16 cannot be made from {pixel_format.name}")
        if pixel_format.layout is Layout.JPEG and decoder is None:
            raise ValueError(f"{pixel_format.name} needs an image decoder")
        self.pixel_format = pixel_format
        self.encoding = encoding
        self._width, self._height = width, height
        self._stride = max(stride, width * pixel_format.bytes_per_pixel)
        self._decoder = decoder

    def __call__(self, data: Bytes) -> Image:
        """Decode one frame.

        Args:
            data: The frame's bytes, shape (n,), uint8.

        Returns:
            Shape (height, width), or (height, width, 3) BGR; a view of `data` where no conversion is
            needed, so the caller copies before it gives the memory back.

        Raises:
            CorruptImageError: Too few bytes, or bytes that do not decompress to the stated size.
        """
        layout = self.pixel_format.layout
        if layout is Layout.JPEG:
            return self._decode_jpeg(data)
        if layout is Layout.PLANAR_YUV:
            return self._decode_planar(data)
        rows = self._rows(data)
        if layout is Layout.PACKED_YUV:
            return self._decode_packed_yuv(rows)
        if layout is Layout.RGB:
            bgr = rows.reshape(self._height, self._width, 3)
            bgr = bgr if self.pixel_format.order == "bgr" else bgr[:, :, ::-1]
            return bgr if self.encoding == "bgr8" else luminance(bgr)
        samples = self._samples(rows)
        if layout is Layout.BAYER:
            order = self.pixel_format.order
            return bayer_to_bgr(samples, order) if self.encoding == "bgr8" else bayer_to_mono(samples)
        if self.encoding == "bgr8":
            return np.repeat(samples.astype(np.uint8)[:, :, None], 3, axis=2)
        return samples

    def _rows(self, data: Bytes) -> Bytes:
        used = self._width * self.pixel_format.bytes_per_pixel
        need = self._stride * (self._height - 1) + used
        if data.size < need:
            raise CorruptImageError(f"{data.size} bytes where {need} are a frame")
        if data.size < self._stride * self._height:  # last row without its padding
            data = np.concatenate([data, np.zeros(self._stride * self._height - data.size, np.uint8)])
        return data[: self._stride * self._height].reshape(self._height, self._stride)[:, :used]

    def _samples(self, rows: Bytes) -> Image:
        if self.pixel_format.bits == 8:
            return rows
        wide: npt.NDArray[np.uint16] = np.ascontiguousarray(rows).view(np.uint16)  # little endian, as here
        if self.encoding == "mono16":  # full scale is 65535, whatever the sensor's bits
            return (wide << (16 - self.pixel_format.bits)).astype(np.uint16)
        return (wide >> (self.pixel_format.bits - 8)).astype(np.uint8)

    def _decode_packed_yuv(self, rows: Bytes) -> Image:
        y0, u, y1, v = (int(c) for c in self.pixel_format.order)
        if self.encoding == "mono8":
            return rows[:, y0::2]
        quads = rows.reshape(self._height, self._width // 2, 4)
        luma = np.stack([quads[:, :, y0], quads[:, :, y1]], axis=2).reshape(self._height, self._width)
        return yuv_to_bgr(luma, np.repeat(quads[:, :, u], 2, axis=1), np.repeat(quads[:, :, v], 2, axis=1))

    def _decode_planar(self, data: Bytes) -> Image:
        luma = self._rows(data)
        if self.encoding == "mono8":
            return luma
        chroma = data[self._stride * self._height :]
        h, w = self._height // 2, self._width // 2
        if self.pixel_format.order == "u,v":
            half = self._stride // 2
            planes = [chroma[k * half * h : (k + 1) * half * h] for k in (0, 1)]
            if planes[1].size < half * h:
                raise CorruptImageError("the colour planes are cut off")
            u, v = (plane.reshape(h, half)[:, :w] for plane in planes)
        else:
            if chroma.size < self._stride * h:
                raise CorruptImageError("the colour plane is cut off")
            pairs = chroma[: self._stride * h].reshape(h, self._stride)[:, : 2 * w]
            u, v = pairs[:, 0::2], pairs[:, 1::2]
            if self.pixel_format.order == "vu":
                u, v = v, u
        grow = [np.repeat(np.repeat(c, 2, axis=0), 2, axis=1) for c in (u, v)]
        return yuv_to_bgr(luma, grow[0], grow[1])

    def _decode_jpeg(self, data: Bytes) -> Image:
        end = data.size
        while end > 0 and data[end - 1] == 0:  # some cameras pad with zeros
            end -= 1
        if end < 4 or (data[0], data[1]) != (0xFF, 0xD8) or (data[end - 2], data[end - 1]) != (0xFF, 0xD9):
            raise CorruptImageError("a JPEG without its first or last marker")
        if self._decoder is None:
            raise CorruptImageError("no decoder")
        try:
            image = self._decoder(data[:end], colour=self.encoding == "bgr8")
        except ValueError as error:
            raise CorruptImageError(str(error)) from error
        if image.shape[:2] != (self._height, self._width):
            raise CorruptImageError(f"a JPEG of {image.shape[1]} x {image.shape[0]} pixels")
        return image


def luminance(bgr: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return (h, w) uint8 luma of a (h, w, 3) BGR image: (29 B + 150 G + 77 R) / 256 (ITU-R BT.601)."""
    blue, green, red = (bgr[:, :, k].astype(np.uint16) for k in range(3))
    return ((29 * blue + 150 * green + 77 * red + 128) >> 8).astype(np.uint8)


def yuv_to_bgr(y: Bytes, u: Bytes, v: Bytes) -> npt.NDArray[np.uint8]:
    """Return (h, w, 3) BGR of full-resolution planes in ITU-R BT.601, limited range, rounded."""
    luma = 298 * (y.astype(np.int32) - 16) + 128
    cb, cr = u.astype(np.int32) - 128, v.astype(np.int32) - 128
    planes = (luma + 516 * cb, luma - 100 * cb - 208 * cr, luma + 409 * cr)
    return np.stack([np.clip(p >> 8, 0, 255).astype(np.uint8) for p in planes], axis=2)


def bayer_to_mono(mosaic: Image) -> npt.NDArray[np.uint8]:
    """Return luma (R + 2 G + B) / 4 at every pixel of an 8-bit mosaic, shape (h, w).

    The 3 x 3 kernel [1 2 1; 2 4 2; 1 2 1] / 16 weighs the colours 1:2:1 wherever it is put on a Bayer
    pattern, so no chequered residue is left that a corner detector could see, and it is symmetric: no
    corner moves. Borders mirror.
    """
    wide = np.pad(mosaic, 1, mode="reflect").astype(np.uint16)
    rows = wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]
    luma: npt.NDArray[np.uint8] = ((rows[:-2] + 2 * rows[1:-1] + rows[2:] + 8) >> 4).astype(np.uint8)
    return luma


def bayer_to_bgr(mosaic: Image, order: str) -> npt.NDArray[np.uint8]:
    """Return (h, w, 3) BGR of an 8-bit mosaic by bilinear interpolation; borders mirror.

    Args:
        mosaic: Shape (h, w), uint8.
        order: Colours of the first 2 x 2 pixels in reading order, e.g. "RGGB".
    """
    height, width = mosaic.shape
    wide = np.pad(mosaic, 1, mode="reflect").astype(np.uint16)
    centre = wide[1:-1, 1:-1]
    across = (wide[1:-1, :-2] + wide[1:-1, 2:] + 1) >> 1
    down = (wide[:-2, 1:-1] + wide[2:, 1:-1] + 1) >> 1
    cross = (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:] + 2) >> 2
    corners = (wide[:-2, :-2] + wide[:-2, 2:] + wide[2:, :-2] + wide[2:, 2:] + 2) >> 2
    bgr = np.empty((height, width, 3), np.uint8)
    for place in range(4):
        r, c = divmod(place, 2)
        here = (slice(r, None, 2), slice(c, None, 2))
        colour = order[place]
        if colour == "G":
            in_row = order[2 * r + (1 - c)]  # the colour of the neighbours in this row
            bgr[..., 1][here] = centre[here]
            bgr[..., "BGR".index(in_row)][here] = across[here]
            bgr[..., "BGR".index("R" if in_row == "B" else "B")][here] = down[here]
        else:
            bgr[..., "BGR".index(colour)][here] = centre[here]
            bgr[..., 1][here] = cross[here]
            bgr[..., "BGR".index("R" if colour == "B" else "B")][here] = corners[here]
    return bgr
