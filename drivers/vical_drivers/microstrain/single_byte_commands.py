"""What the host sends to a 3DM-GX3 in the single-byte protocol, as bytes. Commands carry no checksum.

A function that writes the EEPROM (100 000 cycles) has "store" in its name. The driver itself never sends it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Self

from vical_drivers.microstrain.single_byte import LAYOUTS, Record

STOP_STREAM = bytes.fromhex("FA75B4")
"""Ends continuous mode; never answered."""
GET_FIRMWARE = b"\xe9"
SELF_TEST = b"\xda"
MODE_NAMES = {1: "active", 2: "continuous", 3: "idle", 4: "sleep", 5: "deep sleep"}

FLAG_ORIENTATION = 0x0001
FLAG_CONING_SCULLING = 0x0002
FLAG_LITTLE_ENDIAN_FLOATS = 0x0010
FLAG_NO_MAGNETOMETER = 0x0100
FLAG_NO_NORTH_COMPENSATION = 0x0400
FLAG_NO_UP_COMPENSATION = 0x0800
FLAGS_INERTIAL_ONLY = FLAG_NO_MAGNETOMETER | FLAG_NO_NORTH_COMPENSATION | FLAG_NO_UP_COMPENSATION
"""Accelerometer and gyro alone, at any rate up to 1000 Hz."""

READ, APPLY = 0, 1
"""Function selectors of the sampling and communication settings."""
FIRST_VOLATILE_FIRMWARE = 1127
"""From 1.1.27 on, "apply" of the sampling settings does not write the EEPROM."""
BAUD_RATES = (115_200, 230_400, 460_800, 921_600)
BASE_RATE_HZ = 1000.0
_SLOWEST_DECIMATION = {115_200: 4, 230_400: 3, 460_800: 2, 921_600: 1}
"""Smallest decimation at each baud for 31-byte records (manual, 0xDB)."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """Contents of command and reply 0xDB.

    Attributes:
        decimation: Data rate is 1000 Hz / decimation, 1 .. 1000.
        flags: `FLAG_*`.
        filter_width: M of the moving average on gyro and accelerometer, 1 .. 32 samples at 1 kHz.
        mag_filter_width: The same for the magnetometer.
        up_s: Time constant of the gravity correction, 1 .. 1000 s.
        north_s: Time constant of the north correction, 1 .. 1000 s.
    """

    decimation: int = 10
    flags: int = FLAG_ORIENTATION | FLAG_CONING_SCULLING
    filter_width: int = 15
    mag_filter_width: int = 17
    up_s: int = 10
    north_s: int = 10

    @classmethod
    def from_record(cls, record: Record) -> Self:
        """Read the settings in force from reply 0xDB."""
        return cls(*(int(v) for v in record.values[:6]))

    def difference(self, wanted: Sampling) -> str:
        """Name what differs from `wanted`; empty where all is as wanted."""
        ours, theirs = self._items(), wanted._items()
        return ", ".join(f"{k} is {ours[k]}, not {theirs[k]}" for k in ours if ours[k] != theirs[k])

    def _items(self) -> dict[str, int]:
        names = ("decimation", "flags", "filter_width", "mag_filter_width", "up_s", "north_s")
        return {name: getattr(self, name) for name in names}


def set_continuous(data_command: int) -> bytes:
    """Start streaming replies to `data_command` (0: stop, with an answer). Volatile."""
    return struct.pack(">4B", 0xC4, 0xC1, 0x29, data_command)


def capture_gyro_bias(duration_ms: int) -> bytes:
    """Average the gyro at rest and take the mean as bias; the answer comes after `duration_ms`. Volatile."""
    return struct.pack(">3BH", 0xCD, 0xC1, 0x29, duration_ms)


def store_bias_in_eeprom(which: int) -> bytes:
    """Write the accelerometer (1) or gyro (2) bias to the EEPROM."""
    return struct.pack(">3BH", 0xD0, 0xC1, 0x29, which)


def set_mode(mode: int) -> bytes:
    """Read (0) or set the mode, see `MODE_NAMES`."""
    return struct.pack(">4B", 0xD4, 0xA3, 0x47, mode)


def timer(function: int = 0, ticks: int = 0) -> bytes:
    """Read (0) the timer, restart it at `ticks` (1), or set the PPS seconds (2)."""
    return struct.pack(">4BI", 0xD7, 0xC1, 0x29, function, ticks)


def communication(function: int = READ, baud: int = 0) -> bytes:
    """Read or apply the UART's baud. The answer comes at the old baud; on USB it has no effect."""
    config = 0 if function == READ else 0x02
    return struct.pack(">5BIBB", 0xD9, 0xC3, 0x55, 1, function, baud, config, 0)


def sampling(function: int = READ, settings: Sampling | None = None) -> bytes:
    """Read or apply the sampling settings."""
    s = settings or Sampling(0, 0, 0, 0, 0, 0)
    return struct.pack(
        ">3BBHHBBHHB5x",
        *(0xDB, 0xA8, 0xB9, function, s.decimation, s.flags),
        *(s.filter_width, s.mag_filter_width, s.up_s, s.north_s, 0),
    )


def get_identity(index: int) -> bytes:
    """Ask for a string: 0 model number, 1 serial number, 2 model name, 3 options, 4 lot."""
    return struct.pack(">BB", 0xEA, index)


def firmware_text(number: int) -> str:
    """Spell a firmware number: 1130 is 1.1.30.

    >>> firmware_text(1130)
    '1.1.30'
    """
    return f"{number // 1000}.{number % 1000 // 100}.{number % 100:02d}"


def max_rate_hz(data_command: int, baud: int) -> float:
    """Highest continuous rate of a record on a real UART, Hz: the manual's table, scaled by length.

    The table (31-byte records) leaves room for the device's own scheduling, not only for the wire.
    """
    longer = max(1.0, LAYOUTS[data_command].length / 31.0)
    decimation = -int(-_SLOWEST_DECIMATION.get(baud, 4 * 115_200 / baud) * longer // 1)
    return BASE_RATE_HZ / max(1, decimation)
