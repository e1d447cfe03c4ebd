"""The emulated sensor's side of the MIP protocol, with an encoder of its own.

Models: "gx3" (internal timestamp 0x0E, signal conditioning), "gx5" (GPS correlation time 0x12 only) and "cv7"
(shared reference time 0xD5 and GPS time 0xD3, data set named in commands).
"""

# One signature for all command handlers: (data, base sample).
# ruff: noqa: ARG002, ARG005
from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from vical_mocks.gx3_state import BAUDS, Gx3State

_ACK_OK, _UNKNOWN, _BAD_CHECKSUM, _INVALID, _FAILED = 0, 1, 2, 3, 4
_BIASES = {0x37: 0x9A, 0x38: 0x9B}


@dataclass(frozen=True, slots=True)
class Model:
    """What a model knows.

    Attributes:
        name: As answered.
        data: Descriptors of its inertial data.
        commands: Descriptors of its 3DM commands.
        base_hz: Base rate of its inertial data.
        stream: Identifier of the inertial stream.
    """

    name: str
    data: tuple[int, ...]
    commands: tuple[int, ...]
    base_hz: int = 1000
    stream: int = 1


MODELS = {
    "gx3": Model(
        "3DM-GX3-25",
        (0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0A, 0x0C, 0x0E),
        (0x01, 0x06, 0x08, 0x11, 0x30, 0x35, 0x36, 0x37, 0x38, 0x39, 0x40),
    ),
    "gx5": Model(
        "3DM-GX5-25", (0x04, 0x05, 0x06, 0x07, 0x08, 0x12), (0x01, 0x06, 0x08, 0x11, 0x30, 0x38, 0x39, 0x40)
    ),
    "cv7": Model(
        "3DM-CV7-AHRS", (0x04, 0x05, 0x07, 0x08, 0xD3, 0xD5), (0x0E, 0x0F, 0x11, 0x38, 0x39), 1000, 0x80
    ),
}


def packet(descriptor_set: int, *fields: bytes) -> bytes:
    """Frame fields: sync, set, length, payload, two 8-bit running sums."""
    payload = b"".join(fields)
    body = bytearray([0x75, 0x65, descriptor_set, len(payload)]) + payload
    first = second = 0
    for value in body:
        first = (first + value) % 256
        second = (second + first) % 256
    return bytes(body) + bytes([first, second])


def field(descriptor: int, data: bytes = b"") -> bytes:
    """One field: its length (both header bytes counted), descriptor, data."""
    return bytes([len(data) + 2, descriptor]) + data


class MipFace:
    """Understands MIP commands and speaks packets; the counterpart of `SingleByteFace`.

    Args:
        state: The device behind.
        on_reset: Called for the reset command.
        on_baud: Called with the new baud, after the reply is on its way.
        model: One of `MODELS`.
    """

    def __init__(
        self,
        state: Gx3State,
        on_reset: Callable[[], None],
        on_baud: Callable[[int], None],
        model: str = "gx3",
    ) -> None:
        self._state = state
        self._on_reset = on_reset
        self._on_baud = on_baud
        self.model = MODELS[model]
        self._input = bytearray()
        self._packets: list[tuple[int, list[bytes]]] = []
        self._late: list[tuple[int, bytes]] = []
        self.format: list[tuple[int, int]] = []
        self.enabled = False
        self.idle = False

    @property
    def streaming(self) -> bool:
        """True while inertial data flows."""
        return self.enabled and not self.idle and bool(self.format)

    @property
    def busy(self) -> bool:
        """True where there is something to do at the next cycle."""
        return bool(self.streaming or self._packets or self._late)

    def period(self) -> int:
        """Base samples (1 ms each) per cycle."""
        if self._packets or self._late or not self.format:
            return 1
        base = max(1, 1000 // self.model.base_hz)
        return base * math.gcd(*(decimation for _, decimation in self.format))

    def power_up(self) -> None:
        """Start silent, with the factory's message format."""
        self._input.clear()
        self._packets.clear()
        self._late.clear()
        self.format = [(0x04, 10), (0x05, 10)]
        self.enabled = self._state.eeprom.power_up_mode == 2
        self.idle = False

    def receive(self, data: bytes) -> None:
        """Take bytes from the host; bad packets are ignored."""
        self._input += data
        while len(self._input) >= 6:
            if self._input[:2] != b"\x75\x65":
                del self._input[0]
                continue
            size = self._input[3] + 6
            if len(self._input) < size:
                return
            whole = bytes(self._input[:size])
            if packet(whole[2], whole[4:-2]) != whole:
                del self._input[0]
                continue
            del self._input[:size]
            self._packets.append((whole[2], _split(whole[4:-2])))

    def cycle(self, k: int) -> bytes:
        """Stream what is due at base sample `k`, then answer the next packet."""
        out = b""
        base = max(1, 1000 // self.model.base_hz)
        if self.streaming:
            due = [d for d, decimation in self.format if k % (decimation * base) == 0]
            if due:
                out += packet(0x80, *(field(d, self._data(d, k)) for d in due))
        for due_k, data in [late for late in self._late if late[0] <= k]:
            self._late.remove((due_k, data))
            out += data
        if self._packets:
            descriptor_set, commands = self._packets.pop(0)
            replies = [self._execute(descriptor_set, c[1], c[2:], k) for c in commands]
            if any(replies):
                out += packet(descriptor_set, *replies)
        return out

    def _data(self, descriptor: int, k: int) -> bytes:
        s = self._state
        if descriptor in (0x07, 0x08):
            angle, velocity = s.increments(k)
            return struct.pack(">3f", *(angle if descriptor == 0x07 else velocity))
        if descriptor == 0x0E:
            return struct.pack(">I", s.ticks(k))
        if descriptor == 0x12:
            return struct.pack(">dHH", k / 1000.0, 0, 0)
        if descriptor == 0xD3:
            return struct.pack(">dHH", 0.0, 0, 0)
        if descriptor == 0xD5:
            return struct.pack(">Q", k * 1_000_000)
        vectors: dict[int, Callable[[], object]] = {
            0x01: lambda: s.accel_g(k) * 13_107 + 65_536,
            0x02: lambda: s.gyro_rps(k) * 8_000 + 65_536,
            0x03: lambda: s.mag_gauss(k),
            0x04: lambda: s.accel_g(k),
            0x05: lambda: s.gyro_rps(k),
            0x06: lambda: s.mag_gauss(k),
            0x09: lambda: s.matrix(k).ravel(),
            0x0A: lambda: (1.0, 0.0, 0.0, 0.0),
            0x0C: lambda: (0.0, 0.0, 0.0),
        }
        values = [float(v) for v in vectors[descriptor]()]  # type: ignore[attr-defined]
        return struct.pack(f">{len(values)}f", *values)

    def _execute(self, descriptor_set: int, command: int, data: bytes, k: int) -> bytes:
        handler = self._handlers().get((descriptor_set, command))
        if handler is None or (descriptor_set == 0x0C and command not in self.model.commands):
            return _ack(command, _UNKNOWN)
        try:
            return handler(data, k)
        except (struct.error, IndexError, ValueError):
            return _ack(command, _INVALID)

    def _handlers(self) -> dict[tuple[int, int], Callable[[bytes, int], bytes]]:
        return {
            (0x01, 0x01): lambda d, k: _ack(0x01),
            (0x01, 0x02): self._idle,
            (0x01, 0x03): self._identity,
            (0x01, 0x04): self._descriptors,
            (0x01, 0x05): self._built_in_test,
            (0x01, 0x06): self._resume,
            (0x01, 0x07): self._more_descriptors,
            (0x01, 0x09): self._port_baud,
            (0x01, 0x7E): self._reset,
            (0x0C, 0x01): self._poll,
            (0x0C, 0x06): lambda d, k: _ack(0x06) + field(0x83, struct.pack(">H", self.model.base_hz)),
            (0x0C, 0x0E): self._base_rate,
            (0x0C, 0x08): self._format,
            (0x0C, 0x0F): self._named_format,
            (0x0C, 0x11): self._stream,
            (0x0C, 0x30): self._startup,
            (0x0C, 0x35): self._conditioning,
            (0x0C, 0x36): self._timestamp,
            (0x0C, 0x37): lambda d, k: self._bias(0x37, d),
            (0x0C, 0x38): lambda d, k: self._bias(0x38, d),
            (0x0C, 0x39): self._capture,
            (0x0C, 0x40): self._baud,
            (0x7F, 0x10): lambda d, k: _ack(0x10) + (field(0x90, b"\x01") if d[0] == 2 else b""),
        }

    def _idle(self, data: bytes, k: int) -> bytes:
        self.idle = True
        return _ack(0x02)

    def _resume(self, data: bytes, k: int) -> bytes:
        self.idle = False
        return _ack(0x06)

    def _identity(self, data: bytes, k: int) -> bytes:
        i = self._state.identity
        texts = (self.model.name, i.model_number, i.serial_number, i.lot, i.options)
        firmware = max(i.firmware, 2006)
        strings = b"".join(t.rjust(16)[-16:].encode("ascii") for t in texts)
        return _ack(0x03) + field(0x81, struct.pack(">H", firmware) + strings)

    def _descriptors(self, data: bytes, k: int) -> bytes:
        base = [0x0100 | d for d in (1, 2, 3, 4, 5, 6, 7, 0x7E)]
        sensor = [0x8000 | d for d in self.model.data if d < 0xD0]
        known = base + [0x0C00 | d for d in self.model.commands] + sensor
        return _ack(0x04) + field(0x82, struct.pack(f">{len(known)}H", *known))

    def _more_descriptors(self, data: bytes, k: int) -> bytes:
        shared = [0x8000 | d for d in self.model.data if d >= 0xD0]
        return _ack(0x07) + (field(0x86, struct.pack(f">{len(shared)}H", *shared)) if shared else b"")

    def _built_in_test(self, data: bytes, k: int) -> bytes:
        self._late.append((k + 500, packet(0x01, _ack(0x05), field(0x83, bytes(4)))))
        return b""

    def _reset(self, data: bytes, k: int) -> bytes:
        self._on_reset()
        return _ack(0x7E)

    def _poll(self, data: bytes, k: int) -> bytes:
        quiet, count = data[0], data[1]
        wanted = [data[2 + 3 * i] for i in range(count)] or [d for d, _ in self.format]
        if any(d not in self.model.data for d in wanted):
            return _ack(0x01, _INVALID)
        self._late.append((k, packet(0x80, *(field(d, self._data(d, k)) for d in wanted))))
        return b"" if quiet else _ack(0x01)

    def _base_rate(self, data: bytes, k: int) -> bytes:
        return _ack(0x0E) + field(0x8E, data[:1] + struct.pack(">H", self.model.base_hz))

    def _format(self, data: bytes, k: int) -> bytes:
        if data[0] == 2:
            return _ack(0x08) + field(0x80, self._format_bytes())
        return _ack(0x08, self._take_format(data[0], data[1:]))

    def _named_format(self, data: bytes, k: int) -> bytes:
        if data[1] != 0x80:
            return _ack(0x0F, _INVALID)
        if data[0] == 2:
            return _ack(0x0F) + field(0x8F, b"\x80" + self._format_bytes())
        return _ack(0x0F, self._take_format(data[0], data[2:]))

    def _format_bytes(self) -> bytes:
        items = b"".join(struct.pack(">BH", d, decimation) for d, decimation in self.format)
        return bytes([len(self.format)]) + items

    def _take_format(self, function: int, data: bytes) -> int:
        if function == 3:
            self._state.eeprom_writes += 1
            return _ACK_OK
        if function != 1:
            return _ACK_OK if function in (4, 5) else _INVALID
        items = [struct.unpack_from(">BH", data, 1 + 3 * i) for i in range(data[0])]
        if any(d not in self.model.data or decimation < 1 for d, decimation in items):
            return _INVALID
        self.format = items
        return _ACK_OK

    def _stream(self, data: bytes, k: int) -> bytes:
        if data[1] != self.model.stream:
            return _ack(0x11, _INVALID)
        if data[0] == 2:
            return _ack(0x11) + field(0x85, bytes([data[1], self.enabled]))
        self.enabled = bool(data[2])
        return _ack(0x11)

    def _startup(self, data: bytes, k: int) -> bytes:
        self._state.eeprom_writes += data[0] == 3
        return _ack(0x30)

    def _conditioning(self, data: bytes, k: int) -> bytes:
        s = self._state.settings
        if data[0] == 1:
            _, decimation, flags, taps, mag_taps, up_s, north_s, power, _ = struct.unpack(">BHHBBHHBH", data)
            s.flags, s.taps, s.mag_taps = flags, min(max(taps, 1), 32), min(max(mag_taps, 1), 32)
            s.decimation, s.up_s, s.north_s, s.mag_power = decimation, up_s, north_s, power
            return _ack(0x35)
        self._state.eeprom_writes += data[0] == 3
        values = (s.decimation, s.flags, s.taps, s.mag_taps, s.up_s, s.north_s, s.mag_power, 0)
        return _ack(0x35) + field(0x86, struct.pack(">HHBBHHBH", *values))

    def _timestamp(self, data: bytes, k: int) -> bytes:
        if data[0] == 1:
            self._state.set_ticks(k, struct.unpack(">I", data[2:6])[0])
            return _ack(0x36)
        return _ack(0x36) + field(0x93, data[1:2] + struct.pack(">I", self._state.ticks(k)))

    def _bias(self, command: int, data: bytes) -> bytes:
        s = self._state.settings
        name = "accel_bias_g" if command == 0x37 else "gyro_bias_rps"
        self._state.eeprom_writes += data[0] == 3
        if data[0] == 1:
            setattr(s, name, struct.unpack(">3f", data[1:13]))
            return _ack(command)
        return _ack(command) + field(_BIASES[command], struct.pack(">3f", *getattr(s, name)))

    def _capture(self, data: bytes, k: int) -> bytes:
        (duration_ms,) = struct.unpack(">H", data)
        if not 1000 <= duration_ms <= 30_000:
            return _ack(0x39, _INVALID)
        bias = struct.pack(">3f", *self._state.capture_gyro_bias(k + duration_ms, duration_ms))
        self._late.append((k + duration_ms, packet(0x0C, _ack(0x39), field(0x9B, bias))))
        return b""

    def _baud(self, data: bytes, k: int) -> bytes:
        if data[0] == 2:
            return _ack(0x40) + field(0x87, struct.pack(">I", self._state.settings.baud))
        self._state.eeprom_writes += data[0] == 3
        return _ack(0x40, self._take_baud(struct.unpack(">I", data[1:5])[0]))

    def _port_baud(self, data: bytes, k: int) -> bytes:
        if 0x40 in self.model.commands:
            return _ack(0x09, _UNKNOWN)
        return _ack(0x09, self._take_baud(struct.unpack(">I", data[2:6])[0]))

    def _take_baud(self, baud: int) -> int:
        if baud not in BAUDS:
            return _INVALID
        self._state.settings.baud = baud
        self._on_baud(baud)
        return _ACK_OK


def _split(payload: bytes) -> list[bytes]:
    fields, at = [], 0
    while at < len(payload) and payload[at] >= 2:
        fields.append(payload[at : at + payload[at]])
        at += payload[at]
    return fields


def _ack(command: int, code: int = _ACK_OK) -> bytes:
    return bytes([0x04, 0xF1, command, code])
