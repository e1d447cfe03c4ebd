"""CDR, the byte layout of ROS 2 messages: little endian, every number aligned to its own size.

Offsets count from behind the 4-byte encapsulation header. Writing and reading are plain arithmetic on
bytes. For any bytes, a reader returns values that lie inside them or raises `MessageError`, and never
allocates more than the bytes could hold.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
PADDING = 3  # bytes at most: CDR fills a message up to a multiple of 4
_U32 = struct.Struct("<I")
_STAMP = struct.Struct("<iI")
_NS_PER_S = 1_000_000_000


class MessageError(ValueError):
    """Bytes that are not a message of the expected type, or values that do not fit into one."""


class CdrWriter:
    """Appends values with CDR alignment; `finish` returns the message."""

    __slots__ = ("_data",)

    def __init__(self) -> None:
        self._data = bytearray(LITTLE_ENDIAN)

    def align(self, size: int) -> None:
        """Pad with zeros to a multiple of `size` (4 bytes of encapsulation header do not count)."""
        self._data += bytes(-(len(self._data) - 4) % size)

    def scalar(self, code: str, value: float) -> None:
        """Append one number; `code` as in `struct`, e.g. ``B``, ``I``, ``q``, ``d``."""
        packer = struct.Struct("<" + code)
        self.align(packer.size)
        try:
            self._data += packer.pack(value)
        except struct.error as error:
            raise MessageError(f"{value!r} does not fit into a field of type '{code}': {error}") from None

    def stamp(self, stamp_ns: int) -> None:
        """Append a builtin_interfaces/Time."""
        seconds, nanoseconds = divmod(stamp_ns, _NS_PER_S)
        self.align(4)
        try:
            self._data += _STAMP.pack(seconds, nanoseconds)
        except struct.error:
            raise MessageError(f"stamp {stamp_ns} ns is outside of what ROS 2 can express") from None

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a std_msgs/Header."""
        self.stamp(stamp_ns)
        self.string(frame_id)

    def string(self, text: str) -> None:
        """Append a string with its length and closing NUL."""
        raw = text.encode()
        self.align(4)
        self._data += _U32.pack(len(raw) + 1)
        self._data += raw
        self._data += b"\0"

    def strings(self, texts: list[str]) -> None:
        """Append a sequence of strings."""
        self.scalar("I", len(texts))
        for text in texts:
            self.string(text)

    def fixed(self, values: npt.ArrayLike, dtype: str = "<f8") -> None:
        """Append an array of fixed length (the length is not written)."""
        array = np.ascontiguousarray(values, dtype=dtype)
        if array.size:
            self.align(array.itemsize)
            self._data += array.tobytes()

    def sequence(self, values: npt.ArrayLike, dtype: str = "<f8") -> None:
        """Append an array of variable length, its length first."""
        array = np.ascontiguousarray(values, dtype=dtype)
        self.scalar("I", array.size)
        self.fixed(array, dtype)

    def blob(self, data: bytes | memoryview) -> None:
        """Append a ``uint8[]``."""
        self.scalar("I", len(data))
        self._data += data

    def finish(self) -> bytes:
        """Return the message."""
        return bytes(self._data)


class CdrReader:
    """Reads values from bytes in order; raises `MessageError` if the bytes end or are invalid."""

    __slots__ = ("_data", "_end", "_position")

    def __init__(self, data: bytes) -> None:
        if data[:2] != LITTLE_ENDIAN[:2] or len(data) < len(LITTLE_ENDIAN):
            raise MessageError("not a little-endian CDR message (its first bytes should be 00 01)")
        self._data = data
        self._position = 4
        self._end = len(data)

    @property
    def remaining(self) -> int:
        """Bytes that have not been read."""
        return self._end - self._position

    def skip(self, size: int, alignment: int) -> int:
        """Pass over `size` bytes and return where they begin, for the caller to unpack."""
        begin = self._position + (-(self._position - 4) % alignment)
        if size > self._end - begin:
            raise MessageError(
                f"message ends too early: {size} bytes wanted at offset {begin} of {self._end}"
            )
        self._position = begin + size
        return begin

    def scalar(self, code: str) -> Any:
        """Read one number; `code` as in `struct`."""
        size = struct.calcsize("<" + code)
        return struct.unpack_from("<" + code, self._data, self.skip(size, size))[0]

    def stamp(self) -> int:
        """Read a builtin_interfaces/Time as ns."""
        seconds, nanoseconds = _STAMP.unpack_from(self._data, self.skip(8, 4))
        if nanoseconds >= _NS_PER_S:
            raise MessageError(f"stamp with {nanoseconds} ns beyond its second")
        stamp_ns: int = seconds * _NS_PER_S + nanoseconds
        return stamp_ns

    def header(self) -> tuple[int, str]:
        """Read a std_msgs/Header: (stamp_ns, frame_id)."""
        return self.stamp(), self.string()

    def string(self) -> str:
        """Read a string."""
        length = _U32.unpack_from(self._data, self.skip(4, 4))[0]
        begin = self.skip(length, 1)
        raw = self._data[begin : begin + length]
        if not length or raw[-1]:
            raise MessageError("string without its closing NUL")
        try:
            return str(raw[:-1], "utf-8")
        except UnicodeDecodeError:
            raise MessageError("string that is not UTF-8") from None

    def count(self, smallest_item: int) -> int:
        """Read the length of a sequence whose items take at least `smallest_item` bytes each."""
        number: int = self.scalar("I")
        if number * smallest_item > self.remaining:
            raise MessageError(f"sequence of {number} items in a message with {self.remaining} bytes left")
        return number

    def strings(self) -> list[str]:
        """Read a sequence of strings."""
        return [self.string() for _ in range(self.count(4))]

    def fixed(self, count: int, dtype: str = "<f8") -> npt.NDArray[Any]:
        """Read `count` numbers; a read-only view of the message."""
        if not count:
            return np.empty(0, dtype)
        size = np.dtype(dtype).itemsize
        return np.frombuffer(self._data, dtype, count, self.skip(count * size, size))

    def sequence(self, dtype: str = "<f8") -> npt.NDArray[Any]:
        """Read an array of variable length; a read-only view of the message."""
        return self.fixed(self.count(np.dtype(dtype).itemsize), dtype)

    def blob(self) -> memoryview:
        """Read a ``uint8[]``; a view of the message."""
        length = self.count(1)
        begin = self.skip(length, 1)
        return memoryview(self._data)[begin : begin + length]

    def end(self) -> None:
        """Raise unless the message ends here; other readers, such as rosbags, check this too."""
        if self.remaining > PADDING:
            raise MessageError(f"message goes on for {self.remaining} bytes behind its last field")
