"""Bytes of a port as dated records: what both protocols have in common on the receiving side."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from vical_drivers.microstrain.port import ArrivalLog, BytePort

R = TypeVar("R")


class RecordDecoder(Protocol[R]):
    """An incremental decoder, see `single_byte.Decoder` and `mip.Decoder`."""

    checksum_errors: int
    skipped_bytes: int

    def feed(self, data: bytes) -> list[R]:
        """Take bytes and return the records that they complete."""
        ...

    def finish(self) -> list[R]:
        """Return the records hidden behind an incomplete one."""
        ...


class RecordStream(Generic[R]):
    """Reads a port and returns records; each can be dated by its last byte.

    Args:
        port: Stays the caller's.
        make_decoder: For a stream that begins anew.
    """

    def __init__(self, port: BytePort, make_decoder: Callable[[], RecordDecoder[R]]) -> None:
        self._port, self._make_decoder = port, make_decoder
        self._decoder = make_decoder()
        self._arrivals = ArrivalLog()

    @property
    def checksum_errors(self) -> int:
        """Damaged records."""
        return self._decoder.checksum_errors

    @property
    def skipped_bytes(self) -> int:
        """Bytes that belong to no record."""
        return self._decoder.skipped_bytes

    def receive(self, timeout_s: float) -> list[R]:
        """Return what arrived; [] after the timeout, and [] for part of a record."""
        data, t_read_ns = self._port.read(timeout_s)
        if not data:  # a silence: what looked like the beginning of a long record may hide a short one
            return self._decoder.finish()
        self._arrivals.add(len(data), t_read_ns)
        return self._decoder.feed(data)

    def arrival_ns(self, end: int) -> int:
        """CLOCK_MONOTONIC of the byte that ends at stream offset `end`, ns; offsets must not decrease."""
        arrivals = self._arrivals
        if end == arrivals.end:  # nearly always a record ends with its read
            return arrivals.t_read_ns
        return self._arrivals.arrival_ns(end, self._port.wire_byte_ns)

    def restart(self) -> None:
        """Forget what is in flight; the count of damaged records goes on."""
        errors, self._decoder = self._decoder.checksum_errors, self._make_decoder()
        self._decoder.checksum_errors = errors
        self._arrivals = ArrivalLog()
