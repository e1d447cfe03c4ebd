"""The emulated GX3's side of the single-byte protocol, with an encoder of its own (manual v1.08).

Never shares code with the driver's codec: two sides with one mistake would agree with each other.
"""

# One signature for all command handlers: (command, base sample).
# ruff: noqa: ARG002
from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable

from vical_mocks.gx3_state import BAUDS, Gx3State

_LENGTHS = {
    **dict.fromkeys((0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC8, 0xCB, 0xCC, 0xCE, 0xCF), 1),
    **dict.fromkeys((0xD1, 0xD2, 0xD3, 0xDA, 0xDF, 0xE9), 1),
    0xC4: 4,
    0xC9: 15,
    0xCA: 15,
    0xCD: 5,
    0xD0: 5,
    0xD4: 4,
    0xD5: 4,
    0xD6: 4,
    0xD7: 8,
    0xD9: 11,
    0xDB: 20,
    0xDD: 10,
    0xE4: 8,
    0xE5: 4,
    0xEA: 2,
    0xFA: 3,
    0xFE: 3,
}
"""Bytes of each command by its first byte; anything else is ignored, byte by byte."""
_CONFIRM = {
    0xC4: (0xC1, 0x29),
    0xC9: (0xB7, 0x44),
    0xCA: (0x12, 0xA5),
    0xCD: (0xC1, 0x29),
    0xD0: (0xC1, 0x29),
    0xD4: (0xA3, 0x47),
    0xD5: (0xBA, 0x89),
    0xD6: (0xC6, 0x6B),
    0xD7: (0xC1, 0x29),
    0xD9: (0xC3, 0x55),
    0xDB: (0xA8, 0xB9),
    0xDD: (0x54, 0x4C),
    0xE4: (0xC1, 0x29),
    0xFA: (0x75, 0xB4),
    0xFE: (0x9E, 0x3A),
}
_DATA = frozenset({0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC8, 0xCB, 0xCC, 0xCE, 0xCF, 0xD1, 0xD2, 0xD3, 0xDF})
_ACTIVE, _CONTINUOUS, _IDLE, _SLEEP, _DEEP_SLEEP = 1, 2, 3, 4, 5
_COUNTS_MIDDLE = 65_536.0
ERROR = bytes([0x21, 0x00, 0x21])


def frame(body: bytes) -> bytes:
    """Append the 16-bit sum."""
    return body + struct.pack(">H", sum(body) % 65_536)


class SingleByteFace:
    """Understands single-byte commands and speaks records.

    Args:
        state: The device behind.
        on_reset: Called for command 0xFE.
        on_baud: Called with the new baud, after the reply is on its way.
    """

    def __init__(self, state: Gx3State, on_reset: Callable[[], None], on_baud: Callable[[int], None]) -> None:
        self._state = state
        self._on_reset = on_reset
        self._on_baud = on_baud
        self._input = bytearray()
        self._commands: list[bytes] = []
        self._capture_until: int | None = None
        self._capture_ms = 0
        self.streaming = 0
        self.mode = _ACTIVE

    def power_up(self) -> None:
        """Start in the mode that the EEPROM says."""
        self._input.clear()
        self._commands.clear()
        self._capture_until = None
        self.streaming = 0
        self.mode = self._state.eeprom.power_up_mode
        if self.mode == _CONTINUOUS:
            self.streaming = self._state.eeprom.preset_command

    @property
    def busy(self) -> bool:
        """True where there is something to do at the next cycle."""
        return bool(self.streaming or self._commands or self._capture_until is not None)

    def period(self) -> int:
        """Base samples per cycle."""
        return self._state.settings.decimation

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        if self.mode in (_SLEEP, _DEEP_SLEEP) and data:
            # Any byte wakes the unit; it need not be a command, and is not taken as one.
            self.mode = self._state.eeprom.power_up_mode
            data = data[1:]
        self._input += data
        while self._input:
            need = _LENGTHS.get(self._input[0])
            if need is None:
                del self._input[0]
                continue
            if len(self._input) < need:
                return
            self._commands.append(bytes(self._input[:need]))
            del self._input[:need]

    def cycle(self, k: int) -> bytes:
        """Do what the end of a sampling cycle brings: the next command, then the next streamed record."""
        out = b""
        if self._capture_until is not None:
            if k < self._capture_until:
                return b""
            self._capture_until = None
            out += self._timed(0xCD, _floats(self._state.capture_gyro_bias(k, self._capture_ms)), k)
        # Streamed first: the reply to a mode change is sent before its stream starts.
        if self.streaming:
            out += self.record(self.streaming, k)
        if self._commands:
            out += self._execute(self._commands.pop(0), k)
        return out

    def _execute(self, command: bytes, k: int) -> bytes:
        kind = command[0]
        confirm = _CONFIRM.get(kind)
        if confirm is not None and tuple(command[1:3]) != confirm:
            return ERROR
        if kind in _DATA:
            return self.record(kind, k)
        return self._handlers()[kind](command, k)

    def _handlers(self) -> dict[int, Callable[[bytes, int], bytes]]:
        return {
            0xC4: self._continuous,
            0xC9: self._accel_bias,
            0xCA: self._gyro_bias,
            0xCD: self._capture,
            0xD0: self._store_bias,
            0xD4: self._mode,
            0xD5: self._mode_preset,
            0xD6: self._preset,
            0xD7: self._timer,
            0xD9: self._communication,
            0xDA: self._self_test,
            0xDB: self._sampling,
            0xDD: self._realign,
            0xE4: self._write_word,
            0xE5: self._read_word,
            0xE9: self._firmware,
            0xEA: self._identity,
            0xFA: self._stop,
            0xFE: self._reset,
        }

    def record(self, kind: int, k: int) -> bytes:
        """Encode one data record of base sample `k`."""
        s = self._state
        if kind == 0xD1:
            return self._timed(kind, struct.pack(">4H", 2139, 1800, 1810, 1820), k)
        parts: dict[int, Callable[[], Iterable[float]]] = {
            0xC1: lambda: [
                *(s.accel_g(k) * 13_107 + _COUNTS_MIDDLE),
                *(s.gyro_rps(k) * 8_000 + _COUNTS_MIDDLE),
            ],
            0xC2: lambda: [*s.accel_g(k), *s.gyro_rps(k)],
            0xC3: lambda: [*s.increments(k)[0], *s.increments(k)[1]],
            0xC5: lambda: s.matrix(k).ravel(),
            0xC6: lambda: s.matrix(k).ravel(),
            0xC7: lambda: s.mag_gauss(k),
            0xC8: lambda: [*s.accel_g(k), *s.gyro_rps(k), *s.matrix(k).ravel()],
            0xCB: lambda: [*s.accel_g(k), *s.gyro_rps(k), *s.mag_gauss(k)],
            0xCC: lambda: [*s.accel_g(k), *s.gyro_rps(k), *s.mag_gauss(k), *s.matrix(k).ravel()],
            0xCE: lambda: self._euler(k),
            0xCF: lambda: [*self._euler(k), *s.gyro_rps(k)],
            0xD2: lambda: [*(-s.matrix(k)[:, 2]), *s.gyro_rps(k), *s.mag_gauss(k)],
            0xD3: lambda: [*s.increments(k)[0], *s.increments(k)[1], *s.mag_gauss(k)],
            0xDF: lambda: self._quaternion(k),
        }
        values = list(parts[kind]())
        if self.mode == _IDLE:
            values = [math.nan] * len(values)
        order = "<" if s.settings.flags & 0x10 else ">"
        return self._timed(kind, struct.pack(f"{order}{len(values)}f", *values), k)

    def _timed(self, kind: int, body: bytes, k: int) -> bytes:
        return frame(bytes([kind]) + body + struct.pack(">I", self._state.ticks(k)))

    def _euler(self, k: int) -> tuple[float, float, float]:
        m = self._state.matrix(k)
        return (
            math.atan2(m[1, 2], m[2, 2]),
            math.asin(max(-1.0, min(1.0, -m[0, 2]))),
            math.atan2(m[0, 1], m[0, 0]),
        )

    def _quaternion(self, k: int) -> tuple[float, float, float, float]:
        if not self._state.settings.flags & 0x1000:
            return (math.nan,) * 4
        roll, pitch, yaw = (0.5 * angle for angle in self._euler(k))
        cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
        return (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )

    def _continuous(self, command: bytes, k: int) -> bytes:
        wanted = command[3]
        self.streaming = wanted if wanted in _DATA else 0
        self.mode = _CONTINUOUS if self.streaming else _ACTIVE
        return self._timed(0xC4, bytes([self.streaming]), k)

    def _accel_bias(self, command: bytes, k: int) -> bytes:
        self._state.settings.accel_bias_g = struct.unpack(">3f", command[3:15])
        return self._timed(0xC9, command[3:15], k)

    def _gyro_bias(self, command: bytes, k: int) -> bytes:
        self._state.settings.gyro_bias_rps = struct.unpack(">3f", command[3:15])
        return self._timed(0xCA, command[3:15], k)

    def _capture(self, command: bytes, k: int) -> bytes:
        (self._capture_ms,) = struct.unpack(">H", command[3:5])
        self._capture_until = k + self._capture_ms
        return b""

    def _store_bias(self, command: bytes, k: int) -> bytes:
        (which,) = struct.unpack(">H", command[3:5])
        if which == 1:
            self._state.store(accel_bias_g=self._state.settings.accel_bias_g)
        elif which == 2:
            self._state.store(gyro_bias_rps=self._state.settings.gyro_bias_rps)
        else:
            which = 0xFFFF
        return self._timed(0xD0, struct.pack(">H", which), k)

    def _mode(self, command: bytes, k: int) -> bytes:
        wanted = command[3]
        reported = self.mode
        if wanted == _CONTINUOUS:
            self.streaming = self._state.eeprom.preset_command
            self.mode = reported = _CONTINUOUS if self.streaming else self.mode
        elif wanted in (_ACTIVE, _IDLE, _SLEEP, _DEEP_SLEEP):
            self.streaming = 0
            self.mode = reported = wanted
        return frame(bytes([0xD4, reported]))

    def _mode_preset(self, command: bytes, k: int) -> bytes:
        if command[3] in (_ACTIVE, _CONTINUOUS, _IDLE):
            self._state.store(power_up_mode=command[3])
        return frame(bytes([0xD5, self._state.eeprom.power_up_mode]))

    def _preset(self, command: bytes, k: int) -> bytes:
        if command[3] in _DATA:
            self._state.store(preset_command=command[3])
        return frame(bytes([0xD6, self._state.eeprom.preset_command]))

    def _timer(self, command: bytes, k: int) -> bytes:
        function, value = struct.unpack(">BI", command[3:8])
        if function == 1:
            self._state.set_ticks(k, value)
        return frame(b"\xd7" + struct.pack(">I", self._state.ticks(k)))

    def _communication(self, command: bytes, k: int) -> bytes:
        port, function, baud, config = struct.unpack(">BBIB", command[3:10])
        now = self._state.settings.baud
        if port == 1 and function in (1, 2) and baud in BAUDS and config & 2:
            now = self._state.settings.baud = baud
            if function == 2:
                self._state.store(baud=baud)
            self._on_baud(baud)
        return frame(b"\xd9" + struct.pack(">BIBB", 1, now, 2, 0))

    def _self_test(self, command: bytes, k: int) -> bytes:
        return frame(b"\xda" + struct.pack(">I", 0x00100FDF if self.mode != _IDLE else 0x00100FDD))

    def _sampling(self, command: bytes, k: int) -> bytes:
        function, decimation, flags, taps, mag_taps, up_s, north_s, power = struct.unpack(
            ">BHHBBHHB", command[3:15]
        )
        s = self._state.settings
        if function in (1, 2, 3):
            s.decimation, s.flags = min(max(decimation, 1), 1000), flags & 0x1F73
            s.taps, s.mag_taps = min(max(taps, 1), 32), min(max(mag_taps, 1), 32)
            s.up_s, s.north_s, s.mag_power = min(max(up_s, 1), 1000), min(max(north_s, 1), 1000), power
        if function == 2 or (function in (1, 3) and self._state.identity.firmware < 1127):
            kept = ("decimation", "flags", "taps", "mag_taps", "up_s", "north_s", "mag_power")
            self._state.store(**{name: getattr(s, name) for name in kept})
        if function == 3:
            return b""
        body = struct.pack(
            ">HHBBHHB5x", s.decimation, s.flags, s.taps, s.mag_taps, s.up_s, s.north_s, s.mag_power
        )
        return frame(b"\xdb" + body)

    def _realign(self, command: bytes, k: int) -> bytes:
        return b"" if command[3] == 3 else frame(b"\xdd" + bytes(4))

    def _write_word(self, command: bytes, k: int) -> bytes:
        address, value = struct.unpack(">HH", command[4:8])
        self._state.eeprom_words[address] = value
        self._state.eeprom_writes += 1
        return frame(b"\xe4" + struct.pack(">H", value))

    def _read_word(self, command: bytes, k: int) -> bytes:
        (address,) = struct.unpack(">H", command[2:4])
        return frame(b"\xe5" + struct.pack(">H", self._state.eeprom_words.get(address, 0xFFFF)))

    def _firmware(self, command: bytes, k: int) -> bytes:
        return frame(b"\xe9" + struct.pack(">I", self._state.identity.firmware))

    def _identity(self, command: bytes, k: int) -> bytes:
        i = self._state.identity
        texts = (i.model_number, i.serial_number, i.model_name, i.options, i.lot)
        text = texts[command[1]] if command[1] < len(texts) else ""
        return frame(bytes([0xEA, command[1]]) + text.rjust(16)[-16:].encode("ascii"))

    def _stop(self, command: bytes, k: int) -> bytes:
        self.streaming, self.mode = 0, _ACTIVE
        return b""

    def _reset(self, command: bytes, k: int) -> bytes:
        self._on_reset()
        return b""


def _floats(values: Iterable[float]) -> bytes:
    return struct.pack(">3f", *values)
