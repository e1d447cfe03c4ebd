"""A full disk and a lost device are one line: no traceback of ours, of a library or of `logging`."""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from vical_drivers.samples import DeviceInfo, SourceStats

from vical_daemon import cli
from vical_daemon.acquire.device_loop import DeviceLoop
from vical_daemon.cli.errors import describe_known, report_thread, write_crash_log
from vical_daemon.service.atomic_file import atomic_write
from vical_daemon.service.wall_clock import shared_clock

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as `write` raises it: without the name of a file


def _refuse(*_: object) -> None:
    raise FULL


def test_a_full_disk_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", _refuse)
    with pytest.raises(OSError, match="No space left") as caught:
        atomic_write(tmp_path / "state.json", b"{}")
    assert describe_known(caught.value) == (f"{tmp_path}/state.json: No space left on device", 1)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match="No space left") as caught:
        shared_clock(tmp_path)
    assert describe_known(caught.value) == (f"{tmp_path}/wall_clock.json: No space left on device", 1)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ENODEV])
def test_what_disks_and_devices_refuse_is_no_bug(code: int) -> None:
    assert describe_known(OSError(code, os.strerror(code))) == (os.strerror(code), 1)
    assert describe_known(OSError(errno.EBADF, "Bad file descriptor")) is None  # this one is


def test_a_crash_log_that_does_not_fit_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("LOGS_DIRECTORY", "XDG_STATE_HOME", "HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "tmp"))

    def write_text(path: Path, text: str, encoding: str) -> None:
        path.touch()
        raise FULL

    monkeypatch.setattr(Path, "write_text", write_text)
    assert write_crash_log(ValueError("x")) is None
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


class _Broken:
    """A source whose device is pulled out: a library raises what it likes, also from `close`."""

    info = DeviceInfo("imu", "m", "1")

    def __init__(self, error: Exception) -> None:
        self._error, self._reads = error, 0

    def read(self, timeout_s: float) -> list[int]:
        self._reads += 1
        if self._reads > 2:
            raise self._error
        return [self._reads]

    def stats(self) -> SourceStats:
        return SourceStats()

    def __enter__(self) -> _Broken:
        return self

    def __exit__(self, *_: object) -> None:
        raise self._error


@pytest.fixture
def no_dead_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[object]]:
    died: list[object] = []
    monkeypatch.setattr(threading, "excepthook", died.append)
    yield died
    assert died == []


@pytest.mark.parametrize("error", [OSError(errno.EIO, "I/O error"), TypeError("a library's own mistake")])
def test_a_device_loop_survives_whatever_a_library_raises(
    error: Exception, no_dead_threads: list[object], caplog: pytest.LogCaptureFixture
) -> None:
    stop, got = threading.Event(), []
    loop = DeviceLoop("imu/imu0", lambda: _Broken(error), got.append, stop, longest_pause_s=0.1)
    with caplog.at_level(logging.INFO):
        loop.start()
        end_s = time.monotonic() + 10.0
        while loop.health().openings < 3 and time.monotonic() < end_s:
            time.sleep(0.01)
        stop.set()
        assert loop.join(5.0)
    assert loop.health().openings >= 3 and len(got) >= 4  # opened again and again, and read each time
    warnings = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert warnings and all(record.exc_info is None for record in warnings)
    assert all("\n" not in record.getMessage() for record in warnings)


def test_another_thread_that_reads_survives_it_as_well() -> None:
    stop, got = threading.Event(), []
    loop = DeviceLoop("imu/imu0", lambda: _Broken(TypeError("x")), got.append, stop)
    loop._opened(_Broken(TypeError("x")))
    for _ in range(4):
        loop.read_on()  # as the stand-in calls it
    assert loop.health().problem == "TypeError: x" and loop._broken and len(got) == 2


def test_a_thread_that_dies_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("LOGS_DIRECTORY", str(tmp_path))
    monkeypatch.setattr(threading, "excepthook", report_thread)
    for error, wanted in (
        (FULL, "No space left on device"),
        (KeyError("x"), "internal error: KeyError: 'x'"),
        (MemoryError(), "out of memory: has this process a limit"),
    ):

        def die(error: Exception = error) -> None:
            raise error

        thread = threading.Thread(target=die, name="log flush")
        thread.start()
        thread.join()
        assert caplog.records[-1].exc_info is None
        assert wanted in caplog.records[-1].getMessage() and "log flush" in caplog.records[-1].getMessage()
    assert "Traceback" in next(tmp_path.glob("crash-*.log")).read_text()


def test_a_journal_that_is_gone_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.EIO, "I/O error")  # of a terminal that is closed

    cli.main(["--version"])
    handler = logging.StreamHandler(Gone())
    handler.handle(logging.makeLogRecord({"msg": "x", "levelno": 20, "levelname": "INFO"}))
    assert "Traceback" not in capsys.readouterr().err
    assert sys.stderr is not None
