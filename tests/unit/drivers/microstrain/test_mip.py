"""The MIP codec: the vendor's packets both ways, a real capture, any chunking, damage, random bytes."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vical_drivers.microstrain import mip, mip_fields
from vical_drivers.microstrain.capture import Capture, detect_protocol

# (set, fields) <-> bytes, from the protocol fact sheet.
PACKETS = {
    "756501020201E0C6": (0x01, [(0x01, "")]),
    "7565010404F10100D56A": (0x01, [(0xF1, "0100")]),
    "75650C0D0D08010304000A05000A0E000A4195": (0x0C, [(0x08, "010304000A05000A0E000A")]),
    "75650C0804F106000483" + "03E85BF5": (0x0C, [(0xF1, "0600"), (0x83, "03E8")]),
    "75650C05051101010" + "1041A": (0x0C, [(0x11, "010101")]),
    "75650C0740".replace("0740", "070740") + "0100" + "0E1000539D": (0x0C, [(0x40, "01000E1000")]),
    "7565802" + "20E043C23D70ABCA3D70ABF7F9DB20E053A83126FBB03126F3A03126F060E00098968F7DC": (
        0x80,
        [(0x04, "3C23D70ABCA3D70ABF7F9DB2"), (0x05, "3A83126FBB03126F3A03126F"), (0x0E, "00098968")],
    ),
}


def data_packet(ticks: int) -> bytes:
    vector = struct.pack(">3f", 0.01, -0.02, -0.9985)
    return mip.encode(0x80, (0x04, vector), (0x05, vector), (0x0E, struct.pack(">I", ticks)))


def ticks_of(packets: list[mip.Packet]) -> list[int]:
    return [int.from_bytes(p.field(0x0E) or b"", "big") for p in packets]


@pytest.mark.parametrize("text", PACKETS)
def test_packets_both_ways(text):
    descriptor_set, fields = PACKETS[text]
    raw = [(d, bytes.fromhex(h)) for d, h in fields]
    assert mip.encode(descriptor_set, *raw) == bytes.fromhex(text)
    (packet,) = mip.Decoder().feed(bytes.fromhex(text))
    assert packet.descriptor_set == descriptor_set
    assert [tuple(f) for f in packet.fields] == raw
    assert packet.end == len(text) // 2


def test_vendor_packets(vectors):
    for text in json.loads((vectors / "vendor_manual_packets.json").read_text()):
        (packet,) = mip.Decoder().feed(bytes.fromhex(text))
        assert mip.encode(packet.descriptor_set, *packet.fields) == bytes.fromhex(text)


def test_real_capture(vectors):
    capture = Capture((vectors / "gx3_mip_static.bin").read_bytes())
    records = list(capture)
    s = capture.summary
    assert (s.protocol, s.records, s.checksum_errors, s.skipped_bytes, s.tail_bytes) == ("mip", 288, 0, 0, 11)
    accel = np.array([r["accel_mps2"] for r in records if r["kind"] == "0x80"])
    assert np.linalg.norm(accel.mean(axis=0)) == pytest.approx(9.80665, rel=5e-3)
    assert {"ack": {"command": "0x11", "result": "ok"}, "kind": "0x0C"} in records


def test_real_single_byte_record_is_told_from_mip(vectors):
    assert detect_protocol((vectors / "gx3_25_real_cc.bin").read_bytes()) == "single-byte"


def test_fletcher_against_its_definition():
    data = bytes(np.random.default_rng(0).integers(0, 256, 261, dtype=np.uint8))
    a = b = 0
    for value in data:
        a = (a + value) & 255
        b = (b + a) & 255
    assert mip.fletcher(data) == a << 8 | b


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=40), max_size=8), st.data())
def test_any_chunking_gives_the_same_packets(noise, data):
    stream = b"".join(n + data_packet(i) for i, n in enumerate(noise))
    expected = mip.Decoder().feed(stream)
    pieces, found, at = mip.Decoder(), [], 0
    while at < len(stream):
        size = data.draw(st.integers(1, 50))
        found += pieces.feed(stream[at : at + size])
        at += size
    assert found == expected


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from([b"\x75", b"\x65", b"\x75\x65\x80\xff", b"\x02\x04", b"abc"]), max_size=120))
def test_noise_full_of_sync_words_never_raises_and_memory_is_bounded(parts):
    decoder = mip.Decoder()
    data = b"".join(parts)
    decoder.feed(data)
    assert len(decoder.pending) < mip.MAX_LENGTH
    decoder.finish()
    assert decoder.skipped_bytes + len(decoder.pending) <= len(data)


def test_undamaged_packets_survive_damage_and_false_sync_words():
    rng = np.random.default_rng(6)
    good, stream = [], b""
    for i in range(3000):
        packet = data_packet(i)
        kind = rng.integers(6)
        if kind == 0:
            cut = int(rng.integers(0, len(packet)))
            stream += packet[:cut] + packet[cut + 1 :]
            continue
        if kind == 1:
            stream += b"\x75\x65\x80" + rng.bytes(int(rng.integers(1, 60)))
        stream += packet
        good.append(i)
    decoder = mip.Decoder()
    found = set(ticks_of(decoder.feed(stream) + decoder.finish()))
    assert len(found & set(good)) >= 0.999 * len(good)


def test_contradicting_field_lengths_do_not_make_it_wait():
    # 75 65 80 FF, then a first field of length 1: cannot be a packet, so the good one comes at once.
    (packet,) = mip.Decoder().feed(b"\x75\x65\x80\xff\x01" + data_packet(3))
    assert ticks_of([packet]) == [3]


def test_a_single_sync_byte_at_the_end_is_kept():
    decoder = mip.Decoder()
    first = decoder.feed(data_packet(1) + b"\x75")
    second = decoder.feed(data_packet(2)[1:])
    assert ticks_of(first + second) == [1, 2]
    assert decoder.skipped_bytes == 0


def test_too_much_for_one_packet_is_refused():
    with pytest.raises(ValueError, match="do not fit"):
        mip.encode(0x80, (0x01, bytes(200)), (0x02, bytes(60)))


@pytest.mark.parametrize(
    ("descriptor", "data", "ticks"),
    [
        (0x0E, struct.pack(">I", 2**32 - 1), 2**32 - 1),
        (0xD5, struct.pack(">Q", 123_456_789_012), 123_456_789_012),
        (0x12, struct.pack(">dHH", 1.5, 2, 0), 2 * 604_800 * 10**9 + 1_500_000_000),
        (0xD3, struct.pack(">dHH", 1.5, 2, 3), 2 * 604_800 * 10**9 + 1_500_000_000),
        (0xD3, struct.pack(">dHH", 1.5, 2, 0), None),
        (0x0F, struct.pack(">BII", 1, 3, 4), 3_000_000_004),
        (0x0E, b"\x00", None),
    ],
)
def test_time_fields(descriptor, data, ticks):
    (time_field,) = (t for t in mip_fields.TIME_FIELDS if t.descriptor == descriptor)
    assert time_field.ticks(data) == ticks


def test_unknown_fields_and_several_acks_are_shown():
    packet = mip.Packet(
        0x0C, (mip.Field(0xF1, b"\x08\x00"), mip.Field(0xF1, b"\x11\x03"), mip.Field(0xEE, b"\x01"))
    )
    assert mip_fields.describe(packet) == {
        "ack": {"command": "0x08", "result": "ok"},
        "ack_2": {"command": "0x11", "result": "invalid parameter"},
        "field_0xEE": "01",
    }


def test_single_byte_records_wrapped_in_mip_are_unwrapped():
    record = bytes.fromhex("C23C23D70ABCA3D70ABF7F9DB23A83126FBB03126F3A03126F000989680B04")
    (packet,) = mip.Decoder().feed(mip.encode(0x80, (0x82, record)))
    (wrapped,) = mip_fields.describe(packet)["wrapped"]
    assert (wrapped["kind"], wrapped["device_ticks"]) == ("0xC2", 625000)


def test_a_capture_that_begins_inside_a_packet_is_not_damaged():
    decoder = mip.Decoder()
    assert ticks_of(decoder.feed(data_packet(0)[7:] + data_packet(1))) == [1]
    assert decoder.checksum_errors == 0
