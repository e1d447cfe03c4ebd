"""Which devices are there, by what the acquiring roles say of them in their status. No I/O."""

from __future__ import annotations

from vical_daemon.bus.messages import DiagnosticStatus

CONFIRMED = 3
"""A device was replaced when its status says so this often in a row: a damaged message says it once."""
LIMIT = 64
"""Components that are kept; whoever invents names must not fill the memory."""


class DeviceSerials:
    """Serial numbers by component, e.g. ``imu/imu0``; a replaced device is told from a damaged message."""

    def __init__(self) -> None:
        self.known: dict[str, str] = {}
        self._others: dict[str, tuple[str, int]] = {}  # component -> another one, times in a row

    def note(self, status: DiagnosticStatus) -> None:
        """Take the status of one component; one without a serial number says nothing."""
        name, serial = status.name, status.hardware_id
        if not serial or (name not in self.known and len(self.known) >= LIMIT):
            return
        if self.known.setdefault(name, serial) == serial:
            self._others.pop(name, None)
            return
        other, times = self._others.get(name, (serial, 0))
        self._others[name] = (serial, times + 1 if other == serial else 1)

    @property
    def in_doubt(self) -> bool:
        """Whether some device may have been replaced."""
        return bool(self._others)

    @property
    def replaced(self) -> dict[str, str]:
        """Components with another device than the known one, and its serial number."""
        return {name: serial for name, (serial, times) in self._others.items() if times >= CONFIRMED}

    def adopt(self) -> list[str]:
        """Make the devices that are there now the known ones; returns what changed, a line each."""
        lines = [
            f"{name} is another device now (serial {serial}, not {self.known[name]})"
            for name, serial in self.replaced.items()
        ]
        self.known.update(self.replaced)
        self._others.clear()
        return lines
