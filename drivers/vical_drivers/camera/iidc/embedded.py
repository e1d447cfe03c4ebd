"""Data that Point Grey cameras write over the first pixels of an image (register FRAME_INFO, 0x12F8).

One big-endian quadlet for each enabled item, in the order of the enable bits.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

FRAME_INFO = 0x12F8
PRESENT = 0x80000000
TIMESTAMP, SHUTTER, FRAME_COUNTER = 0, 2, 6
_ITEMS = 10
WANTED = PRESENT | 1 << TIMESTAMP | 1 << SHUTTER | 1 << FRAME_COUNTER


@dataclass(frozen=True, slots=True)
class EmbeddedInfo:
    """What an image says of itself; None where the item is off.

    Attributes:
        cycle_time: CYCLE_TIME when the shutter closed (see `cycle_clock`).
        shutter: Raw shutter value of this frame.
        frame_counter: Counts exposures, 32 bit.
    """

    cycle_time: int | None
    shutter: int | None
    frame_counter: int | None


def position(frame_info: int, item: int) -> int | None:
    """Return where an item stands in the image, bytes from its beginning; None where it is off."""
    if not frame_info >> item & 1:
        return None
    return 4 * (frame_info & ((1 << item) - 1)).bit_count()


def parse_embedded(head: bytes, frame_info: int) -> EmbeddedInfo:
    """Read the embedded data.

    Args:
        head: The first bytes of the raw image.
        frame_info: Register value as the camera reads it back: which items are on.
    """
    values: dict[int, int] = {}
    for item in range(_ITEMS):
        at = position(frame_info, item)
        if at is not None and at + 4 <= len(head):
            values[item] = struct.unpack_from(">I", head, at)[0]
    shutter = values.get(SHUTTER)
    return EmbeddedInfo(
        cycle_time=values.get(TIMESTAMP),
        shutter=None if shutter is None else shutter & 0xFFF,
        frame_counter=values.get(FRAME_COUNTER),
    )
