"""The single-byte codec: the manual's examples, a real record, any chunking, damage, random bytes."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vical_drivers.microstrain import single_byte as sb
from vical_drivers.microstrain import single_byte_commands as cmd


def reply(kind: int, body: bytes) -> bytes:
    frame = bytes([kind]) + body
    return frame + struct.pack(">H", sum(frame) % 65536)


def sample(ticks: int, acc=(0.01, -0.02, -0.9985), gyro=(0.001, -0.002, 0.0005)) -> bytes:
    return reply(0xC2, struct.pack(">6fI", *acc, *gyro, ticks))


# Frames worked out by hand from the manual's tables, checksums by an independent sum.
EXAMPLES = {
    "C2 3C23D70A BCA3D70A BF7F9DB2 3A83126F BB03126F 3A03126F 00098968 0B04": (
        0xC2,
        {"device_ticks": 625000, "gyro_rps": pytest.approx([0.001, -0.002, 0.0005])},
    ),
    "C2 00000000 00000000 BF800000 00000000 00000000 00000000 FFFFFFFF 05FD": (
        0xC2,
        {"device_ticks": 0xFFFFFFFF, "accel_mps2": [0.0, 0.0, -9.80665]},
    ),
    "C3 3727C5AC B7A7C5AC 36A7C5AC 38D1B717 B951B717 BC239820 00098968 0DEF": (
        0xC3,
        {"delta_angle_rad": pytest.approx([1e-5, -2e-5, 5e-6])},
    ),
    "C4 C2 00098968 0280": (0xC4, {"data_command": 0xC2}),
    "CB 3C23D70A BCA3D70A BF7F9DB2 3A83126F BB03126F 3A03126F 3E4CCCCD 3C23D70A 3EE66666 00098968 1060": (
        0xCB,
        {"mag_t": pytest.approx([0.2e-4, 0.01e-4, 0.45e-4])},
    ),
    "CD 3A83126F BB03126F 3A03126F 001312D0 04FD": (
        0xCD,
        {"gyro_bias_rps": pytest.approx([0.001, -0.002, 0.0005])},
    ),
    "CE 3DCCCCCD BE4CCCCD 3FC00000 00098968 080C": (0xCE, {"euler_rad": pytest.approx([0.1, -0.2, 1.5])}),
    "CF 3DCCCCCD BE4CCCCD 3FC00000 3A83126F BB03126F 3A03126F 00098968 0B48": (
        0xCF,
        {"device_ticks": 625000},
    ),
    "D0 0002 00098968 01CC": (0xD0, {"quantity": 2}),
    "D1 085B 0708 0712 071C 00098968 0279": (0xD1, {"raw_board": 2139, "raw_gyro_z": 1820}),
    "D4 01 00D5": (0xD4, {"mode": 1}),
    "D5 02 00D7": (0xD5, {"mode": 2}),
    "D6 C2 0198": (0xD6, {"data_command": 0xC2}),
    "D7 00098968 01D1": (0xD7, {"device_ticks": 625000}),
    "D9 01 000E1000 0200 00FA": (0xD9, {"baud": 921600, "port": 1, "config": 2}),
    "DA 00100FDF 01D8": (0xDA, {"flags": 0x00100FDF}),
    "DB 000A 0003 0F 11 000A 000A 000000000000 011C": (0xDB, {"decimation": 10, "filter_width": 15}),
    "DB 0001 0D00 0F11 000A 000A 000000000000 011D": (0xDB, {"decimation": 1, "flags": 0x0D00}),
    "DD 00000000 00DD": (0xDD, {}),
    "DF 3F800000 00000000 00000000 00000000 00098968 0298": (0xDF, {"quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}),
    "E5 1234 012B": (0xE5, {"word": 0x1234}),
    "E9 0000046A 0157": (0xE9, {"firmware_number": 1130}),
    "EA 02 202020202020 33444D2D4758332D3235 0403": (0xEA, {"index": 2, "text": "3DM-GX3-25"}),
    "21 0021": (0x21, {}),
}
COMMANDS = {
    "C4C129C2": cmd.set_continuous(0xC2),
    "C4C12900": cmd.set_continuous(0),
    "CDC1292710": cmd.capture_gyro_bias(10_000),
    "D0C1290002": cmd.store_bias_in_eeprom(2),
    "D4A34700": cmd.set_mode(0),
    "D7C1290000000000": cmd.timer(),
    "D7C1290100000000": cmd.timer(1, 0),
    "D9C3550101000E10000200": cmd.communication(cmd.APPLY, 921_600),
    "D9C3550100000000000000": cmd.communication(),
    "DBA8B900" + "00" * 16: cmd.sampling(),
    "DBA8B90100010D000F11000A000A000000000000": cmd.sampling(cmd.APPLY, cmd.Sampling(1, 0x0D00)),
    "EA02": cmd.get_identity(2),
    "FA75B4": cmd.STOP_STREAM,
}


@pytest.mark.parametrize("text", EXAMPLES)
def test_replies_of_the_manual(text):
    kind, expected = EXAMPLES[text]
    frame = bytes.fromhex(text)
    decoder = sb.Decoder()
    (record,) = decoder.feed(frame)
    assert record.kind == kind
    assert record.end == len(frame) == sb.LAYOUTS[kind].length
    fields = record.fields()
    assert {name: fields[name] for name in expected} == expected
    assert decoder.skipped_bytes == decoder.checksum_errors == 0


@pytest.mark.parametrize("text", COMMANDS)
def test_commands_of_the_manual(text):
    assert COMMANDS[text] == bytes.fromhex(text)


def test_sampling_settings_are_compared_by_name():
    assert cmd.Sampling(5).difference(cmd.Sampling(10)) == "decimation is 5, not 10"


def test_rates_follow_the_manuals_table():
    rates = [cmd.max_rate_hz(0xC2, baud) for baud in cmd.BAUD_RATES]
    assert rates == pytest.approx([250.0, 1000.0 / 3.0, 500.0, 1000.0])
    assert cmd.max_rate_hz(0xCC, 115_200) < 146.0


def test_real_record(vectors):
    (record,) = sb.Decoder().feed((vectors / "gx3_25_real_cc.bin").read_bytes())
    fields = record.fields()
    assert record.ticks == 21_769_837
    assert fields["gyro_rps"] == pytest.approx([0.0036402, -0.0015438, 0.0037287], abs=1e-6)
    assert np.array(fields["accel_mps2"]) / 9.80665 == pytest.approx(
        [0.0054515, 0.0074151, 0.9991051], abs=1e-6
    )
    matrix = np.array(fields["matrix"]).reshape(3, 3)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-5)


def test_little_endian_floats_leave_the_timer_alone():
    body = struct.pack("<6f", 1, 2, 3, 4, 5, 6) + struct.pack(">I", 77)
    (record,) = sb.Decoder(little_endian_floats=True).feed(reply(0xC2, body))
    assert record.values == (1, 2, 3, 4, 5, 6, 77)


def test_nan_of_any_sign_is_data():
    body = bytes.fromhex("FFC00000" * 3 + "7FC00000" * 3) + struct.pack(">I", 5)
    (record,) = sb.Decoder().feed(b"\x00\x01" + reply(0xC2, body))
    assert record.ticks == 5


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 2**32 - 1), max_size=8), st.data())
def test_any_chunking_gives_the_same_records(ticks, data):
    noise = data.draw(st.lists(st.binary(max_size=30), min_size=len(ticks), max_size=len(ticks)))
    stream = b"".join(n + sample(t) for n, t in zip(noise, ticks, strict=True))
    whole = sb.Decoder()
    expected = whole.feed(stream)
    pieces, found, at = sb.Decoder(), [], 0
    while at < len(stream):
        size = data.draw(st.integers(1, 40))
        found += pieces.feed(stream[at : at + size])
        at += size
    assert found == expected
    assert (pieces.skipped_bytes, pieces.checksum_errors) == (whole.skipped_bytes, whole.checksum_errors)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=400))
def test_random_bytes_never_raise_and_memory_is_bounded(data):
    decoder = sb.Decoder()
    decoder.feed(data)
    assert len(decoder.pending) < sb.MAX_LENGTH
    decoder.finish()
    assert decoder.skipped_bytes + len(decoder.pending) <= len(data)


def test_undamaged_records_survive_damage_between_them():
    rng = np.random.default_rng(5)
    good, stream = [], b""
    for i in range(4000):
        frame = sample(i * 625, rng.normal(0, 1, 3), rng.normal(0, 0.5, 3))
        kind = rng.integers(6)
        if kind == 0:
            cut = int(rng.integers(1, len(frame)))
            stream += frame[:cut] + frame[cut + 1 :]  # a byte lost inside this one
        elif kind == 1:
            stream += rng.bytes(int(rng.integers(1, 60))) + frame
            good.append(i * 625)
        else:
            stream += frame
            good.append(i * 625)
    decoder = sb.Decoder()
    found = {r.ticks for r in decoder.feed(stream) + decoder.finish() if r.kind == 0xC2}
    assert len(found & set(good)) >= 0.999 * len(good)


def test_a_record_behind_a_false_header_at_the_end_is_found_by_finish():
    decoder = sb.Decoder()
    assert decoder.feed(b"\x00\xcc" + sample(9)) == []
    (record,) = decoder.finish()
    assert record.ticks == 9
    assert decoder.pending == b""


def test_a_cut_off_record_stays_pending_and_is_not_counted_as_skipped():
    decoder = sb.Decoder()
    decoder.feed(sample(1) + sample(2)[:20])
    decoder.finish()
    assert (decoder.skipped_bytes, len(decoder.pending), decoder.checksum_errors) == (0, 20, 0)
    (late,) = decoder.feed(sample(2)[20:])
    assert late.ticks == 2


def test_one_damaged_record_counts_once():
    frame = bytearray(sample(1))
    frame[7] ^= 4
    decoder = sb.Decoder()
    assert [r.ticks for r in decoder.feed(sample(0) + bytes(frame) + sample(2))] == [0, 2]
    assert (decoder.checksum_errors, decoder.skipped_bytes) == (1, 31)
