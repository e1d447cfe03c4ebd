"""What the emulated MIP device streams: message formats, enabled streams, and the packets that are due.

As from the factory every stream is enabled (the vendor's SDK: "The default for the device is all streams
enabled"): the sensor streams from power-up on, and after `idle` and `resume` it streams what was configured,
without 0x0C,0x11. The vendor's examples rely on it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from vical_mocks.gx3_state import Gx3State
from vical_mocks.mip_events import PERIOD, Events
from vical_mocks.mip_filter import AttitudeFilter
from vical_mocks.mip_models import ALL_STREAMS, FILTER, SENSOR, Model
from vical_mocks.mip_packets import field as make_field
from vical_mocks.mip_packets import packet
from vical_mocks.mip_settings import DEFAULT, LOAD, READ, SAVE, WRITE

Format = tuple[tuple[int, int], ...]  # descriptor, decimation
_LONGEST = 261
"""Bytes that a packet may have."""
_FACTORY: dict[int, Format] = {SENSOR: ((0x04, 10), (0x05, 10))}
"""Accelerometer and gyro at 100 Hz, nothing of the filter."""


@dataclass(slots=True)
class _Saved:
    formats: dict[int, Format] = field(default_factory=dict)
    enabled: dict[int, bool] = field(default_factory=dict)


class DataStreams:
    """The streams of one device.

    Attributes:
        formats: Descriptors and decimations by data set.
        enabled: Streams that are switched on, by data set.
    """

    def __init__(self, state: Gx3State, model: Model, attitude: AttitudeFilter, events: Events) -> None:
        self._state, self._model, self._attitude, self._events = state, model, attitude, events
        self._saved = self._factory()
        self.load()

    def _factory(self) -> _Saved:
        sets = self._model.data
        return _Saved({s: _FACTORY.get(s, ()) for s in sets}, dict.fromkeys(sets, True))

    def save(self) -> None:
        """Keep what is in force for the next power-up."""
        self._saved = _Saved(dict(self.formats), dict(self.enabled))

    def load(self) -> None:
        """Return to what is saved."""
        self.formats, self.enabled = dict(self._saved.formats), dict(self._saved.enabled)

    def default(self) -> None:
        """Return to the factory's; what is saved stays."""
        factory = self._factory()
        self.formats, self.enabled = factory.formats, factory.enabled

    @property
    def flowing(self) -> bool:
        """True where some stream is enabled and not empty."""
        return any(self.enabled[s] and items for s, items in self.formats.items())

    @property
    def busy(self) -> bool:
        """True where there is something to do at some cycle."""
        return self.flowing or self._events.enabled

    def period(self) -> int:
        """Base samples (1 ms each) per cycle."""
        steps = [
            decimation * self._model.divider(data_set)
            for data_set, items in self.formats.items()
            for _, decimation in items
            if self.enabled[data_set]
        ]
        return math.gcd(*steps, *([PERIOD] if self._events.enabled else [])) or 1

    def due(self, k: int) -> bytes:
        """Return the packets that are due at base sample `k`."""
        out = b""
        for data_set, items in self.formats.items():
            step = self._model.divider(data_set)
            wanted = [d for d, decimation in items if k % (decimation * step) == 0]
            if wanted and self.enabled[data_set]:
                out += self.packet(data_set, wanted, k)
        if self._events.enabled and k % PERIOD == 0:
            for data_set, trigger, descriptors in self._events.due(k):
                out += self.packet(data_set, descriptors, k, trigger)
        return out

    def packet(self, data_set: int, descriptors: Iterable[int], k: int, source: int = 0) -> bytes:
        """Make one packet of data; `source` is the trigger that asked for it, 0: the schedule."""
        return packet(data_set, *(make_field(d, self._data(data_set, d, k, source)) for d in descriptors))

    def set_format(self, data_set: int, function: int, data: bytes) -> bytes | None:
        """Do what a message format command says.

        Args:
            data_set: Which stream.
            function: Function selector.
            data: Count, then descriptor and decimation of each field.

        Returns:
            The format, where it is asked for.

        Raises:
            ValueError: It cannot be so.
        """
        if data_set not in self.formats:
            raise ValueError("data set")
        if function == READ:
            items = self.formats[data_set]
            return bytes([len(items)]) + b"".join(struct.pack(">BH", *item) for item in items)
        if function == WRITE:
            wanted = tuple(struct.unpack_from(">BH", data, 1 + 3 * i) for i in range(data[0]))
            if any(d not in self._model.data[data_set] or decimation < 1 for d, decimation in wanted):
                raise ValueError("descriptor or decimation")
            if len(self.packet(data_set, [d for d, _ in wanted], 0)) > _LONGEST:
                raise ValueError("longer than a packet")
            self.formats[data_set] = wanted
        elif function == SAVE:
            self._saved.formats[data_set] = self.formats[data_set]
        else:
            self.formats[data_set] = self._source(function).formats[data_set]
        return None

    def control(self, function: int, name: int, data: bytes) -> bytes | None:
        """Do what a stream control command says.

        Args:
            function: Function selector.
            name: The stream as this model calls it; 0: all, where nothing is written or read.
            data: 1: switch it on.

        Returns:
            Whether it is on, where it is asked for.

        Raises:
            ValueError: No such stream or function.
        """
        everything = name == ALL_STREAMS and function in (SAVE, LOAD, DEFAULT)
        if name not in self._model.streams and not everything:
            raise ValueError("stream")
        for data_set in self.formats if everything else [self._model.streams[name]]:
            if function == READ:
                return bytes([self.enabled[data_set]])
            if function == WRITE:
                self.enabled[data_set] = bool(data[0])
            elif function == SAVE:
                self._saved.enabled[data_set] = self.enabled[data_set]
            else:
                self.enabled[data_set] = self._source(function).enabled[data_set]
        return None

    def _source(self, function: int) -> _Saved:
        if function not in (LOAD, DEFAULT):
            raise ValueError("function")
        return self._saved if function == LOAD else self._factory()

    def _data(self, data_set: int, descriptor: int, k: int, source: int) -> bytes:
        s = self._state
        if descriptor == 0xD0:
            return bytes([source])
        if descriptor == 0xD3:
            return struct.pack(">dHH", 0.0, 0, 0)
        if descriptor == 0xD5:
            return struct.pack(">Q", k * 1_000_000)
        if data_set == FILTER:
            return self._attitude.field(descriptor, k)
        if descriptor in (0x07, 0x08):
            angle, velocity = s.increments(k)
            return struct.pack(">3f", *(angle if descriptor == 0x07 else velocity))
        if descriptor == 0x0E:
            return struct.pack(">I", s.ticks(k))
        if descriptor == 0x12:
            return struct.pack(">dHH", k / 1000.0, 0, 0)
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
