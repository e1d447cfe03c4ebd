"""Notifies systemd (readiness, watchdog, status line) and writes events with fields to journald.

Each is one datagram, so no library is needed. Without systemd every function does nothing and returns False.
"""

from __future__ import annotations

import os
import re
import socket
import struct

_JOURNAL = "/run/systemd/journal/socket"
_FIELD = re.compile(r"[A-Z][A-Z0-9_]{0,63}")
_PRIORITIES = {"error": 3, "warning": 4, "notice": 5, "info": 6}


def ready(status_text: str = "") -> bool:
    """Tell systemd that the service has started."""
    return _notify("READY=1", status_text)


def status(text: str) -> bool:
    """Set the line that `systemctl status` shows."""
    return _notify("", text)


def watchdog() -> bool:
    """Feed the watchdog; call it only while the roles are alive, never from an idle timer."""
    return _notify("WATCHDOG=1")


def stopping() -> bool:
    """Tell systemd that the service is about to end."""
    return _notify("STOPPING=1")


def event(name: str, message: str, *, level: str = "notice", **fields: str | float) -> bool:
    """Write an event that `journalctl VICAL_EVENT=name` finds.

    Args:
        name: converged, bumped, device_lost, device_back, device_replaced, ...
        message: One line for a person.
        level: error, warning, notice or info.
        **fields: Further fields; ``camera="cam0"`` becomes ``VICAL_CAMERA=cam0``.
    """
    entries = {
        "MESSAGE": message,
        "PRIORITY": str(_PRIORITIES.get(level, 5)),
        "SYSLOG_IDENTIFIER": "vical",
        "VICAL_EVENT": name,
    }
    for key, value in fields.items():
        field_name = f"VICAL_{key.upper()}"
        if _FIELD.fullmatch(field_name):
            entries[field_name] = str(value)
    data = b"".join(_field(key, value) for key, value in entries.items())
    return _send(os.environ.get("VICAL_JOURNAL_SOCKET", _JOURNAL), data)


def _field(key: str, value: str) -> bytes:
    """Encode a field; text with line breaks in the length-prefixed form, so that it cannot forge fields."""
    raw = value.encode("utf-8", "replace")
    if b"\n" not in raw:
        return key.encode() + b"=" + raw + b"\n"
    return key.encode() + b"\n" + struct.pack("<Q", len(raw)) + raw + b"\n"


def _notify(assignment: str, status_text: str = "") -> bool:
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    lines = [assignment] if assignment else []
    if status_text:
        lines.append("STATUS=" + " ".join(status_text.split())[:2000])
    if not lines:
        return False
    return _send(address, "\n".join(lines).encode())


def _send(address: str, data: bytes) -> bool:
    """Send one datagram; never raises and never waits: a full socket must not stop the caller."""
    if address.startswith("@"):
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)
            sender.sendto(data, address)
    except OSError:
        return False
    return True
