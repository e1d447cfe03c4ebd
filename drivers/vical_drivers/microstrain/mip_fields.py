"""What the fields of MIP packets mean: names, layout and SI units, for reading and for showing.

Descriptors from 0xD0 are shared: they may occur in any data set.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from vical_drivers.microstrain import single_byte as sb
from vical_drivers.microstrain.mip import ACK, NACK_REASONS, SET_3DM, SET_BASE, SET_SENSOR, Packet

STANDARD_GRAVITY_MPS2 = sb.STANDARD_GRAVITY_MPS2
GAUSS = 1e-4
GX3_TICK_HZ = 62_500
WEEK_S = 604_800

ACCEL, GYRO, TICKS, PPS_TIME, GPS_CORRELATION = 0x04, 0x05, 0x0E, 0x0F, 0x12
_WRAPPED = 0x82
"""Single-byte records inside a MIP field (GX3-35 in its wrapped raw format)."""
GPS_TIME, REFERENCE_TIME = 0xD3, 0xD5
_IDENTITY = ("model_name", "model_number", "serial_number", "lot", "options")


@dataclass(frozen=True, slots=True)
class FieldLayout:
    """How the data of one field is laid out.

    Attributes:
        layout: struct format without byte order (always big-endian).
        names: Name of each value; a single name takes all values as a list.
        factor: From the wire's unit to SI, for floats.
    """

    layout: str
    names: tuple[str, ...]
    factor: float = 1.0


_G = STANDARD_GRAVITY_MPS2
_GPS = FieldLayout("dHH", ("tow_s", "week", "flags"))
_SENSOR: dict[int, FieldLayout] = {
    0x01: FieldLayout("3f", ("raw_accel_counts",)),
    0x02: FieldLayout("3f", ("raw_gyro_counts",)),
    0x03: FieldLayout("3f", ("raw_mag_counts",)),
    ACCEL: FieldLayout("3f", ("accel_mps2",), _G),
    GYRO: FieldLayout("3f", ("gyro_rps",)),
    0x06: FieldLayout("3f", ("mag_t",), GAUSS),
    0x07: FieldLayout("3f", ("delta_angle_rad",)),
    0x08: FieldLayout("3f", ("delta_velocity_mps",), _G),
    0x09: FieldLayout("9f", ("matrix",)),
    0x0A: FieldLayout("4f", ("quaternion_wxyz",)),
    0x0B: FieldLayout("9f", ("update_matrix",)),
    0x0C: FieldLayout("3f", ("euler_rad",)),
    0x0D: FieldLayout("4H", ("raw_temperatures",)),
    TICKS: FieldLayout("I", ("device_ticks",)),
    PPS_TIME: FieldLayout("BII", ("pps_flags", "pps_s", "pps_ns")),
    0x10: FieldLayout("3f", ("stab_mag_t",), GAUSS),
    0x11: FieldLayout("3f", ("stab_accel_mps2",), _G),
    GPS_CORRELATION: _GPS,
    0x14: FieldLayout("3f", ("temperatures_degc",)),
    0x17: FieldLayout("f", ("pressure_pa",), 100.0),
    0x18: FieldLayout("H", ("over_range_flags",)),
}
_SHARED: dict[int, FieldLayout] = {
    0xD0: FieldLayout("B", ("event_source",)),
    0xD1: FieldLayout("I", ("base_ticks",)),
    0xD2: FieldLayout("I", ("delta_ticks",)),
    GPS_TIME: FieldLayout("dHH", ("gps_tow_s", "gps_week", "gps_valid")),
    0xD4: FieldLayout("d", ("delta_time_s",)),
    REFERENCE_TIME: FieldLayout("Q", ("reference_time_ns",)),
    0xD6: FieldLayout("Q", ("reference_delta_ns",)),
    0xD7: FieldLayout("QH", ("external_time_ns", "external_valid")),
    0xD8: FieldLayout("QH", ("external_delta_ns", "external_delta_valid")),
    0xFF: FieldLayout("I", ("debug_ticks",)),
}
_REPLIES: dict[tuple[int, int], FieldLayout] = {
    (SET_BASE, 0x83): FieldLayout("I", ("built_in_test_flags",)),
    (SET_3DM, 0x83): FieldLayout("H", ("base_rate_hz",)),
    (SET_3DM, 0x85): FieldLayout("BB", ("stream", "enabled")),
    (SET_3DM, 0x87): FieldLayout("I", ("baud",)),
    (SET_3DM, 0x93): FieldLayout("BI", ("timestamp_selector", "timestamp")),
    (SET_3DM, 0x9A): FieldLayout("3f", ("accel_bias_mps2",), _G),
    (SET_3DM, 0x9B): FieldLayout("3f", ("gyro_bias_rps",)),
}


def describe(packet: Packet) -> dict[str, object]:
    """Return a packet's fields by name, in SI units; what is not known stays hexadecimal."""
    out: dict[str, object] = {}
    for field in packet.fields:
        for name, value in _describe_field(packet.descriptor_set, field).items():
            # Two fields of one name (several ACKs in a packet) must not hide one another.
            key = name if name not in out else f"{name}_{sum(k.startswith(name) for k in out) + 1}"
            out[key] = value
    return out


def _describe_field(descriptor_set: int, field: tuple[int, bytes]) -> dict[str, object]:
    descriptor, data = field
    if descriptor_set < SET_SENSOR:
        if descriptor == ACK and len(data) == 2:
            result = "ok" if data[1] == 0 else NACK_REASONS.get(data[1], f"reason {data[1]}")
            return {"ack": {"command": f"0x{data[0]:02X}", "result": result}}
        if (descriptor_set, descriptor) == (SET_BASE, 0x81) and len(data) == 82:
            return {"device": identity(data)}
        layout = _REPLIES.get((descriptor_set, descriptor))
    elif (descriptor_set, descriptor) == (SET_SENSOR, _WRAPPED):
        decoder = sb.Decoder()
        records = decoder.feed(data) + decoder.finish()
        return {"wrapped": [{"kind": f"0x{r.kind:02X}", **r.fields()} for r in records]}
    else:
        layout = _SENSOR.get(descriptor) if descriptor_set == SET_SENSOR else None
        layout = layout or _SHARED.get(descriptor)
    if layout is None or struct.calcsize(">" + layout.layout) != len(data):
        return {f"field_0x{descriptor:02X}": data.hex()}
    values = struct.unpack(">" + layout.layout, data)
    scaled = [v * layout.factor if isinstance(v, float) else v for v in values]
    if len(layout.names) == 1:
        return {layout.names[0]: scaled[0] if len(scaled) == 1 else scaled}
    return dict(zip(layout.names, scaled, strict=True))


def identity(data: bytes) -> dict[str, str]:
    """Read the device information field (0x01, 0x81): firmware and five strings."""
    number = int.from_bytes(data[:2], "big")
    texts = {
        name: data[2 + 16 * i : 18 + 16 * i].decode("ascii", "replace").strip(" \0")
        for i, name in enumerate(_IDENTITY)
    }
    return {"firmware": f"{number // 1000}.{number % 1000 // 100}.{number % 100:02d}", **texts}


@dataclass(frozen=True, slots=True)
class TimeField:
    """A field that dates a sample.

    Attributes:
        descriptor: Which field.
        name: For people.
        tick_hz: Units per second of `ticks`.
        tick_bits: Width of the counter; None where it does not wrap.
    """

    descriptor: int
    name: str
    tick_hz: float
    tick_bits: int | None

    def ticks(self, data: bytes) -> int | None:
        """Device time in ticks; None where the device says that it has none."""
        if self.descriptor == TICKS and len(data) == 4:
            return int.from_bytes(data, "big")
        if self.descriptor == REFERENCE_TIME and len(data) == 8:
            return int.from_bytes(data, "big")
        if self.descriptor == PPS_TIME and len(data) == 9:
            seconds, nanoseconds = int.from_bytes(data[1:5], "big"), int.from_bytes(data[5:], "big")
            return seconds * 1_000_000_000 + nanoseconds
        if self.descriptor in (GPS_TIME, GPS_CORRELATION) and len(data) == 12:
            tow_s, week, flags = struct.unpack(">dHH", data)
            # 0xD3 without a valid time of week may stand still; 0x12 counts from power-up until it is set.
            if not math.isfinite(tow_s) or (self.descriptor == GPS_TIME and not flags & 1):
                return None
            weeks = week if self.descriptor == GPS_CORRELATION or flags & 2 else 0
            into_week_ns: int = round(tow_s * 1e9)
            return int(weeks) * WEEK_S * 1_000_000_000 + into_week_ns
        return None


TIME_FIELDS = (
    TimeField(TICKS, "internal timestamp", GX3_TICK_HZ, 32),
    TimeField(REFERENCE_TIME, "reference time", 1e9, None),
    TimeField(GPS_CORRELATION, "GPS correlation time", 1e9, None),
    TimeField(GPS_TIME, "GPS time", 1e9, None),
    TimeField(PPS_TIME, "PPS time", 1e9, None),
)
"""In order of preference: a free-running counter first, what GPS may set (and so make jump) last."""
