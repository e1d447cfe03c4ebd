"""`vical imu decode` and the usage errors of its siblings, without any device."""

from __future__ import annotations

import json
import struct

import pytest

from vical_daemon.cli import main


def record(ticks: int, *, order: str = ">") -> bytes:
    body = b"\xc2" + struct.pack(f"{order}6f", 0, 0, -1, 0.1, float("nan"), 0.3) + struct.pack(">I", ticks)
    return body + struct.pack(">H", sum(body) % 65536)


def lines(capsys) -> list[dict]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_decode_prints_a_line_per_record_and_a_summary(tmp_path, capsys):
    path = tmp_path / "capture.bin"
    path.write_bytes(record(1)[9:] + record(2) + b"\x00\x01" + record(3) + record(4)[:12])
    assert main(["imu", "decode", str(path), "--json"]) == 0
    *records, last = lines(capsys)
    assert [r["device_ticks"] for r in records] == [2, 3]
    assert records[0]["kind"] == "0xC2"
    assert records[0]["accel_mps2"] == [0.0, 0.0, -9.80665]
    assert records[0]["gyro_rps"][1] is None  # NaN: not measured
    assert last["summary"] == {
        "records": 2,
        "checksum_errors": 0,
        "skipped_bytes": 24,
        "kinds": {"0xC2": 2},
        "protocol": "single-byte",
        "tail_bytes": 12,
    }


def test_decode_takes_little_endian_floats(tmp_path, capsys):
    path = tmp_path / "capture.bin"
    path.write_bytes(record(7, order="<"))
    assert main(["imu", "decode", str(path), "--little-endian-floats", "--json"]) == 0
    assert lines(capsys)[0]["accel_mps2"] == [0.0, 0.0, -9.80665]


@pytest.mark.parametrize("content", [b"", b"this is a text file, no capture\n" * 20])
def test_decode_of_something_else_is_one_line(tmp_path, capsys, content):
    path = tmp_path / "notes.txt"
    path.write_bytes(content)
    assert main(["imu", "decode", str(path)]) == 1
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert "no MicroStrain record" in error[0]


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["imu", "decode", "/no/such/file"], 1),
        (["imu", "info", "/no/such/port"], 1),
        (["imu", "stream", "/no/such/port", "--rate", "5000"], 2),
        (["imu", "stream", "/no/such/port", "--filter-width", "40"], 2),
        (["imu", "stream", "/no/such/port", "--samples", "0"], 2),
        (["imu", "stream", "/no/such/port", "--plot", "/no/such/folder/f.png"], 2),
        (["imu", "capture-gyro-bias", "/no/such/port", "--seconds", "100"], 2),
    ],
)
def test_mistakes_end_in_one_line(words, code, capsys):
    assert main(words) == code
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
