"""Command and reply in MIP: a command is sent, its acknowledgement waited for, the rest handed on."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from vical_drivers.errors import DeviceRefusedError
from vical_drivers.microstrain import mip
from vical_drivers.microstrain.port import BytePort, timeout, wait_for_silence
from vical_drivers.microstrain.record_stream import RecordStream

REPLY_TIMEOUT_S = 0.5
TRIES = 3
_UNKNOWN_COMMAND = 1


class UnknownCommandError(DeviceRefusedError):
    """NACK 1: this model has no such command; another spelling may exist."""


@dataclass(frozen=True, slots=True)
class Reply:
    """Attributes: `code` 0 or the reason of a refusal; `data` of the reply field, where there is one."""

    code: int
    data: bytes | None


class MipLink:
    """Talks to a device.

    Attributes:
        port: Stays the caller's.
        stream: What arrives.
        reply_timeout_s: How long one try waits for a reply; more for a device that samples at 1 Hz.

    Args:
        port: Open port.
        keep: Gets every packet that is not the reply waited for: samples that stream in between.
    """

    def __init__(self, port: BytePort, keep: Callable[[mip.Packet], None]) -> None:
        self.port, self._keep = port, keep
        self.stream: RecordStream[mip.Packet] = RecordStream(port, mip.Decoder)
        self.reply_timeout_s = REPLY_TIMEOUT_S

    def quiet(self) -> None:
        """Stop whatever streams and wait until it is silent."""
        self.port.write(mip.idle())
        wait_for_silence(self.port, quiet_s=0.1, limit_s=1.0)
        self.stream.restart()

    def command(self, descriptor_set: int, command: int, data: bytes) -> None:
        """Send a command and wait for its acknowledgement."""
        self.transact(descriptor_set, command, data)

    def ask(
        self, descriptor_set: int, command: int, reply: int, data: bytes = b"", size: int | None = None
    ) -> bytes:
        """Send a command and return the data of its reply field."""
        found = self.transact(descriptor_set, command, data, reply=reply).data
        if found is None or (size is not None and len(found) != size):
            raise DeviceRefusedError(
                f"{self.port.name}: the answer to MIP command "
                f"0x{descriptor_set:02X},0x{command:02X} lacks its data"
            )
        return found

    def transact(
        self, descriptor_set: int, command: int, data: bytes, *,
        reply: int | None = None, also: tuple[int, int] | None = None,
        timeout_s: float | None = None, tries: int = TRIES,
    ) -> Reply:  # fmt: skip
        """Send a command and return its reply.

        Args:
            descriptor_set: Set of command and reply.
            command: Descriptor of the command.
            data: Its data.
            reply: Descriptor of the field that carries the answer; None: the ACK is all.
            also: Set and descriptor of data that come in a packet of their own.
            timeout_s: For one try.
            tries: How often to send it.

        Raises:
            DeviceRefusedError: A refusal, with its reason.
            DeviceTimeoutError: No answer.
        """
        for _ in range(tries):
            self.port.write(mip.encode(descriptor_set, (command, data)))
            deadline = time.monotonic() + (timeout_s or self.reply_timeout_s)
            while (left := deadline - time.monotonic()) > 0:
                for packet in self.stream.receive(left):
                    if also and packet.descriptor_set == also[0] and packet.field(also[1]) is not None:
                        return Reply(0, packet.field(also[1]))
                    if (answer := _answer(packet, descriptor_set, command, reply)) is None:
                        self._keep(packet)
                        continue
                    self._raise_refusal(answer.code, descriptor_set, command)
                    if not also:
                        return answer
        raise timeout(self.port, f"MIP command 0x{descriptor_set:02X},0x{command:02X}")

    def _raise_refusal(self, code: int, descriptor_set: int, command: int) -> None:
        if code:
            reason = mip.NACK_REASONS.get(code, f"reason {code}")
            kind = UnknownCommandError if code == _UNKNOWN_COMMAND else DeviceRefusedError
            raise kind(
                f"{self.port.name}: the device refused MIP command "
                f"0x{descriptor_set:02X},0x{command:02X}: {reason}"
            )


def _answer(packet: mip.Packet, descriptor_set: int, command: int, reply: int | None) -> Reply | None:
    """The reply to a command in a packet; some models send ACK and data in two packets."""
    if packet.descriptor_set != descriptor_set:
        return None
    for descriptor, data in packet.fields:
        if descriptor == mip.ACK and len(data) == 2 and data[0] == command:
            found = packet.field(reply) if reply is not None else None
            if data[1] == 0 and reply is not None and found is None:
                return None
            return Reply(data[1], found)
    if reply is not None and (found := packet.field(reply)) is not None:
        return Reply(0, found)
    return None
