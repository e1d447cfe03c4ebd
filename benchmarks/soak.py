"""Bus and recorder for a long time at full rate: memory, descriptors, threads, lost samples.

    python -m benchmarks soak --minutes 20

This process hosts the bus and publishes 1000 Hz inertial data and 30 Hz images of 360 kB; the recorder
runs in a process of its own with a quota, so that rotation and deletion take part.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from vical_mocks.harness.processes import usage

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.logs.mcap import LogReader

_CONTEXT = mp.get_context("spawn")
_IMU, _IMAGE = topics.IMU.key("rig0", "imu0"), topics.IMAGE.key("rig0", "cam0")
_KEYS = {"inertial": _IMU, "images": _IMAGE, "statuses": "vical/rig0/status/*"}
_SETTLE_S = 60.0


class _Count:
    """Counts what a subscription is given; notes when numbers were missing and how long nothing had come."""

    def __init__(self) -> None:
        self.messages, self.longest_s = 0, 0.0
        self.bursts: list[tuple[float, int, float]] = []
        self._begin_s = self._last_s = time.monotonic()
        self._next: int | None = None

    def __call__(self, sample: Any) -> None:
        now_s, self.messages = time.monotonic(), self.messages + 1
        pause_s, self._last_s = now_s - self._last_s, now_s
        self.longest_s = max(self.longest_s, pause_s if self._next is not None else 0.0)
        if self._next is not None and sample.sequence > self._next:
            self.bursts.append((now_s - self._begin_s, sample.sequence - self._next, pause_s))
        self._next = sample.sequence + 1


def main(argv: list[str]) -> int:
    """Publish, watch, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks soak")
    parser.add_argument("--minutes", type=float, default=20.0)
    args = parser.parse_args(argv)
    from vical_daemon.bus.zenoh_bus import open_bus

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bus = open_bus(mode="router", socket=folder / "z.sock")
        done = _CONTEXT.Event()
        recorder = _CONTEXT.Process(target=record, args=(str(folder), done))
        recorder.start()
        status: dict[str, str] = {}
        bus.subscribe(topics.STATUS.key("rig0", "record"), lambda sample: status.update(_values(sample)))
        while not status:
            time.sleep(0.1)
        seen, sent = publish_and_watch(bus, recorder.pid or 0, args.minutes * 60)
        time.sleep(2.0)
        done.set()
        recorder.join()
        bus.close()
        received = json.loads((folder / "seen.json").read_text())
        holes, kept, segments = check_segments(folder / "log")
    report(seen, sent, received, status, (holes, kept, segments))
    return int(holes > 0 or received["inertial"][1] > 0 or status["dropped"] != "0")


def publish_and_watch(bus: Any, pid: int, seconds: float) -> tuple[list[tuple[Any, ...]], dict[str, int]]:
    """Publish on one clock; every 10 s note (memory, descriptors, threads) of both processes."""
    image = m.encode_image(
        1, "cam0", np.random.default_rng(1).integers(0, 2, (480, 752), dtype=np.uint8), "mono8"
    )
    begin_s, sent, images, seen = time.monotonic(), 0, 0, []
    while (elapsed_s := time.monotonic() - begin_s) < seconds:
        while sent < elapsed_s * 1000:
            bus.publish(_IMU, m.encode_imu(sent, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
            sent += 1
        if images < elapsed_s * 30:
            bus.publish(_IMAGE, image)
            images += 1
        if elapsed_s > len(seen) * 10:
            seen.append((elapsed_s, usage(os.getpid()), usage(pid)))
        time.sleep(0.0007)
    return seen, {"inertial": sent, "images": images}


def record(folder: str, done: Any) -> None:
    """The role as it runs in `vical-record.service`."""
    from vical_daemon.bus.zenoh_bus import open_bus
    from vical_daemon.config.model import loads
    from vical_daemon.record import role as role
    from vical_daemon.service.wall_clock import private_clock

    record = f"{{directory: {folder}/log, rotate_s: 20, quota_bytes: 400000000, reserve_bytes: 0}}"
    config = loads(f"rig: rig0\nrecord: {record}\n")
    bus = open_bus(mode="client", socket=Path(folder) / "z.sock")
    counts = {kind: _Count() for kind in _KEYS}  # to tell apart what was lost: images may be dropped
    subscriptions = {kind: bus.subscribe(key, counts[kind]) for kind, key in _KEYS.items()}
    stop = threading.Event()
    thread = threading.Thread(target=role.run, args=(config, bus, stop), kwargs={"clock": private_clock()})
    thread.start()
    done.wait()
    seen = {
        kind: (counts[kind].messages, subscription.dropped, counts[kind].longest_s, counts[kind].bursts)
        for kind, subscription in subscriptions.items()
    }
    (Path(folder) / "seen.json").write_text(json.dumps(seen))
    stop.set()
    thread.join()
    bus.close()


def check_segments(log: Path) -> tuple[int, int, int]:
    """Return (holes in the numbers, messages, files) of what the quota has left."""
    numbers: list[int] = []
    paths = sorted(log.glob("*.mcap"))
    for path in paths:
        messages = (x for x in LogReader(path).messages() if x.channel.topic == "/" + _IMU)
        numbers.extend(m.decode_imu(message.payload).stamp_ns for message in messages)
    return int((np.diff(numbers) != 1).sum()), len(numbers), len(paths)


def report(
    seen: list[tuple[Any, ...]],
    sent: dict[str, int],
    received: dict[str, list[Any]],
    status: dict[str, str],
    left: tuple[int, int, int],
) -> None:
    """Print the table."""
    settled = [row for row in seen if row[0] > min(_SETTLE_S, seen[-1][0] / 4)]
    print("| figure | host of the bus | recorder |\n|---|---|---|")
    for i, what in enumerate(("memory, MB", "descriptors", "threads")):
        cells = []
        for process in (1, 2):
            values = [row[process][i] for row in settled]
            tenth = max(1, len(values) // 10)
            first, last = np.mean(values[:tenth]), np.mean(values[-tenth:])
            cells.append(
                f"{first:.1f} -> {last:.1f} ({100 * (last / first - 1):+.1f} %), most {max(values):.1f}"
            )
        print(f"| {what}, after a minute -> at the end | {cells[0]} | {cells[1]} |")
    print("\n| kind | sent by the host | received in the recorder's process | missing | longest pause, s |")
    print("|---|---:|---:|---:|---:|")
    for kind, (messages, gaps, longest_s, _) in received.items():
        print(f"| {kind} | {sent.get(kind, '-')} | {messages} | {gaps} | {longest_s:.2f} |")
    bursts = [(*burst, kind) for kind, row in received.items() if kind != "statuses" for burst in row[3]]
    for at_s, lost, pause_s, kind in sorted(bursts)[:20]:
        print(f"{lost} {kind} missing at {at_s:.0f} s, after a pause of {pause_s:.2f} s")
    holes, kept, segments = left
    print(
        f"\n{seen[-1][0] / 60:.1f} min; {status['lost_on_bus']} messages lost on the bus as the recorder "
        f"counts, {status['dropped']} dropped by it, {status['files_deleted']} files deleted by the quota; "
        f"{holes} holes in the {kept} inertial samples of the {segments} files left."
    )


def _values(sample: Any) -> dict[str, str]:
    return m.decode_diagnostics(sample.payload).statuses[0].values
