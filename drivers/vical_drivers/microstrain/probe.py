"""Find out what sits on a port: protocol and baud, also of a device that streams or was left elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from vical_drivers.errors import DeviceNotFoundError
from vical_drivers.microstrain import mip
from vical_drivers.microstrain import single_byte as sb
from vical_drivers.microstrain import single_byte_commands as cmd
from vical_drivers.microstrain.mip_session import MipSession
from vical_drivers.microstrain.port import SerialPort, wait_for_silence
from vical_drivers.microstrain.single_byte_session import SingleByteSession

_log = logging.getLogger(__name__)
PROTOCOLS = ("auto", "single-byte", "mip")
PROBE_BAUDS = (115_200, 921_600, 460_800, 230_400)
"""Factory setting first, then the temporary ones a crashed program may have left."""
_ANSWER_S = 0.35
_SLOW_ANSWER_S = 2.5
"""A GX3 sampling at 1 Hz takes one command a second: the stop, then the question."""
_QUIET_S = 0.06
_STOP_LIMIT_S = 0.25
"""A stream at the right baud stops within a sampling cycle; noise at a wrong one never does."""
_MIP_FIRMWARE = 2000
_Found = MipSession | SingleByteSession


def connect(
    path: str,
    protocol: str = "auto",
    link: str = "auto",
    baud: int | None = None,
    *,
    patient: bool = True,
    bauds: Sequence[int] | None = None,
    advice: str = "check power and cable, or name another port (`vical devices` lists them)",
) -> tuple[_Found, SerialPort]:
    """Open a port and find the device on it; its stream is stopped.

    Takes about half a second where the device is as expected, and at most about 9 s where nothing answers:
    4 s with `patient` off, or 0.9 s for each of `bauds` (0.4 s where the protocol is given).

    Args:
        path: Of the port.
        protocol: One of PROTOCOLS.
        link: See `SerialPort`.
        baud: Tried first; None: the factory's.
        patient: Wait for a device that samples at 1 Hz, and for one that is just being powered up.
        bauds: To be tried, and no others; None: all that are known.
        advice: What the message tells to do where nothing answers.

    Raises:
        DeviceNotFoundError: Nothing there answers in a known protocol at a known baud.
        DriverError: The port cannot be opened.
    """
    if bauds is None:
        bauds = [*([baud] if baud else []), *(b for b in PROBE_BAUDS if b != baud)]
        if patient:  # the likeliest again and again: it may be powered up while the others are tried
            bauds = [b for other in bauds[1:] for b in (bauds[0], other)]
    port = SerialPort(path, PROBE_BAUDS[0], link=link)
    try:
        if (session := probe_port(port, protocol, bauds, patient=patient)) is not None:
            return session, port
    except BaseException:
        port.close()
        raise
    port.close()
    what = "MicroStrain sensor" if protocol == "auto" else f"MicroStrain sensor that speaks {protocol}"
    raise DeviceNotFoundError(
        f"{path}: no {what} answers here at {', '.join(map(str, dict.fromkeys(bauds)))} baud; {advice}"
    )


def probe_port(
    port: SerialPort, protocol: str = "auto", bauds: Sequence[int] = PROBE_BAUDS, *, patient: bool = True
) -> _Found | None:
    """Try the protocols at each baud, then the likeliest baud patiently; None where nothing answers."""
    tries = [(baud, _ANSWER_S) for baud in bauds] + ([(bauds[0], _SLOW_ANSWER_S)] if patient else [])
    for baud, answer_s in tries:
        if baud != port.baud:
            port.set_baud(baud)
        if (session := _answering(port, protocol, answer_s)) is not None:
            _log.debug("port=%s baud=%d protocol=%s", port.name, baud, session.protocol)
            return session
    return None


def _answering(port: SerialPort, protocol: str, answer_s: float) -> _Found | None:
    """The session that answers at the port's present baud.

    Streams are stopped first: they would drown replies. Single-byte comes first, because the bytes of MIP's
    commands mean something to an old GX3 (it would answer them, at one command per sampling cycle), while a
    MIP unit takes the three bytes of the other stop for noise.
    """
    heard = None
    if protocol != "mip":
        silent = _hush(port, cmd.STOP_STREAM) or _hush(port, cmd.STOP_STREAM)
        if silent or answer_s == _SLOW_ANSWER_S:
            heard = _ask(port, cmd.GET_FIRMWARE, answer_s)
    if heard in (None, "both") and protocol != "single-byte":
        silent = _hush(port, mip.idle()) or _hush(port, mip.idle())
        if silent or answer_s == _SLOW_ANSWER_S:
            heard = _ask(port, mip.ping(), _ANSWER_S) or heard
    if heard is None:
        return None
    session: _Found = MipSession(port) if heard == "mip" else SingleByteSession(port)
    if protocol not in ("auto", session.protocol):
        return None
    if not session.probe(_ANSWER_S):
        # It answers an earlier question: a slow one, with more to say. Let it finish.
        wait_for_silence(port, 1.2, 8.0)
        session.reply_timeout_s = _SLOW_ANSWER_S
    return session


def _hush(port: SerialPort, stop: bytes) -> bool:
    port.write(stop)
    return wait_for_silence(port, _QUIET_S, _STOP_LIMIT_S)


def _ask(port: SerialPort, question: bytes, timeout_s: float) -> str | None:
    """Ask and listen for either protocol: "mip", "single-byte", or "both" where the firmware may know MIP."""
    port.write(question)
    old, new = sb.Decoder(), mip.Decoder()
    deadline_s = time.monotonic() + timeout_s
    while (left_s := deadline_s - time.monotonic()) > 0:
        data, _ = port.read(left_s)
        if any(p.descriptor_set == mip.SET_BASE and p.field(mip.ACK) for p in new.feed(data)):
            return "mip"
        for record in old.feed(data):
            if record.kind == _FIRMWARE_REPLY:
                return "both" if record.values[0] >= _MIP_FIRMWARE else "single-byte"
    return None


_FIRMWARE_REPLY = 0xE9
