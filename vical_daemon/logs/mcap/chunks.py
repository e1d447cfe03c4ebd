"""Unpacks chunks of MCAP files, also damaged or hostile ones: the sizes that they state are not trusted."""

from __future__ import annotations

import struct
import zlib

CHUNK_LIMIT = 256 * 2**20
_PIECE = 2**20
_SHRINKS = 1000
"""Times. lz4 shrinks by 255 at most, zstd by more only where nothing happens in picture and samples."""
_RECORD_COST = 2**12
"""Bytes that are unpacked in the time that one record takes: 2 us at 2 GB/s (measured: 1 to 3 us)."""
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name


class SpentError(Exception):
    """A file unpacks to more than a recording of its size can; the message completes a sentence about it."""


class Budget:
    """Limits what is unpacked from one file to a multiple of its size, so that reading ends.

    Args:
        file_bytes: Size of the file.
    """

    def __init__(self, file_bytes: int) -> None:
        self._file_bytes = file_bytes
        self._unpacked = 0
        self._left = CHUNK_LIMIT + _SHRINKS * file_bytes

    def spend(self, unpacked: int) -> None:
        """Count one record, or a piece of a chunk.

        Args:
            unpacked: Bytes that came out of a chunk; 0: it is a record that is looked at.

        Raises:
            SpentError: The limit is exceeded.
        """
        self._unpacked += unpacked
        self._left -= unpacked or _RECORD_COST
        if self._left < 0:
            raise SpentError(
                f"stopped after {self._unpacked / 1e6:.0f} MB were unpacked from a file of "
                f"{self._file_bytes / 1e6:.1f} MB: this is no recording, or it was made to do harm; "
                "what came before is used"
            )


def unpack_chunk(content: bytes, budget: Budget, *, whole: bool = True) -> bytes:
    """Return the records of a chunk.

    Args:
        content: The chunk record.
        budget: Limit of this file.
        whole: Checksum and sizes must be right; False: the chunk was never finished, give what unpacks.

    Raises:
        ValueError: It is damaged or too large.
        SpentError: All chunks of the file together are too large.
    """
    _, _, size, crc, name_length = _CHUNK.unpack_from(content)
    begin = _CHUNK.size + name_length
    compression = content[_CHUNK.size : begin]
    length = struct.unpack_from("<Q", content, begin)[0]
    packed = memoryview(content)[begin + 8 :]
    if whole and (length > len(packed) or size > CHUNK_LIMIT):
        raise ValueError("chunk with impossible sizes")
    data = _decompress(compression, packed[:length], size if whole else CHUNK_LIMIT)
    budget.spend(len(data))
    if whole and (len(data) != size or (crc and zlib.crc32(data) != crc)):
        raise ValueError("chunk that does not match its checksum")
    return data


def _decompress(compression: bytes, packed: memoryview, limit: int) -> bytes:
    if not compression:
        return bytes(packed[:limit])
    if compression == b"lz4":
        return decompress_lz4(packed, limit)
    if compression == b"zstd":
        return _decompress_zstd(packed, limit)
    raise ValueError(f"chunk compression {compression!r} is not known")


def decompress_lz4(packed: memoryview, limit: int) -> bytes:
    """Unpack at most `limit` bytes of an lz4 frame, piece by piece: lz4 would reserve it at once."""
    import lz4.frame

    unpacker = lz4.frame.LZ4FrameDecompressor()
    first = min(_PIECE, max(65536, 2 * len(packed)), limit)
    pieces = [unpacker.decompress(packed, max_length=first)]
    total = len(pieces[0])
    while total < limit and not unpacker.eof and not unpacker.needs_input:
        piece = unpacker.decompress(b"", max_length=min(_PIECE, limit - total))
        if not piece:
            break
        pieces.append(piece)
        total += len(piece)
    return b"".join(pieces)


def _decompress_zstd(packed: memoryview, limit: int) -> bytes:
    """Unpack piece by piece: the size that a frame states is not trusted."""
    import zstandard

    pieces: list[bytes] = []
    total = 0
    with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(packed) as reader:
        while total < limit:
            try:
                piece = reader.read(min(_PIECE, limit - total))
            except zstandard.ZstdError:
                if pieces:
                    break  # a chunk without its end: keep what came out; the caller compares sizes
                raise ValueError("chunk that does not unpack") from None
            if not piece:
                break
            pieces.append(piece)
            total += len(piece)
    return b"".join(pieces)
