"""Find out what sits on a port: protocol and baud, also of a device that streams or was left elsewhere."""

from __future__ import annotations

import logging

from vical_drivers.errors import DeviceNotFoundError
from vical_drivers.microstrain.port import SerialPort
from vical_drivers.microstrain.session import Session
from vical_drivers.microstrain.single_byte_session import SingleByteSession

_log = logging.getLogger(__name__)
PROTOCOLS = ("auto", "single-byte", "mip")
PROBE_BAUDS = (115_200, 921_600, 460_800, 230_400)
"""Factory setting first, then the temporary ones a crashed program may have left."""
_ANSWER_S = 0.3


def connect(
    path: str, protocol: str = "auto", link: str = "auto", baud: int | None = None
) -> tuple[Session, SerialPort]:
    """Open a port and find the device on it; its stream is stopped.

    Raises:
        DeviceNotFoundError: Nothing there answers in a known protocol at a known baud.
        DriverError: The port cannot be opened.
    """
    bauds = [*([baud] if baud else []), *(b for b in PROBE_BAUDS if b != baud)]
    port = SerialPort(path, PROBE_BAUDS[0], link=link)
    try:
        for candidate in bauds:
            if candidate != port.baud:
                port.set_baud(candidate)
            session = _answering(port, protocol)
            if session is not None:
                return session, port
    except BaseException:
        port.close()
        raise
    port.close()
    raise DeviceNotFoundError(
        f"{path}: no MicroStrain sensor answers here at {', '.join(map(str, bauds))} baud; "
        "check power and cable, or name another port (`vical devices` lists them)"
    )


def _answering(port: SerialPort, protocol: str) -> Session | None:
    if protocol in ("auto", "single-byte"):
        session = SingleByteSession(port)
        session.quiet()
        if session.probe(_ANSWER_S):
            return session
    return None
