"""Packets, fields and acknowledgements of MIP as the emulated device writes them."""

from __future__ import annotations

ACK_OK, UNKNOWN, INVALID = 0, 1, 3
"""What a command is answered with: done, unknown command, invalid parameter."""


def packet(descriptor_set: int, *fields: bytes) -> bytes:
    """Frame fields: sync, set, length, payload, two 8-bit running sums."""
    payload = b"".join(fields)
    body = bytearray([0x75, 0x65, descriptor_set, len(payload)]) + payload
    first = second = 0
    for value in body:
        first = (first + value) % 256
        second = (second + first) % 256
    return bytes(body) + bytes([first, second])


def field(descriptor: int, data: bytes = b"") -> bytes:
    """One field: its length (both header bytes counted), descriptor, data."""
    return bytes([len(data) + 2, descriptor]) + data


def split(payload: bytes) -> list[bytes]:
    """The fields of a packet's payload, headers included."""
    fields, at = [], 0
    while at < len(payload) and payload[at] >= 2:
        fields.append(payload[at : at + payload[at]])
        at += payload[at]
    return fields


def ack(command: int, code: int = ACK_OK) -> bytes:
    """The field that accepts or refuses a command."""
    return bytes([0x04, 0xF1, command, code])
