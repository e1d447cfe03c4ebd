"""Serial numbers of the devices, from the status of the acquiring roles. No I/O."""

from __future__ import annotations

from vical_daemon.bus.messages import DiagnosticStatus

CONFIRMED = 3
"""Statuses in a row that confirm a replaced device; a damaged message shows another serial number once."""
LIMIT = 64
"""Components kept, so that invented names do not fill memory."""


class DeviceSerials:
    """Serial numbers by component, e.g. ``imu/imu0``; one damaged message does not replace a device."""

    def __init__(self) -> None:
        self.known: dict[str, str] = {}
        self._others: dict[str, tuple[str, int]] = {}  # component -> another one, times in a row

    def note(self, status: DiagnosticStatus) -> None:
        """Take the status of one component; ignored without a serial number."""
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
        """Whether a device may have been replaced."""
        return bool(self._others)

    @property
    def replaced(self) -> dict[str, str]:
        """Components whose device was replaced, with the new serial number."""
        return {name: serial for name, (serial, times) in self._others.items() if times >= CONFIRMED}

    def adopt(self) -> list[str]:
        """Accept the present devices as the known ones; returns one line per change."""
        lines = [
            f"{name} is another device now (serial {serial}, not {self.known[name]})"
            for name, serial in self.replaced.items()
        ]
        self.known.update(self.replaced)
        self._others.clear()
        return lines
