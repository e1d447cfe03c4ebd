"""Settings of a MIP device that it keeps as the bytes of the wire: written, read back, saved, loaded, reset.

Layouts and factory values are those of the vendor's SDK definitions. The emulated sensor reads some of them
(events, filter); the others it only keeps: a sensor-to-vehicle rotation does not turn the data.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

WRITE, READ, SAVE, LOAD, DEFAULT = 1, 2, 3, 4, 5
"""Function selectors."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Attributes:
        reply: Descriptor of the field that it is read back in.
        factory: Value as from the factory.
        key: Bytes before the value that say which one (instance, pin, source); they stand in the reply, too.
        longest: Bytes that a value may have; None: as many as the factory's.
    """

    reply: int
    factory: bytes
    key: int = 0
    longest: int | None = None


_ZERO3 = struct.pack(">3f", 0, 0, 0)
_ONE9 = struct.pack(">9f", 1, 0, 0, 0, 1, 0, 0, 0, 1)
EVENT_CONTROL, EVENT_TRIGGER, EVENT_ACTION = (0x0C, 0x2B), (0x0C, 0x2E), (0x0C, 0x2F)
AUTO_INIT, AIDING = (0x0D, 0x19), (0x0D, 0x50)
MAGNETOMETER = struct.pack(">H", 5)
"""Aiding source."""
SETTINGS = {
    (0x0C, 0x28): Setting(0xA8, b"\x01"),  # PPS source
    EVENT_CONTROL: Setting(0xB5, b"\x00", key=1),
    EVENT_TRIGGER: Setting(0xB8, b"\x00", key=1, longest=21),  # type, then its parameters
    EVENT_ACTION: Setting(0xB9, b"\x00\x00", key=1, longest=18),  # trigger, type, parameters
    (0x0C, 0x31): Setting(0xB1, _ZERO3),  # sensor to vehicle, roll pitch yaw
    (0x0C, 0x3A): Setting(0x9C, _ZERO3),  # hard iron
    (0x0C, 0x3B): Setting(0x9D, _ONE9),  # soft iron
    (0x0C, 0x3E): Setting(0x9E, b"\x01"),  # coning and sculling
    (0x0C, 0x41): Setting(0xC1, b"\x00\x00\x00", key=1),  # GPIO: feature, behaviour, mode
    (0x0C, 0x50): Setting(0x8B, struct.pack(">BBHB", 1, 0, 0, 0), key=1),  # low pass by data field
    (0x0C, 0x51): Setting(0x97, struct.pack(">BBff", 1, 1, 10, 10)),  # complementary filter
    (0x0C, 0x54): Setting(0xD4, struct.pack(">BBf", 0, 0, 0), key=2),  # low pass by data set and field
    (0x0D, 0x11): Setting(0x81, _ZERO3),  # sensor to vehicle, roll pitch yaw
    (0x0D, 0x14): Setting(0x84, b"\x00\x01"),  # what the filter estimates
    (0x0D, 0x18): Setting(0x87, b"\x01"),  # heading source
    AUTO_INIT: Setting(0x88, b"\x01"),
    (0x0D, 0x1A): Setting(0x89, struct.pack(">3f", 0.02, 0.02, 0.02)),  # accelerometer noise
    (0x0D, 0x1B): Setting(0x8A, struct.pack(">3f", 2e-3, 2e-3, 2e-3)),  # gyro noise
    (0x0D, 0x1D): Setting(0x8C, struct.pack(">6f", 0, 0, 0, 1e-5, 1e-5, 1e-5)),  # gyro bias model
    AIDING: Setting(0xD0, b"\x00", key=2),  # aiding measurement on or off
    (0x0D, 0x52): Setting(0xD2, struct.pack(">BBB9fB", 0, 0, 0, *([0.0] * 9), 1)),  # initialisation
}

Address = tuple[int, int, bytes]  # descriptor set, command, key


class SettingStore:
    """What is in force and what is saved, where it differs from the factory's."""

    def __init__(self) -> None:
        self._now: dict[Address, bytes] = {}
        self._saved: dict[Address, bytes] = {}

    def get(self, command: tuple[int, int], key: bytes = b"") -> bytes:
        """Return the value in force."""
        return self._now.get((*command, key), SETTINGS[command].factory)

    def keys(self, command: tuple[int, int]) -> list[bytes]:
        """Return the keys (instances) that were ever written."""
        return sorted(key for *known, key in self._now if tuple(known) == command)

    def execute(self, command: tuple[int, int], data: bytes) -> bytes | None:
        """Do what a setting's command says.

        Args:
            command: Descriptor set and command.
            data: Function selector, key, value.

        Returns:
            Data of the reply field; None: there is none.

        Raises:
            ValueError: A wrong function selector or length.
        """
        setting = SETTINGS[command]
        function, key, value = data[0], data[1 : 1 + setting.key], data[1 + setting.key :]
        if len(key) != setting.key or function not in (WRITE, READ, SAVE, LOAD, DEFAULT):
            raise ValueError("key or function")
        address = (*command, key)
        if function == WRITE:
            least, most = len(setting.factory), setting.longest or len(setting.factory)
            if not least <= len(value) <= most:
                raise ValueError("length")
            self._now[address] = value
        elif function == READ:
            return key + self.get(command, key)
        elif function == SAVE:
            self._saved[address] = self.get(command, key)
        elif function == LOAD:
            self._now[address] = self._saved.get(address, setting.factory)
        else:
            self._now[address] = setting.factory
        return None

    def save_all(self) -> None:
        """Keep what is in force for the next power-up."""
        self._saved = dict(self._now)

    def load_all(self) -> None:
        """Return to what is saved."""
        self._now = dict(self._saved)

    def default_all(self) -> None:
        """Return to the factory's values; what is saved stays."""
        self._now = {}
