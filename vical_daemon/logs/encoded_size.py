"""Size of a PNG, JPEG, PGM, PPM or BMP image, from its first bytes: it is not decoded."""

from __future__ import annotations

import re
import struct

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_PGM_PPM = re.compile(rb"P[2356](?:\s+(?:#[^\n]*\n\s*)*)(\d{1,6})(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,6})\s")
_BMP_HEADER = 40  # bytes of the usual one and at least of the later ones; sizes have 4 bytes each
_NO_FRAME = {0xC4, 0xC8, 0xCC}  # of the markers C0 to CF: tables and an extension, no frame header
LARGEST_PX = 2**27  # as `vical_daemon.vision` sets it for OpenCV: larger ones are not read
HEAD = 65_536
"""Bytes that are enough for most images: before its size, a JPEG may hold a preview of up to 64 kB."""


def encoded_size(data: bytes | memoryview) -> tuple[int, int] | None:
    """Return width and height of an image, px; None: of another kind, damaged or too large.

    PNG: W3C, Portable Network Graphics, 11.2.2. JPEG: ITU-T T.81, B.1.1 and B.2.2. PGM, PPM: netpbm's pgm(5)
    and ppm(5). BMP: Microsoft's BITMAPINFOHEADER, whose height is negative if the top row comes first.
    """
    data = bytes(data)
    size: tuple[int, int] | None = None
    if data.startswith(_PNG) and data[12:16] == b"IHDR" and len(data) >= 24:
        size = struct.unpack_from(">II", data, 16)
    elif data.startswith(_JPEG):
        size = _jpeg_size(data)
    elif found := _PGM_PPM.match(data):
        size = int(found[1]), int(found[2])
    elif data.startswith(b"BM") and len(data) >= 26 and struct.unpack_from("<I", data, 14)[0] >= _BMP_HEADER:
        width, height = struct.unpack_from("<ii", data, 18)
        size = width, abs(height)
    return size if size is not None and 0 < size[0] * size[1] <= LARGEST_PX else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + int(struct.unpack_from(">H", data, at + 2)[0])
    return None
