"""Find out what sits on a port: protocol and baud, also of a device that streams or was left elsewhere."""

from __future__ import annotations

import logging

from vical_drivers.errors import DeviceNotFoundError
from vical_drivers.microstrain import mip
from vical_drivers.microstrain import single_byte_commands as cmd
from vical_drivers.microstrain.mip_session import MipSession
from vical_drivers.microstrain.port import SerialPort, wait_for_silence
from vical_drivers.microstrain.single_byte_session import SingleByteSession

_log = logging.getLogger(__name__)
PROTOCOLS = ("auto", "single-byte", "mip")
PROBE_BAUDS = (115_200, 921_600, 460_800, 230_400)
"""Factory setting first, then the temporary ones a crashed program may have left."""
_ANSWER_S = 0.25
_SLOW_ANSWER_S = 1.2
"""A GX3 sampling at 1 Hz takes commands once a second: the second round waits for it."""
_QUIET_S = 0.06
_STOP_LIMIT_S = 0.25
"""A stream at the right baud stops within a sampling cycle; noise at a wrong one never does."""


def connect(
    path: str, protocol: str = "auto", link: str = "auto", baud: int | None = None, *, patient: bool = True
) -> tuple[MipSession | SingleByteSession, SerialPort]:
    """Open a port and find the device on it; its stream is stopped.

    Takes 0.4 s where the device is as expected, and at most about 10 s where nothing answers (4 s with
    `patient` off).

    Raises:
        DeviceNotFoundError: Nothing there answers in a known protocol at a known baud.
        DriverError: The port cannot be opened.
    """
    bauds = [*([baud] if baud else []), *(b for b in PROBE_BAUDS if b != baud)]
    port = SerialPort(path, PROBE_BAUDS[0], link=link)
    try:
        if (session := probe_port(port, protocol, bauds, rounds=1 + patient)) is not None:
            return session, port
    except BaseException:
        port.close()
        raise
    port.close()
    raise DeviceNotFoundError(
        f"{path}: no MicroStrain sensor answers here at {', '.join(map(str, bauds))} baud; "
        "check power and cable, or name another port (`vical devices` lists them)"
    )


def probe_port(
    port: SerialPort,
    protocol: str = "auto",
    bauds: list[int] | tuple[int, ...] = PROBE_BAUDS,
    rounds: int = 2,
) -> MipSession | SingleByteSession | None:
    """Try the protocols at each baud, then once more patiently; None where nothing answers."""
    for answer_s in (_ANSWER_S, _SLOW_ANSWER_S)[:rounds]:
        for baud in bauds:
            if baud != port.baud:
                port.set_baud(baud)
            if (session := _answering(port, protocol, answer_s)) is not None:
                _log.debug("port=%s baud=%d protocol=%s", port.name, baud, session.protocol)
                return session
    return None


def _answering(port: SerialPort, protocol: str, answer_s: float) -> MipSession | SingleByteSession | None:
    """The session that answers at the port's present baud.

    First both stop commands: each protocol takes the other's as noise, and a stream would drown replies. MIP
    is asked before single-byte because a MIP unit may also know E9, whereas 0x75 is nothing to an old GX3.
    """
    silent = False
    for _ in range(2):
        port.write(cmd.STOP_STREAM + mip.idle())
        silent = wait_for_silence(port, _QUIET_S, _STOP_LIMIT_S)
    if not silent and answer_s < _SLOW_ANSWER_S:
        return None
    kinds: list[type[MipSession] | type[SingleByteSession]] = [MipSession, SingleByteSession]
    for kind in kinds:
        if protocol in ("auto", kind.protocol):
            session = kind(port)
            # MIP commands do not wait for the sampling cycle, so they need no patience.
            if session.probe(answer_s if kind is SingleByteSession else _ANSWER_S):
                return session
    return None
