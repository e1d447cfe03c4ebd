"""Every command that reads a file, given what is no file, or one that unpacks without an end."""

from __future__ import annotations

import gzip
import json
import os
import stat
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

from vical_daemon.cli import table

# In a process of its own: a limit on memory binds all that follows. Each command may take 2 minutes (SIGALRM
# ends the process); a sound refusal takes milliseconds.
RUNNER = """
import contextlib, io, json, resource, signal, sys
resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30,) * 2)
from vical_daemon import cli
for words in json.load(sys.stdin):
    signal.alarm(120)
    out, err = io.StringIO(), io.StringIO()
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # the peak of memory is that of this command
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main(words)
        except SystemExit as end:
            code = end.code
    status = open("/proc/self/status").read()  # ru_maxrss would include the parent, of which this was a copy
    peak_mb = int(status.split("VmHWM:")[1].split()[0]) / 1024
    print(json.dumps([words, code, out.getvalue(), err.getvalue(), peak_mb]), flush=True)
"""
# Words of a command and the suffix of the file that stands for FILE.
READERS = [
    ("calibrate FILE", ".mcap"),
    ("calibrate FILE", ".bag"),
    ("calibrate SOUND --target FILE", ".yaml"),
    ("calibrate SOUND --initial FILE", ".yaml"),
    ("td-icp FILE", ".mcap"),
    ("td-icp SOUND --sensors imu0,FILE", ".csv"),
    ("td-icp SOUND --target FILE", ".yaml"),
    ("observability FILE", ".mcap"),
    ("observability SOUND --target FILE", ".yaml"),
    ("allan FILE", ".csv"),
    ("allan FILE", ".bag"),
    ("imu-calibrate FILE", ".csv"),
    ("info FILE", ".mcap"),
    ("info FILE", ".mcap.part"),
    ("info FILE", ".bag"),
    ("info FILE", ".db3"),
    ("replay FILE --all", ".mcap"),
    ("recover FILE", ".mcap"),
    ("recover FILE", ".mcap.part"),
    ("export FILE --format kalibr", ".json"),
    ("export FILE --format kalibr", ".yaml"),
    ("export FILE --format kalibr", ".mcap"),
    ("compare FILE FILE", ".json"),
    ("compare FILE FILE", ".yaml"),
    ("verify SOUND --against FILE", ".json"),
    ("verify SOUND --against FILE", ".yaml"),
    ("verify FILE --against FILE", ".mcap"),
    ("check --no-devices -c FILE", ".yaml"),
    ("run -c FILE", ".yaml"),
    ("watch --once -c FILE", ".yaml"),
    ("web -c FILE", ".yaml"),
    ("command accept -c FILE", ".yaml"),
    ("merge SOUND FILE --target OUT", ".mcap"),
    ("target --from FILE -o OUT", ".yaml"),
    ("imu decode FILE", ".bin"),
    ("imu info FILE", ""),
    ("imu stream FILE", ""),
    ("camera stream FILE", ""),
    ("camera snapshot FILE -o OUT", ""),
]
# `devices`, `init`: --port is opened as `imu info` opens its own; the others read no file that a user names.
NO_FILES = {"completion", "demo", "devices", "doctor", "init", "install-service"}


def test_every_command_is_looked_at() -> None:
    assert {words.split()[0] for words, _ in READERS} | NO_FILES == set(table.available())


def run(commands: list[list[str]], tmp_path: Path) -> list[tuple[list[str], int, str, str, float]]:
    done = subprocess.run(
        [sys.executable, "-c", RUNNER],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        timeout=600,
        env={**os.environ, "HOME": str(tmp_path), "VICAL_STATE_DIR": str(tmp_path / "state")},
        check=False,
    )
    results = [tuple(json.loads(line)) for line in done.stdout.splitlines()]
    assert len(results) == len(commands), f"{commands[len(results)]} took too long: {done.stderr[-500:]}"
    return results


def make(kind: str, path: Path) -> None:
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        os.mknod(path, stat.S_IFSOCK | 0o600)
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(2**40)  # sparse
    elif kind == "loop":
        path.symlink_to(path.name)
    else:
        path.symlink_to("/dev/zero")


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    """A small recording in which nothing is wrong."""
    folder = tmp_path / "sound" / "mav0"
    (folder / "imu0").mkdir(parents=True)
    (folder / "cam0").mkdir()
    rows = [f"{1_000_000_000 + 5_000_000 * i},0.01,0,0,0,0,9.8" for i in range(400)]
    (folder / "imu0" / "data.csv").write_text("\n".join(rows) + "\n")
    corners = [f"{1_000_000_000 + 50_000_000 * i},{k},{10 * k},{20 * k}" for i in range(40) for k in range(6)]
    (folder / "cam0" / "corners.csv").write_text("\n".join(corners) + "\n")
    return tmp_path / "sound"


KINDS = ["device", "pipe", "socket", "folder", "huge", "loop"]


def test_what_is_no_file_is_refused_in_one_line(tmp_path: Path, sound: Path) -> None:
    commands = []
    for kind in KINDS:
        (tmp_path / kind).mkdir()
        for number, (words, suffix) in enumerate(READERS):
            path = tmp_path / kind / f"input{number}{suffix}"
            make(kind, path)
            named = {"FILE": str(path), "SOUND": str(sound), "OUT": str(tmp_path / "out.png")}
            commands.append([",".join(named.get(p, p) for p in word.split(",")) for word in words.split()])
    for n, (words, code, out, err, peak_mb) in enumerate(run(commands, tmp_path)):
        line = err.strip()
        if words[0] == "recover" and KINDS[n // len(READERS)] == "folder":
            assert (code, out, line) == (0, "nothing to recover\n", "")  # a folder of logs, an empty one
            continue
        assert code in (1, 2), (words, code, out, err)
        assert line.startswith("vical") and "\n" not in line, (words, err)
        assert "internal error" not in line, (words, err)
        assert peak_mb < 1000, words


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def mcap(path: Path, chunk: bytes, copies: int) -> None:
    """An MCAP of one chunk, again and again; https://mcap.dev/spec."""
    import zstandard

    packed = zstandard.compress(chunk, 3)
    head = struct.pack("<QQQI", 0, 0, len(chunk), zlib.crc32(chunk)) + struct.pack("<I", 4) + b"zstd"
    one = record(6, head + struct.pack("<Q", len(packed)) + packed)
    header = record(1, struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0))
    end = record(15, bytes(4)) + record(2, bytes(20))
    path.write_bytes(b"\x89MCAP0\r\n" + header + one * copies + end + b"\x89MCAP0\r\n")


def test_what_a_small_log_unpacks_to_is_bounded(tmp_path: Path) -> None:
    zeros, records = tmp_path / "zeros.mcap", tmp_path / "records.mcap"
    mcap(zeros, bytes(240_000_000), 400)  # 96 GB in 10 MB
    mcap(records, struct.pack("<BQ", 0x80, 0) * 26_000_000, 100)  # 2.6 billion records without content
    assert zeros.stat().st_size < 12e6
    commands = [[command, str(zeros)] for command in ("info", "recover", "calibrate")]
    commands.append(["info", str(records)])
    for words, code, out, err, peak_mb in run(commands, tmp_path):
        assert code == (0 if words[0] == "info" else 1), (words, err)
        if words[0] != "recover":
            assert "MB were unpacked from a file of" in out + err, (words, out, err)
        assert "internal error" not in err, (words, err)
        assert err.count("\n") <= 1, (words, err)
        assert peak_mb < 1500, words


def test_what_a_small_text_unpacks_to_is_bounded(tmp_path: Path, sound: Path) -> None:
    table_folder = tmp_path / "packed"
    (table_folder / "mav0").mkdir(parents=True)
    (table_folder / "mav0" / "imu0").symlink_to(sound / "mav0" / "imu0")
    (table_folder / "mav0" / "cam0").mkdir()
    with gzip.open(table_folder / "mav0" / "cam0" / "corners.csv.gz", "wb", 1) as file:
        for _ in range(20):
            file.write(b"\n" * 10_000_000)
    nested = "".join(f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]\n" for i in range(9))
    laughs = tmp_path / "laughs.yaml"
    laughs.write_text("a0: &a0 [1, 1]\n" + nested + "cam0: {camera_model: pinhole, T_cam_imu: *a9}\n")
    deep = tmp_path / "deep.json"
    deep.write_text("[" * 1_000_000)
    no_text = tmp_path / "result.json"
    no_text.write_bytes(b"\xff\xfe{}")
    commands = [
        ["info", str(table_folder)],
        ["export", str(laughs), "--format", "kalibr"],
        ["calibrate", str(sound), "--initial", str(laughs)],
        ["export", str(deep), "--format", "kalibr"],
        ["export", str(no_text), "--format", "kalibr"],
    ]
    expected = ["unpacks to more than", "aliases", "aliases", "not JSON", "not JSON"]
    for (words, code, out, err, peak_mb), text in zip(run(commands, tmp_path), expected, strict=True):
        assert code in (1, 2), (words, code, out, err)
        assert text in err and err.count("\n") == 1, (words, err)
        assert "internal error" not in err, (words, err)
        assert peak_mb < 1000, words


def test_a_record_that_states_a_hundred_gigabytes_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "sparse.mcap"
    mcap(path, b"", 0)
    sound = path.read_bytes()
    with path.open("wb") as file:
        file.write(sound[: -8 - 2 * 9 - 24] + struct.pack("<BQ", 9, 10**11))  # an attachment
        file.seek(10**11, os.SEEK_CUR)
        file.write(record(15, bytes(4)) + record(2, bytes(20)) + b"\x89MCAP0\r\n")
    ((_, code, out, _, peak_mb),) = run([["info", str(path)]], tmp_path)
    assert (code, peak_mb < 1000) == (0, True)
    assert "1 damaged piece left out" in out and "UNFINISHED" not in out


def png(width: int, height: int) -> bytes:
    """A PNG whose header states a size; its content is black, as far as it goes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    content = chunk(b"IDAT", zlib.compress(bytes((width + 1) * height), 1))
    return b"\x89PNG\r\n\x1a\n" + header + content + chunk(b"IEND", b"")


def test_images_that_are_none_or_too_large_are_left_out(tmp_path: Path, sound: Path) -> None:
    camera = sound / "mav0" / "cam0"
    (camera / "corners.csv").unlink()
    (camera / "data").mkdir()
    large = png(16_384, 16_384)  # 268 Mpx in 1.2 MB
    stamps = [1_000_000_000 + 100_000_000 * i for i in range(20)]
    for number, stamp in enumerate(stamps):
        (camera / "data" / f"{stamp}.png").write_bytes(large if number % 2 else b"no image")
    (camera / "data.csv").write_text("".join(f"{stamp},{stamp}.png\n" for stamp in stamps))
    target, initial = tmp_path / "target.yaml", tmp_path / "initial.yaml"
    target.write_text("target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.05\ntagSpacing: 0.3\n")
    initial.write_text("cam0: {resolution: [640, 480]}\n")
    options = ["--target", str(target), "--initial", str(initial)]
    commands = [[c, str(sound), *options] for c in ("calibrate", "td-icp", "observability")]
    for words, code, out, err, peak_mb in run(commands, tmp_path):
        assert code == 1, (words, code, out, err)
        assert "internal error" not in err and "Traceback" not in err, (words, err)
        assert "target" in err, (words, err)
        assert words[0] == "calibrate" or "20 unreadable images left out" in err, (words, err)
        assert peak_mb < 1000, words
