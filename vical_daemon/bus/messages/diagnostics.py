"""diagnostic_msgs/DiagnosticArray (status of a role) and std_msgs/String (commands)."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from vical_daemon.bus.messages.cdr import CdrReader, CdrWriter, MessageError

DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
STRING_TYPE = "std_msgs/msg/String"


class Level(IntEnum):
    """Health of a component; numbers as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """Health of one component.

    Attributes:
        level: Its health.
        name: Component, e.g. ``imu/imu0``.
        message: One line for a person.
        hardware_id: Serial number of the device, "" where there is none.
        values: Counters and figures, units in the key: ``rate_hz``.
    """

    level: Level
    name: str
    message: str = ""
    hardware_id: str = ""
    values: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DiagnosticsMessage:
    """The status of one role at one moment; `frame_id` names the role."""

    stamp_ns: int
    frame_id: str
    statuses: tuple[DiagnosticStatus, ...]


def encode_diagnostics(stamp_ns: int, role: str, statuses: list[DiagnosticStatus]) -> bytes:
    """Build a diagnostic_msgs/DiagnosticArray; `role` becomes the frame id."""
    writer = CdrWriter()
    writer.header(stamp_ns, role)
    writer.scalar("I", len(statuses))
    for status in statuses:
        writer.scalar("B", int(status.level))
        writer.string(status.name)
        writer.string(status.message)
        writer.string(status.hardware_id)
        writer.scalar("I", len(status.values))
        for key, value in status.values.items():
            writer.string(key)
            writer.string(str(value))
    return writer.finish()


def decode_diagnostics(data: bytes) -> DiagnosticsMessage:
    """Read a diagnostic_msgs/DiagnosticArray.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    stamp_ns, role = reader.header()
    statuses = tuple(_decode_status(reader) for _ in range(reader.count(17)))
    reader.end()
    return DiagnosticsMessage(stamp_ns, role, statuses)


def _decode_status(reader: CdrReader) -> DiagnosticStatus:
    level = reader.scalar("B")
    if level > Level.STALE:
        raise MessageError(f"diagnostic level {level} does not exist")
    name, message, hardware_id = reader.string(), reader.string(), reader.string()
    values = {reader.string(): reader.string() for _ in range(reader.count(8))}
    return DiagnosticStatus(Level(level), name, message, hardware_id, values)


def encode_string(text: str) -> bytes:
    """Build a std_msgs/String."""
    writer = CdrWriter()
    writer.string(text)
    return writer.finish()


def decode_string(data: bytes) -> str:
    """Read a std_msgs/String.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    text = reader.string()
    reader.end()
    return text
