"""The 3DM-GX3 single-byte protocol: bytes to records. No I/O, no clock, no thread, no logging.

Theory of operation. A reply is a header byte (the command's own), data of a length that the header
fixes, and a 16-bit sum of all bytes before it. There is no sync word, so a header value also occurs in
data. The decoder therefore trusts a record fully only while it is *in step* (the record begins where the
last one ended); out of step it also asks that the floats could come from an instrument. After a failure
it advances **one byte**, so that no undamaged record is lost behind a damaged one. Replies interleave
inside a continuous stream, hence one table for all of them.

What the host sends is in `single_byte_commands`.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec

from vical_drivers.microstrain.stream_decoder import StreamDecoder

STANDARD_GRAVITY_MPS2 = 9.80665
"""One g in the device's unit of specific force, m/s^2."""
TICK_HZ = 62_500
"""Rate of the 32-bit timer in every data record, ticks per second."""
ERROR_REPLY = 0x21
"""Header of the answer to a wrong confirmation sequence (21 00 21)."""

_G = STANDARD_GRAVITY_MPS2
_GAUSS = 1e-4
_TIMER = ("device_ticks",)


@dataclass(frozen=True, slots=True)
class Layout:
    """How one reply is laid out: first big-endian float32 groups, then integers.

    Attributes:
        name: What the record is.
        floats: Groups of floats in wire order: field name in SI, number of floats, factor wire -> SI.
        tail: struct format (without byte order) of what follows the floats.
        tail_fields: Names of the tail's values.
    """

    name: str
    floats: tuple[tuple[str, int, float], ...] = ()
    tail: str = "I"
    tail_fields: tuple[str, ...] = _TIMER

    @property
    def n_floats(self) -> int:
        """Number of float32 values."""
        return sum(count for _, count, _ in self.floats)

    @property
    def length(self) -> int:
        """Bytes of the whole reply, header and checksum included."""
        return 1 + 4 * self.n_floats + struct.calcsize(">" + self.tail) + 2


_ACCEL = ("accel_mps2", 3, _G)
_GYRO = ("gyro_rps", 3, 1.0)
_MAG = ("mag_t", 3, _GAUSS)
_MATRIX = ("matrix", 9, 1.0)
_DELTA_ANGLE = ("delta_angle_rad", 3, 1.0)
_DELTA_VELOCITY = ("delta_velocity_mps", 3, _G)
_EULER = ("euler_rad", 3, 1.0)
_RAW = (("raw_accel_counts", 3, 1.0), ("raw_gyro_counts", 3, 1.0))
_TEMPERATURES = ("raw_board", "raw_gyro_y_accel_x", "raw_gyro_x_accel_yz", "raw_gyro_z", "device_ticks")
_SAMPLING = ("decimation", "flags", "filter_width", "mag_filter_width", "up_s", "north_s", "reserved")

LAYOUTS: dict[int, Layout] = {
    0xC1: Layout("raw accelerometer and gyro", _RAW),
    0xC2: Layout("acceleration and angular rate", (_ACCEL, _GYRO)),
    0xC3: Layout("delta angle and delta velocity", (_DELTA_ANGLE, _DELTA_VELOCITY)),
    0xC4: Layout("continuous mode", tail="BI", tail_fields=("data_command", "device_ticks")),
    0xC5: Layout("orientation matrix", (_MATRIX,)),
    0xC6: Layout("orientation update matrix", (_MATRIX,)),
    0xC7: Layout("magnetometer", (_MAG,)),
    0xC8: Layout("acceleration, angular rate, orientation", (_ACCEL, _GYRO, _MATRIX)),
    0xC9: Layout("accelerometer bias", (("accel_bias_mps2", 3, _G),)),
    0xCA: Layout("gyro bias", (("gyro_bias_rps", 3, 1.0),)),
    0xCB: Layout("acceleration, angular rate, magnetometer", (_ACCEL, _GYRO, _MAG)),
    0xCC: Layout("acceleration, angular rate, magnetometer, orientation", (_ACCEL, _GYRO, _MAG, _MATRIX)),
    0xCD: Layout("captured gyro bias", (("gyro_bias_rps", 3, 1.0),)),
    0xCE: Layout("Euler angles", (_EULER,)),
    0xCF: Layout("Euler angles and angular rate", (_EULER, _GYRO)),
    0xD0: Layout("stored biases", tail="HI", tail_fields=("quantity", "device_ticks")),
    0xD1: Layout("temperatures", tail="4HI", tail_fields=_TEMPERATURES),
    0xD2: Layout("stabilised vectors", (("stab_accel_mps2", 3, _G), _GYRO, ("stab_mag_t", 3, _GAUSS))),
    0xD3: Layout("delta angle, delta velocity, magnetometer", (_DELTA_ANGLE, _DELTA_VELOCITY, _MAG)),
    0xD4: Layout("mode", tail="B", tail_fields=("mode",)),
    0xD5: Layout("mode preset", tail="B", tail_fields=("mode",)),
    0xD6: Layout("continuous preset", tail="B", tail_fields=("data_command",)),
    0xD7: Layout("timer", tail="I", tail_fields=_TIMER),
    0xD9: Layout("communication", tail="BIBB", tail_fields=("port", "baud", "config", "reserved")),
    0xDA: Layout("stationary test", tail="I", tail_fields=("flags",)),
    0xDB: Layout("sampling settings", tail="HHBBHH6s", tail_fields=_SAMPLING),
    0xDD: Layout("realign", tail="4s", tail_fields=("reserved",)),
    0xDF: Layout("quaternion", (("quaternion_wxyz", 4, 1.0),)),
    0xE4: Layout("write EEPROM word", tail="H", tail_fields=("word",)),
    0xE5: Layout("read EEPROM word", tail="H", tail_fields=("word",)),
    0xE9: Layout("firmware", tail="I", tail_fields=("firmware_number",)),
    0xEA: Layout("identity string", tail="B16s", tail_fields=("index", "text")),
    ERROR_REPLY: Layout("error", tail="", tail_fields=()),
}
"""Every reply of the GX3 by header byte (manual v1.08; 0xDD and 0xDF from firmware 1.1.27)."""

MAX_LENGTH = max(layout.length for layout in LAYOUTS.values())
DATA_COMMANDS = frozenset(
    {0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC8, 0xCB, 0xCC, 0xCE, 0xCF, 0xD1, 0xD2, 0xD3, 0xDF}
)
"""Commands that may be streamed by 0xC4."""


class Record(msgspec.Struct, frozen=True, gc=False):
    """One reply whose checksum was right.

    Attributes:
        kind: Header byte.
        values: All values in wire order and in *wire* units (g, rad/s, Gauss, ticks).
        end: Number of stream bytes up to and including this record's last one; dates the record.
    """

    kind: int
    values: tuple[Any, ...]
    end: int

    @property
    def ticks(self) -> int | None:
        """The timer field, 0 .. 2^32 - 1, where the record has one."""
        layout = LAYOUTS[self.kind]
        return int(self.values[-1]) if layout.tail_fields[-1:] == _TIMER else None

    def fields(self) -> dict[str, object]:
        """Return the values by name, in SI units (specific force m/s^2, magnetic field tesla)."""
        layout = LAYOUTS[self.kind]
        out: dict[str, object] = {}
        at = 0
        for name, count, factor in layout.floats:
            out[name] = [float(v) * factor for v in self.values[at : at + count]]
            at += count
        for name, value in zip(layout.tail_fields, self.values[at:], strict=True):
            out[name] = _readable(name, value)
        return out


def _readable(name: str, value: float | bytes) -> object:
    if not isinstance(value, bytes):
        return value
    return value.decode("ascii", "replace").strip(" \0") if name == "text" else value.hex()


class _Entry(NamedTuple):
    length: int
    unpack: struct.Struct
    n_floats: int
    little: struct.Struct
    tail: struct.Struct


def _entry(layout: Layout) -> _Entry:
    n = layout.n_floats
    return _Entry(
        layout.length,
        struct.Struct(f">{n}f{layout.tail}" if n else f">{layout.tail}"),
        n,
        struct.Struct(f"<{n}f"),
        struct.Struct(f">{layout.tail}"),
    )


_ENTRIES: list[_Entry | None] = [
    _entry(LAYOUTS[header]) if header in LAYOUTS else None for header in range(256)
]
_HEADER = re.compile(b"[" + b"".join(re.escape(bytes([h])) for h in LAYOUTS) + b"]")
_LARGEST, _SMALLEST = 1e9, 1e-30


def _could_be_measured(floats: tuple[float, ...]) -> bool:
    """Tell whether floats may come from an instrument: random bytes mostly have absurd exponents.

    NaN is fine (the device sends it for what it does not measure), zero too.
    """
    return all(v != v or v == 0.0 or _SMALLEST < abs(v) < _LARGEST for v in floats)


class Decoder(StreamDecoder[Record]):
    """Decoder of single-byte records.

    Attributes:
        little_endian_floats: Set when sampling flag bit 4 is on; only floats change their order.
    """

    def __init__(self, *, little_endian_floats: bool = False) -> None:
        super().__init__()
        self.little_endian_floats = little_endian_floats

    def feed(self, data: bytes) -> list[Record]:
        """See `StreamDecoder.feed`."""
        if self._in_step and data and not self._tail and not self.little_endian_floats:
            # Nearly always one read brings one whole record: no need to look for anything.
            kind, size = data[0], len(data)
            entry = _ENTRIES[kind]
            if (
                entry is not None
                and entry.length == size
                and sum(data[:-2]) & 0xFFFF == data[-2] << 8 | data[-1]
            ):
                self._consumed += size
                self.records += 1
                return [Record(kind, entry.unpack.unpack_from(data, 1), self._consumed)]
        return super().feed(data)

    def _parse(self, buffer: bytes, *, waiting: bool) -> list[Record]:
        out: list[Record] = []
        position, size, base = 0, len(buffer), self._consumed
        kept: int | None = None
        good_bytes = 0
        while position < size:
            entry = _ENTRIES[buffer[position]]
            if entry is None:
                match = _HEADER.search(buffer, position + 1)
                self._in_step = False
                position = match.start() if match else size
                continue
            end = position + entry.length
            if end > size:
                if waiting:
                    break
                kept = position if kept is None else kept
                self._in_step = False
                position += 1
                continue
            values = self._decode(buffer, position, end, entry)
            if values is None:
                position += 1
                continue
            out.append(Record(buffer[position], values, base + end))
            good_bytes += entry.length
            position = end
            kept = None
            self._in_step = True
        return self._keep(buffer, position if kept is None else kept, out, good_bytes)

    def _decode(self, buffer: bytes, position: int, end: int, entry: _Entry) -> tuple[Any, ...] | None:
        """Values of a record at `position`; None, and out of step, where there is none."""
        if sum(buffer[position : end - 2]) & 0xFFFF != buffer[end - 2] << 8 | buffer[end - 1]:
            if self._in_step:
                self.checksum_errors += 1
                self._in_step = False
            return None
        values: tuple[Any, ...] = entry.unpack.unpack_from(buffer, position + 1)
        if self.little_endian_floats and entry.n_floats:
            floats = entry.little.unpack_from(buffer, position + 1)
            values = floats + entry.tail.unpack_from(buffer, position + 1 + 4 * entry.n_floats)
        if not self._in_step and not _could_be_measured(values[: entry.n_floats]):
            return None
        return values
