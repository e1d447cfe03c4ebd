"""Raw byte captures, as a serial sniffer or `cat` writes them: every record with its fields in SI units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from vical_drivers.errors import DriverError
from vical_drivers.microstrain import mip, mip_fields
from vical_drivers.microstrain import single_byte as sb

_CHUNK = 65_536
_SNIFFED = 16 * 1024 * 1024


@dataclass(slots=True)
class CaptureSummary:
    """What a capture held.

    Attributes:
        protocol: "single-byte" or "mip".
        records: Number of good records.
        checksum_errors: Records that were damaged.
        skipped_bytes: Bytes that belong to no record.
        tail_bytes: Bytes of a record that the capture's end cut off; not counted as skipped.
        kinds: Good records by header byte or descriptor set.
    """

    protocol: str
    records: int = 0
    checksum_errors: int = 0
    skipped_bytes: int = 0
    tail_bytes: int = 0
    kinds: Counter[str] = field(default_factory=Counter)


class Capture:
    """A capture being read: iterate over it, then look at `summary`.

    Args:
        data: The bytes.
        protocol: "single-byte", "mip", or "auto": whichever explains more of the bytes.
        little_endian_floats: The single-byte device was set to send floats so (sampling flag bit 4).

    Raises:
        DriverError: Unknown protocol.
    """

    def __init__(self, data: bytes, protocol: str = "auto", *, little_endian_floats: bool = False) -> None:
        if protocol == "auto":
            protocol = detect_protocol(data)
        if protocol not in ("single-byte", "mip"):
            raise DriverError(f"unknown protocol {protocol!r}; known are auto, single-byte, mip")
        self._data = data
        self._little_endian_floats = little_endian_floats
        self.summary = CaptureSummary(protocol)

    def __iter__(self) -> Iterator[dict[str, object]]:
        """Yield each record as a dictionary: kind, name, then its fields."""
        if self.summary.protocol == "mip":
            yield from self._mip()
        else:
            yield from self._single_byte()

    def _single_byte(self) -> Iterator[dict[str, object]]:
        decoder = sb.Decoder(little_endian_floats=self._little_endian_floats)
        for chunk in _chunks(self._data):
            for record in decoder.feed(chunk) if chunk else decoder.finish():
                kind = self._count(record.kind)
                yield {"kind": kind, "name": sb.LAYOUTS[record.kind].name, **record.fields()}
        self._finish(decoder)

    def _mip(self) -> Iterator[dict[str, object]]:
        decoder = mip.Decoder()
        for chunk in _chunks(self._data):
            for packet in decoder.feed(chunk) if chunk else decoder.finish():
                yield {"kind": self._count(packet.descriptor_set), **mip_fields.describe(packet)}
        self._finish(decoder)

    def _count(self, kind: int) -> str:
        text = f"0x{kind:02X}"
        self.summary.kinds[text] += 1
        self.summary.records += 1
        return text

    def _finish(self, decoder: sb.Decoder | mip.Decoder) -> None:
        self.summary.checksum_errors = decoder.checksum_errors
        self.summary.skipped_bytes = decoder.skipped_bytes
        self.summary.tail_bytes = len(decoder.pending)


def detect_protocol(data: bytes) -> str:
    """Tell which protocol explains more of the bytes."""
    explained = {}
    for name, decoder in (("single-byte", sb.Decoder()), ("mip", mip.Decoder())):
        for chunk in _chunks(data[:_SNIFFED]):
            decoder.feed(chunk)
        explained[name] = decoder.offset - len(decoder.pending) - decoder.skipped_bytes
    return max(explained, key=lambda name: explained[name])


def _chunks(data: bytes) -> Iterator[bytes]:
    """Pieces of the capture, then b"" for its end."""
    for start in range(0, len(data), _CHUNK):
        yield data[start : start + _CHUNK]
    yield b""
