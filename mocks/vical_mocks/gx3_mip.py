"""The emulated sensor's side of the MIP protocol: its commands; `mip_models` says which a model knows.

Settings are in three places, as in the device: in force, saved (in force after power-up), factory.
"""

# One signature for all command handlers: (data, base sample).
# ruff: noqa: ARG002, ARG005
from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace

from vical_mocks.gx3_state import BAUDS, Gx3State, Settings
from vical_mocks.mip_events import INSTANCES, Events
from vical_mocks.mip_filter import AttitudeFilter
from vical_mocks.mip_models import FILTER, MODELS, SENSOR
from vical_mocks.mip_packets import INVALID, UNKNOWN, ack, field, packet, split
from vical_mocks.mip_settings import DEFAULT, LOAD, READ, SAVE, SETTINGS, WRITE, SettingStore
from vical_mocks.mip_streams import DataStreams

_BASE, _3DM, _FILTER_COMMANDS, _SYSTEM = 0x01, 0x0C, 0x0D, 0x7F
_DEVICE_SETTINGS = {
    0x35: ("decimation", "flags", "taps", "mag_taps", "up_s", "north_s", "mag_power"),
    0x37: ("accel_bias_g",),
    0x38: ("gyro_bias_rps",),
    0x40: ("baud",),
}
"""3DM commands that set what both protocols of the device share."""


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
        self._settings = SettingStore()
        self._filter = AttitudeFilter(state, self._settings, self.model)
        self._events = Events(self._settings, self._filter)
        self.streams = DataStreams(state, self.model, self._filter, self._events)
        self.idle = False

    @property
    def streaming(self) -> bool:
        """True while data flows."""
        return not self.idle and self.streams.flowing

    @property
    def busy(self) -> bool:
        """True where there is something to do at the next cycle."""
        return bool(self._packets or self._late or (not self.idle and self.streams.busy))

    def period(self) -> int:
        """Base samples (1 ms each) per cycle."""
        return 1 if self._packets or self._late else self.streams.period()

    def power_up(self) -> None:
        """Start with what is saved."""
        self._input.clear()
        self._packets.clear()
        self._late.clear()
        self._settings.load_all()
        self.streams.load()
        self._filter.reset()
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
            self._packets.append((whole[2], split(whole[4:-2])))

    def cycle(self, k: int) -> bytes:
        """Stream what is due at base sample `k`, then answer the next packet."""
        out = b"" if self.idle else self.streams.due(k)
        for due_k, data in [late for late in self._late if late[0] <= k]:
            self._late.remove((due_k, data))
            out += data
        if self._packets:
            descriptor_set, commands = self._packets.pop(0)
            replies = [self._execute(descriptor_set, c[1], c[2:], k) for c in commands]
            if any(replies):
                out += packet(descriptor_set, *replies)
        return out

    def _known(self, descriptor_set: int) -> tuple[int, ...]:
        """Descriptors of the commands that this model knows."""
        m = self.model
        return {
            _BASE: m.base_commands,
            _3DM: m.commands,
            _FILTER_COMMANDS: m.filter_commands,
            _SYSTEM: (0x10,),
        }.get(descriptor_set, ())

    def _execute(self, descriptor_set: int, command: int, data: bytes, k: int) -> bytes:
        address = (descriptor_set, command)
        if command not in self._known(descriptor_set):
            return ack(command, UNKNOWN)
        try:
            if address in SETTINGS:
                self._state.eeprom_writes += data[0] == SAVE
                reply = self._settings.execute(address, data)
                return ack(command) + (b"" if reply is None else field(SETTINGS[address].reply, reply))
            return self._handlers()[address](data, k)
        except (struct.error, IndexError, ValueError):
            return ack(command, INVALID)

    def _handlers(self) -> dict[tuple[int, int], Callable[[bytes, int], bytes]]:
        return {
            (_BASE, 0x01): lambda d, k: ack(0x01),
            (_BASE, 0x02): self._set_idle,
            (_BASE, 0x03): self._identity,
            (_BASE, 0x04): self._descriptors,
            (_BASE, 0x05): self._built_in_test,
            (_BASE, 0x06): self._resume,
            (_BASE, 0x07): self._more_descriptors,
            (_BASE, 0x08): lambda d, k: ack(0x08) + field(0x88, bytes(16)),
            (_BASE, 0x09): self._port_baud,
            (_BASE, 0x7E): self._reset,
            (_3DM, 0x01): lambda d, k: self._poll(0x01, SENSOR, d[0], d[1], d[2::3], k),
            (_3DM, 0x03): lambda d, k: self._poll(0x03, FILTER, d[0], d[1], d[2::3], k),
            (_3DM, 0x0D): lambda d, k: self._poll(0x0D, d[0], d[1], d[2], d[3:], k),
            (_3DM, 0x06): lambda d, k: self._base_rate(0x06, 0x83, SENSOR, b""),
            (_3DM, 0x0B): lambda d, k: self._base_rate(0x0B, 0x8A, FILTER, b""),
            (_3DM, 0x0E): lambda d, k: self._base_rate(0x0E, 0x8E, d[0], d[:1]),
            (_3DM, 0x08): lambda d, k: self._format(0x08, 0x80, SENSOR, d[0], b"", d[1:]),
            (_3DM, 0x0A): lambda d, k: self._format(0x0A, 0x82, FILTER, d[0], b"", d[1:]),
            (_3DM, 0x0F): lambda d, k: self._format(0x0F, 0x8F, d[1], d[0], d[1:2], d[2:]),
            (_3DM, 0x11): self._stream,
            (_3DM, 0x2A): self._event_support,
            (_3DM, 0x2C): lambda d, k: self._event_status(0x2C, 0xB6, d),
            (_3DM, 0x2D): lambda d, k: self._event_status(0x2D, 0xB7, d),
            (_3DM, 0x30): self._all_settings,
            (_3DM, 0x35): self._conditioning,
            (_3DM, 0x36): self._timestamp,
            (_3DM, 0x37): lambda d, k: self._bias(0x37, 0x9A, d),
            (_3DM, 0x38): lambda d, k: self._bias(0x38, 0x9B, d),
            (_3DM, 0x39): self._capture,
            (_3DM, 0x40): self._baud,
            (_FILTER_COMMANDS, 0x01): self._reset_filter,
            (_FILTER_COMMANDS, 0x02): lambda d, k: self._run_filter(0x02, d, 12),
            (_FILTER_COMMANDS, 0x03): lambda d, k: self._run_filter(0x03, d, 4),
            (_FILTER_COMMANDS, 0x05): lambda d, k: self._run_filter(0x05, d, 0),
            (_SYSTEM, 0x10): lambda d, k: ack(0x10) + (field(0x90, b"\x01") if d[0] == READ else b""),
        }

    def _set_idle(self, data: bytes, k: int) -> bytes:
        self.idle = True
        return ack(0x02)

    def _resume(self, data: bytes, k: int) -> bytes:
        self.idle = False
        return ack(0x06)

    def _identity(self, data: bytes, k: int) -> bytes:
        i = self._state.identity
        texts = (self.model.name, self.model.number, i.serial_number, i.lot, i.options)
        firmware = max(i.firmware, 2006)
        strings = b"".join(t.rjust(16)[-16:].encode("ascii") for t in texts)
        return ack(0x03) + field(0x81, struct.pack(">H", firmware) + strings)

    def _all_descriptors(self) -> list[int]:
        m = self.model
        sets = {_BASE: m.base_commands, _3DM: m.commands, _FILTER_COMMANDS: m.filter_commands, **m.data}
        return [number << 8 | d for number, descriptors in sets.items() for d in descriptors]

    def _descriptors(self, data: bytes, k: int) -> bytes:
        known = [d for d in self._all_descriptors() if not _is_further(d)]
        return ack(0x04) + field(0x82, struct.pack(f">{len(known)}H", *known))

    def _more_descriptors(self, data: bytes, k: int) -> bytes:
        further = [d for d in self._all_descriptors() if _is_further(d)]
        return ack(0x07) + field(0x86, struct.pack(f">{len(further)}H", *further))

    def _built_in_test(self, data: bytes, k: int) -> bytes:
        self._late.append((k + 500, packet(_BASE, ack(0x05), field(0x83, bytes(4)))))
        return b""

    def _reset(self, data: bytes, k: int) -> bytes:
        self._on_reset()
        return ack(0x7E)

    def _poll(self, command: int, data_set: int, quiet: int, count: int, names: bytes, k: int) -> bytes:
        """Answer, and send one packet of data after it; without names: as the stream is configured."""
        known = self.model.data.get(data_set, ())
        wanted = list(names[:count]) or [d for d, _ in self.streams.formats.get(data_set, ())]
        if len(names) < count or not wanted or any(d not in known for d in wanted):
            return ack(command, INVALID)
        self._late.append((k, self.streams.packet(data_set, wanted, k)))
        return b"" if quiet else ack(command)

    def _base_rate(self, command: int, reply: int, data_set: int, named: bytes) -> bytes:
        if data_set not in self.model.base_hz:
            return ack(command, INVALID)
        return ack(command) + field(reply, named + struct.pack(">H", self.model.base_hz[data_set]))

    def _format(
        self, command: int, reply: int, data_set: int, function: int, named: bytes, data: bytes
    ) -> bytes:
        self._state.eeprom_writes += function == SAVE
        value = self.streams.set_format(data_set, function, data)
        return ack(command) + (b"" if value is None else field(reply, named + value))

    def _stream(self, data: bytes, k: int) -> bytes:
        self._state.eeprom_writes += data[0] == SAVE
        value = self.streams.control(data[0], data[1], data[2:])
        return ack(0x11) + (b"" if value is None else field(0x85, data[1:2] + value))

    def _event_support(self, data: bytes, k: int) -> bytes:
        kinds = {1: (1, 2, 3), 2: (1, 2)}.get(data[0])  # triggers: GPIO, threshold, combination; actions
        if kinds is None:
            return ack(0x2A, INVALID)
        entries = b"".join(bytes([kind, INSTANCES]) for kind in kinds)
        return ack(0x2A) + field(0xB4, bytes([data[0], INSTANCES, len(kinds)]) + entries)

    def _event_status(self, command: int, reply: int, data: bytes) -> bytes:
        """Type and state of each instance asked for; none named: of all."""
        wanted = data[1 : 1 + data[0]] or bytes(range(1, INSTANCES + 1))
        if len(data) < 1 + data[0]:
            return ack(command, INVALID)
        entries = b""
        for instance in wanted:
            value = self._settings.get((_3DM, command + 2), bytes([instance]))
            active = instance in self._events.active
            entries += bytes([value[0], active]) if command == 0x2C else bytes([value[1], value[0]])
        return ack(command) + field(reply, bytes([len(wanted)]) + entries)

    def _all_settings(self, data: bytes, k: int) -> bytes:
        """Save, load or reset everything, the baud included; whether it is idle is no setting."""
        s, function = self._state, data[0]
        if function == SAVE:
            s.store(**{n: getattr(s.settings, n) for names in _DEVICE_SETTINGS.values() for n in names})
            self._settings.save_all()
            self.streams.save()
        elif function in (LOAD, DEFAULT):
            before = s.settings.baud
            s.settings = replace(s.eeprom) if function == LOAD else Settings()
            if function == LOAD:
                self._settings.load_all()
                self.streams.load()
            else:
                self._settings.default_all()
                self.streams.default()
            if s.settings.baud != before:
                self._on_baud(s.settings.baud)
        else:
            return ack(0x30, INVALID)
        return ack(0x30)

    def _keep(self, command: int, function: int) -> None:
        """Save, load or reset one of the settings that both protocols share."""
        s = self._state
        for name in _DEVICE_SETTINGS[command]:
            if function == LOAD:
                setattr(s.settings, name, getattr(s.eeprom, name))
            elif function == DEFAULT:
                setattr(s.settings, name, getattr(Settings(), name))
        if function == SAVE:
            s.store(**{name: getattr(s.settings, name) for name in _DEVICE_SETTINGS[command]})
        elif function not in (READ, LOAD, DEFAULT):
            raise ValueError("function")

    def _conditioning(self, data: bytes, k: int) -> bytes:
        s = self._state.settings
        if data[0] == WRITE:
            _, decimation, flags, taps, mag_taps, up_s, north_s, power, _ = struct.unpack(">BHHBBHHBH", data)
            s.flags, s.taps, s.mag_taps = flags, min(max(taps, 1), 32), min(max(mag_taps, 1), 32)
            s.decimation, s.up_s, s.north_s, s.mag_power = decimation, up_s, north_s, power
            return ack(0x35)
        self._keep(0x35, data[0])
        values = (s.decimation, s.flags, s.taps, s.mag_taps, s.up_s, s.north_s, s.mag_power, 0)
        reply = field(0x86, struct.pack(">HHBBHHBH", *values)) if data[0] == READ else b""
        return ack(0x35) + reply

    def _timestamp(self, data: bytes, k: int) -> bytes:
        if data[0] == WRITE:
            self._state.set_ticks(k, struct.unpack(">I", data[2:6])[0])
            return ack(0x36)
        return ack(0x36) + field(0x93, data[1:2] + struct.pack(">I", self._state.ticks(k)))

    def _bias(self, command: int, reply: int, data: bytes) -> bytes:
        s = self._state.settings
        (name,) = _DEVICE_SETTINGS[command]
        if data[0] == WRITE:
            setattr(s, name, struct.unpack(">3f", data[1:13]))
            return ack(command)
        self._keep(command, data[0])
        value = field(reply, struct.pack(">3f", *getattr(s, name))) if data[0] == READ else b""
        return ack(command) + value

    def _capture(self, data: bytes, k: int) -> bytes:
        (duration_ms,) = struct.unpack(">H", data)
        if not 1000 <= duration_ms <= 30_000:
            return ack(0x39, INVALID)
        bias = struct.pack(">3f", *self._state.capture_gyro_bias(k + duration_ms, duration_ms))
        self._late.append((k + duration_ms, packet(_3DM, ack(0x39), field(0x9B, bias))))
        return b""

    def _baud(self, data: bytes, k: int) -> bytes:
        return self._any_baud(0x40, 0x87, data[0], b"", data[1:5])

    def _port_baud(self, data: bytes, k: int) -> bytes:
        if data[1] != 1:  # the only port
            return ack(0x09, INVALID)
        return self._any_baud(0x09, 0x89, data[0], data[1:2], data[2:6])

    def _any_baud(self, command: int, reply: int, function: int, port: bytes, value: bytes) -> bytes:
        s = self._state.settings
        if function == READ:
            return ack(command) + field(reply, port + struct.pack(">I", s.baud))
        before = s.baud
        if function == WRITE:
            (baud,) = struct.unpack(">I", value)
            if baud not in BAUDS:
                return ack(command, INVALID)
            s.baud = baud
        else:
            self._keep(0x40, function)
        if s.baud != before:
            self._on_baud(s.baud)
        return ack(command)

    def _reset_filter(self, data: bytes, k: int) -> bytes:
        self._filter.reset()
        return ack(0x01)

    def _run_filter(self, command: int, data: bytes, size: int) -> bytes:
        """An attitude or heading from outside, or the word to begin."""
        if len(data) != size:
            return ack(command, INVALID)
        self._filter.run()
        return ack(command)


def _is_further(descriptor: int) -> bool:
    """Whether set << 8 | descriptor stands in the second list: data of the filter, and shared ones."""
    return descriptor >> 8 == FILTER or (descriptor >> 8 == SENSOR and descriptor & 0xFF >= 0xD0)
