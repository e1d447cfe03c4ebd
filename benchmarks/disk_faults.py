"""The recorder on a disk that is full, read-only or gone, and under a clock that steps (needs root: mounts).

sudo python -m benchmarks disk_faults
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from unittest import mock

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.config.model import loads
from vical_daemon.logs.mcap import LogFolder, LogReader
from vical_daemon.record.queue import RecordQueue, arrival
from vical_daemon.record.recorder import Recorder
from vical_daemon.service.wall_clock import WallClock, private_clock

_IMU = topics.IMU.key("rig0", "imu0")


def main(argv: list[str]) -> int:
    """One row for each fault."""
    argparse.ArgumentParser(prog="python -m benchmarks disk_faults").parse_args(argv)
    print(
        "| fault | what the recorder says | messages kept of those before it | after it |\n|---|---|---|---|"
    )
    clock_step()
    if os.geteuid() != 0:
        print("\nThe faults of the disk need root (they mount a small tmpfs).")
        return 1
    full_disk()
    reserve()
    read_only()
    return 0


@contextmanager
def small_disk(megabytes: int) -> Iterator[Path]:
    """Mount a tmpfs of a few MB."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", folder], check=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)


def recorder_in(folder: Path, reserve_bytes: int = 0, clock: WallClock | None = None) -> Recorder:
    """Return a recorder that has begun."""
    config = loads(f"rig: rig0\nrecord: {{directory: {folder}, reserve_bytes: {reserve_bytes}}}\n")
    recorder = Recorder(config, LogFolder(folder, reserve_bytes=reserve_bytes), clock or private_clock())
    recorder.tick()
    return recorder


def feed(recorder: Recorder, begin: int, count: int, clock: WallClock | None = None) -> None:
    """Hand numbered samples over, with noise that does not compress."""
    clock = clock or private_clock()
    for i in range(begin, begin + count):
        noise = os.urandom(200).hex()
        payload = m.encode_imu(1, f"imu0 {noise}", (float(i), 0.0, 0.0), (0.0, 0.0, 9.8))
        item = arrival(Sample(_IMU, payload, i), clock)
        assert item is not None
        recorder.write(item)
        if i % 200 == 0:
            recorder.tick()


def kept(folder: Path) -> set[int]:
    """Return the numbers in all finished segments."""
    numbers = set()
    for path in folder.glob("*.mcap"):
        for message in LogReader(path).messages():
            if message.channel.topic == "/" + _IMU:
                numbers.add(int(m.decode_imu(message.payload).gyro_rps[0]))
    return numbers


def row(fault: str, said: str, numbers: set[int], before: int, after: int) -> None:
    """Print one row."""
    early, late = len({n for n in numbers if n < before}), len({n for n in numbers if n >= 10**6})
    print(f"| {fault} | {said} | {early} / {before} | {late} / {after} |")


def full_disk() -> None:
    """No reserve, no quota: writing fails; then space appears."""
    with small_disk(8) as folder:
        hog = folder / "hog"
        hog.write_bytes(bytes(6_000_000))
        recorder = recorder_in(folder / "log")
        number = 0
        while recorder.recording and number < 100_000:
            feed(recorder, number, 100)
            number += 100
        said = recorder.status(RecordQueue(), 0).message
        hog.unlink()
        time.sleep(5.2)
        recorder.tick()
        feed(recorder, 10**6, 100)
        recorder.close()
        row("disk full, no reserve set", said.replace(str(folder), "..."), kept(folder / "log"), number, 100)


def reserve() -> None:
    """With a reserve the segment ends in order before the disk is full."""
    with small_disk(8) as folder:
        hog = folder / "hog"
        hog.write_bytes(bytes(2_500_000))
        recorder = recorder_in(folder / "log", reserve_bytes=2_000_000)
        number = 0
        while recorder.recording and number < 100_000:
            feed(recorder, number, 100)
            recorder.tick()
            number += 100
        said = recorder.status(RecordQueue(), 0).message
        hog.unlink()
        time.sleep(5.2)
        recorder.tick()
        feed(recorder, 10**6, 100)
        recorder.close()
        row("reserve reached", said, kept(folder / "log"), number, 100)


def read_only() -> None:
    """The file system turns read-only under an open segment, as after a disk error."""
    with small_disk(8) as folder:
        log = folder / "log"
        recorder = recorder_in(log)
        feed(recorder, 0, 300)
        recorder.close()
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        recorder = recorder_in(log)
        feed(recorder, 500, 100)
        said = recorder.status(RecordQueue(), 0).message
        subprocess.run(["mount", "-o", "remount,rw", str(folder)], check=True)
        time.sleep(5.2)
        recorder.tick()
        feed(recorder, 10**6, 100)
        recorder.close()
        row("disk read-only", said.replace(str(folder), "..."), kept(log), 300, 100)


def clock_step() -> None:
    """The wall clock steps by an hour, back and forth, while recording."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        clock = private_clock()
        recorder = recorder_in(folder, clock=clock)
        true_ns = time.time_ns
        feed(recorder, 0, 300, clock)
        for hours in (1, -1):
            with mock.patch("time.time_ns", lambda hours=hours: true_ns() + hours * 3_600_000_000_000):
                feed(recorder, 10**6 + (0 if hours > 0 else 100), 100, clock)
                recorder.tick()
        recorder.close()
        times = [x.log_time_ns for p in sorted(folder.glob("*.mcap")) for x in LogReader(p).messages()]
        steps = [b - a for a, b in pairwise(times)]
        back = sum(step < 0 for step in steps)
        said = f"nothing; log times: {back} steps back, the largest forward {max(steps) * 1e-9:.3f} s"
        row("clock + 1 h, then - 1 h", said, kept(folder), 300, 200)
