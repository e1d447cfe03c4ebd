"""What the emulated MIP models know: data, commands, base rates; from the vendor's manuals and SDK.

"gx3": internal timestamp 0x0E and signal conditioning, no attitude filter. "gx5": GPS correlation time 0x12,
an attitude filter, streams named 1 (IMU) and 3 (filter). "cv7": shared reference time 0xD5 and GPS time
0xD3, the data set named in commands, events.
"""

from __future__ import annotations

from dataclasses import dataclass

SENSOR, FILTER = 0x80, 0x82
"""Data sets."""
ALL_STREAMS = 0


@dataclass(frozen=True, slots=True)
class Model:
    """What a model knows.

    Attributes:
        name: As answered.
        number: Model number, as answered.
        data: Descriptors of its data by data set; those from 0xD0 are shared.
        base_hz: Base rate by data set.
        streams: Data set by the number that 0x0C,0x11 names it by.
        base_commands: Descriptors of its base commands (set 0x01).
        commands: Descriptors of its 3DM commands (set 0x0C).
        filter_commands: Descriptors of its filter commands (set 0x0D).
    """

    name: str
    number: str
    data: dict[int, tuple[int, ...]]
    base_hz: dict[int, int]
    streams: dict[int, int]
    base_commands: tuple[int, ...]
    commands: tuple[int, ...]
    filter_commands: tuple[int, ...] = ()

    def divider(self, data_set: int) -> int:
        """Base samples (1 ms) per sample of a data set at its base rate."""
        return 1000 // self.base_hz[data_set]


_ATTITUDE = (0x04, 0x05, 0x06, 0x0A, 0x0B, 0x0D, 0x0E, 0x10, 0x13, 0x1C)

MODELS = {
    "gx3": Model(
        "3DM-GX3-25",
        "6223-4220",
        {SENSOR: (0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0A, 0x0C, 0x0E)},
        {SENSOR: 1000},
        {1: SENSOR},
        (0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x7E),
        (0x01, 0x06, 0x08, 0x11, 0x30, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3A, 0x3B, 0x40),
    ),
    "gx5": Model(
        "3DM-GX5-25",
        "6253-4220",
        {SENSOR: (0x04, 0x05, 0x06, 0x07, 0x08, 0x12), FILTER: (*_ATTITUDE, 0x11)},
        {SENSOR: 1000, FILTER: 500},
        {1: SENSOR, 3: FILTER},
        (0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x7E),
        (
            0x01,
            0x03,
            0x06,
            0x08,
            0x0A,
            0x0B,
            0x11,
            0x30,
            0x37,
            0x38,
            0x39,
            0x3A,
            0x3B,
            0x3E,
            0x40,
            0x50,
            0x51,
        ),
        (0x01, 0x02, 0x03, 0x05, 0x11, 0x14, 0x18, 0x19, 0x1A, 0x1B, 0x1D),
    ),
    "cv7": Model(
        "3DM-CV7-AHRS",
        "6286-9920",
        {SENSOR: (0x04, 0x05, 0x06, 0x07, 0x08, 0xD3, 0xD5), FILTER: (*_ATTITUDE, 0xD0, 0xD3, 0xD5)},
        {SENSOR: 1000, FILTER: 500},
        {SENSOR: SENSOR, FILTER: FILTER},
        (0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x7E),
        (
            *(0x0D, 0x0E, 0x0F, 0x11, 0x28, 0x2A, 0x2B, 0x2C, 0x2D, 0x2E, 0x2F),
            *(0x30, 0x31, 0x37, 0x38, 0x39, 0x3A, 0x3B, 0x3E, 0x41, 0x54),
        ),
        (0x01, 0x05, 0x14, 0x50, 0x52),
    ),
}
