"""What the host sends to a 3DM-GX3 in the single-byte protocol, as bytes. Commands carry no checksum.

Whatever writes the EEPROM (100 000 cycles) has "store", "preset" or "eeprom" in its name and is never
sent by the driver itself.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Self

from vical_drivers.microstrain.single_byte import LAYOUTS, Record

STOP_STREAM = bytes.fromhex("FA75B4")
"""Ends continuous mode; never answered."""
RESET = bytes.fromhex("FE9E3A")
"""Soft reset; temporary settings are lost; never answered."""
GET_FIRMWARE = b"\xe9"
SELF_TEST = b"\xda"
MODE_ACTIVE, MODE_CONTINUOUS, MODE_IDLE, MODE_SLEEP, MODE_DEEP_SLEEP = 1, 2, 3, 4, 5
MODE_NAMES = {1: "active", 2: "continuous", 3: "idle", 4: "sleep", 5: "deep sleep"}

FLAG_ORIENTATION = 0x0001
FLAG_CONING_SCULLING = 0x0002
FLAG_LITTLE_ENDIAN_FLOATS = 0x0010
FLAG_SUPPRESS_NAN = 0x0020
FLAG_FINITE_SIZE = 0x0040
FLAG_NO_MAGNETOMETER = 0x0100
FLAG_NO_NORTH_COMPENSATION = 0x0400
FLAG_NO_UP_COMPENSATION = 0x0800
FLAG_QUATERNION = 0x1000
FLAGS_INERTIAL_ONLY = FLAG_NO_MAGNETOMETER | FLAG_NO_NORTH_COMPENSATION | FLAG_NO_UP_COMPENSATION
"""Accelerometer and gyro alone, at any rate up to 1000 Hz."""

READ, APPLY, STORE = 0, 1, 2
"""Function selectors of the sampling and communication settings; `STORE` writes the EEPROM."""
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

    def clamped(self) -> Sampling:
        """Return what the device makes of these: each value pulled into its range."""
        return replace(
            self,
            decimation=min(max(self.decimation, 1), 1000),
            filter_width=min(max(self.filter_width, 1), 32),
            mag_filter_width=min(max(self.mag_filter_width, 1), 32),
            up_s=min(max(self.up_s, 1), 1000),
            north_s=min(max(self.north_s, 1), 1000),
        )

    def _items(self) -> dict[str, int]:
        names = ("decimation", "flags", "filter_width", "mag_filter_width", "up_s", "north_s")
        return {name: getattr(self, name) for name in names}


def set_continuous(data_command: int) -> bytes:
    """Start streaming replies to `data_command` (0: stop, with an answer). Volatile."""
    return struct.pack(">4B", 0xC4, 0xC1, 0x29, data_command)


def write_accel_bias(bias_g: tuple[float, float, float]) -> bytes:
    """Set the accelerometer bias, g. Volatile."""
    return struct.pack(">3B3f", 0xC9, 0xB7, 0x44, *bias_g)


def write_gyro_bias(bias_rps: tuple[float, float, float]) -> bytes:
    """Set the gyro bias, rad/s. Volatile."""
    return struct.pack(">3B3f", 0xCA, 0x12, 0xA5, *bias_rps)


def capture_gyro_bias(duration_ms: int) -> bytes:
    """Average the gyro at rest and take the mean as bias; the answer comes after `duration_ms`. Volatile."""
    return struct.pack(">3BH", 0xCD, 0xC1, 0x29, duration_ms)


def store_bias_in_eeprom(which: int) -> bytes:
    """Write the accelerometer (1) or gyro (2) bias to the EEPROM."""
    return struct.pack(">3BH", 0xD0, 0xC1, 0x29, which)


def set_mode(mode: int) -> bytes:
    """Read (0) or set the mode, `MODE_*`."""
    return struct.pack(">4B", 0xD4, 0xA3, 0x47, mode)


def preset_mode(mode: int = 0) -> bytes:
    """Read (0) or write to the EEPROM the mode after power-up."""
    return struct.pack(">4B", 0xD5, 0xBA, 0x89, mode)


def preset_continuous(data_command: int = 0) -> bytes:
    """Read (0) or write to the EEPROM what continuous mode streams."""
    return struct.pack(">4B", 0xD6, 0xC6, 0x6B, data_command)


def timer(function: int = 0, ticks: int = 0) -> bytes:
    """Read (0) the timer, restart it at `ticks` (1), or set the PPS seconds (2)."""
    return struct.pack(">4BI", 0xD7, 0xC1, 0x29, function, ticks)


def communication(function: int = READ, baud: int = 0) -> bytes:
    """Read, apply or store the UART's baud. The answer comes at the old baud; USB does not care."""
    config = 0 if function == READ else 0x02
    return struct.pack(">5BIBB", 0xD9, 0xC3, 0x55, 1, function, baud, config, 0)


def sampling(function: int = READ, settings: Sampling | None = None) -> bytes:
    """Read, apply or store the sampling settings."""
    s = settings or Sampling(0, 0, 0, 0, 0, 0)
    return struct.pack(
        ">3BBHHBBHHB5x",
        *(0xDB, 0xA8, 0xB9, function, s.decimation, s.flags),
        *(s.filter_width, s.mag_filter_width, s.up_s, s.north_s, 0),
    )


def realign(up_tenths_s: int = 255, north_tenths_s: int = 255) -> bytes:
    """Realign up and north within 1 .. 100 tenths of a second (255: leave). Firmware >= 1.1.27."""
    return struct.pack(">6B4x", 0xDD, 0x54, 0x4C, 0, up_tenths_s, north_tenths_s)


def read_eeprom(address: int) -> bytes:
    """Read one word of the EEPROM."""
    return struct.pack(">BBH", 0xE5, 0x00, address)


def write_eeprom(address: int, word: int) -> bytes:
    """Write one word of the EEPROM. The vendor warns against it: a wrong word disables the device.

    Raises:
        ValueError: The manual allows no such address.
    """
    if not (0x0000 <= address <= 0x00EF or 0x0400 <= address <= 0x042F):
        raise ValueError(f"EEPROM address 0x{address:04X} is outside 0x0000 .. 0x00EF and 0x0400 .. 0x042F")
    return struct.pack(">4BHH", 0xE4, 0xC1, 0x29, 0x00, address, word)


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
