"""What the decoders of both protocols have in common: buffering, and counters of what was lost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, TypeVar

T = TypeVar("T")


class StreamDecoder(ABC, Generic[T]):
    """Incremental decoder: any chunking of a stream gives the same messages.

    Attributes:
        checksum_errors: Messages lost to damage: one began where it was due, and its checksum was wrong.
        skipped_bytes: Bytes that belong to no message.
        records: Number of messages returned so far.
    """

    def __init__(self) -> None:
        self.checksum_errors = 0
        self.skipped_bytes = 0
        self.records = 0
        self._tail = b""
        self._consumed = 0
        # A capture may begin inside a message: that is no damage.
        self._in_step = False

    @property
    def pending(self) -> bytes:
        """The bytes that wait for the rest of a message, at most `MAX_LENGTH` - 1."""
        return self._tail

    @property
    def offset(self) -> int:
        """Number of stream bytes fed so far."""
        return self._consumed + len(self._tail)

    def feed(self, data: bytes) -> list[T]:
        """Take the next bytes of the stream and return the messages they complete, in order."""
        return self._parse(self._tail + data if self._tail else data, waiting=True)

    def finish(self) -> list[T]:
        """Return the messages hidden behind an incomplete one; call it at the end or after a silence.

        What stays in `pending` is a partial message with nothing good behind its beginning.
        """
        return self._parse(self._tail, waiting=False)

    @abstractmethod
    def _parse(self, buffer: bytes, *, waiting: bool) -> list[T]:
        """Return the messages in a buffer; `waiting`: more bytes may complete the last one."""

    def _keep(self, buffer: bytes, position: int, out: list[T], good_bytes: int) -> list[T]:
        """Keep what lies behind `position`; `good_bytes` of what lies before belong to messages."""
        self._tail = buffer[position:]
        self._consumed += position
        self.records += len(out)
        self.skipped_bytes += position - good_bytes
        return out
