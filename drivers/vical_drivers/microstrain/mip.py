"""The MIP protocol (GX3 from firmware 2.0, GX4, GX5, CV5, CV7): bytes to packets and back. No I/O.

Theory of operation. ``75 65 | descriptor set | payload length | fields | Fletcher-16``; a field is
``length | descriptor | data``, its length counting itself and the descriptor. The sync word also occurs in
data, so a candidate must have consistent field lengths and the right checksum; after a failure the decoder
resumes at the byte after the bad 0x75. A candidate whose first fields already contradict its length is given
up at once, without waiting for up to 261 bytes that may take a while.

What the fields mean is in `mip_fields`.
"""

from __future__ import annotations

import struct
from itertools import accumulate
from typing import NamedTuple

import msgspec

from vical_drivers.microstrain.stream_decoder import StreamDecoder

SYNC = b"\x75\x65"
SET_BASE, SET_3DM = 0x01, 0x0C
"""Command sets; replies come in the same set."""
SET_SENSOR = 0x80
"""Data set of the inertial sensor."""
ACK = 0xF1
"""Descriptor of the field that acknowledges a command: its descriptor, then 0 or a reason."""
APPLY, READ = 1, 2
"""Function selectors of settings. 3, save, writes the EEPROM: the driver itself never sends it."""
MAX_LENGTH = 261
NACK_REASONS = {
    1: "unknown command",
    2: "bad checksum",
    3: "invalid parameter",
    4: "command failed",
    5: "device timeout",
}


class Field(NamedTuple):
    """One field: descriptor and raw data; the decoder returns it as a plain tuple."""

    descriptor: int
    data: bytes


class Packet(msgspec.Struct, frozen=True, gc=False):
    """One packet whose checksum and field lengths were right.

    Attributes:
        descriptor_set: What kind of packet; 0x80 is inertial data.
        fields: Its fields in order, each (descriptor, data).
        end: Number of stream bytes up to and including its last one; dates the packet.
    """

    descriptor_set: int
    fields: tuple[tuple[int, bytes], ...]
    end: int = 0

    def field(self, descriptor: int) -> bytes | None:
        """Data of the first field with this descriptor, None where there is none."""
        for found, data in self.fields:
            if found == descriptor:
                return data
        return None


def fletcher(data: bytes) -> int:
    """Fletcher-16 with 8-bit sums: the running sum, then the sum of the running sums.

    >>> hex(fletcher(bytes.fromhex("756501020201")))
    '0xe0c6'
    """
    return (sum(data) & 0xFF) << 8 | sum(accumulate(data)) & 0xFF


def encode(descriptor_set: int, *fields: tuple[int, bytes]) -> bytes:
    """Make a packet; several commands of one set may share it.

    Raises:
        ValueError: The fields do not fit into one packet.
    """
    payload = b"".join(bytes((len(data) + 2, descriptor)) + data for descriptor, data in fields)
    if len(payload) > 255:
        raise ValueError(f"{len(payload)} bytes of fields do not fit into one MIP packet (255)")
    body = SYNC + bytes((descriptor_set, len(payload))) + payload
    return body + struct.pack(">H", fletcher(body))


def ping() -> bytes:
    """Is someone there? Answered by an ACK."""
    return encode(SET_BASE, (0x01, b""))


def idle() -> bytes:
    """Stop all streams."""
    return encode(SET_BASE, (0x02, b""))


class Decoder(StreamDecoder[Packet]):
    """Decoder of MIP packets."""

    def _parse(self, buffer: bytes, *, waiting: bool) -> list[Packet]:
        out: list[Packet] = []
        position, size, base = 0, len(buffer), self._consumed
        kept: int | None = None
        good_bytes = 0
        while True:
            start = buffer.find(SYNC, position)
            if start != position:
                if position == size:
                    break
                if start < 0:
                    position = size - buffer.endswith(b"\x75")
                    self._in_step = self._in_step and not position
                    break
                self._in_step = False
            end = start + 6 + buffer[start + 3] if start + 4 <= size else size + 1
            if end <= size and (fields := _fields(buffer, start, end)) is not None:
                out.append(Packet(buffer[start + 2], fields, base + end))
                good_bytes += end - start
                position, kept, self._in_step = end, None, True
                continue
            if end > size and _may_go_on(buffer, start):
                if waiting:
                    position = start
                    break
                kept = start if kept is None else kept
            else:
                self.checksum_errors += self._in_step
            self._in_step = False
            position = start + 1
        return self._keep(buffer, position if kept is None else kept, out, good_bytes)


def _fields(buffer: bytes, start: int, end: int) -> tuple[tuple[int, bytes], ...] | None:
    """Fields of the candidate packet; None where its checksum or its lengths say that it is none."""
    payload_end = end - 2
    if fletcher(buffer[start:payload_end]) != buffer[payload_end] << 8 | buffer[payload_end + 1]:
        return None
    fields = []
    at = start + 4
    while at < payload_end:
        length = buffer[at]
        if length < 2 or at + length > payload_end:
            return None
        fields.append((buffer[at + 1], buffer[at + 2 : at + length]))
        at += length
    return tuple(fields)


def _may_go_on(buffer: bytes, start: int) -> bool:
    """Tell whether an incomplete candidate may be a packet: the fields that are there fit its length."""
    size = len(buffer)
    if size < start + 4:
        return True
    payload_end = start + 4 + buffer[start + 3]
    at = start + 4
    while at < payload_end and at < size:
        length = buffer[at]
        if length < 2 or at + length > payload_end:
            return False
        at += length
    return True
