"""Memory of the web process over hours of messages: role web on a real bus, with viewers.

A rig sends 5 estimates, 6 statuses and 10 images with points a second. Here it sends them `--speed` times as
fast (images at real rate: they are not kept), so that half an hour stands for hours. A history that fills
looks like a leak until it is full: the growth is printed for each quarter of the run.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from vical_mocks.harness import web_feed

from benchmarks.web_viewers import watch
from vical_daemon.bus.zenoh_bus import open_bus

STATUS_PER_ESTIMATE = 6 / 5
IMAGES_HZ = 10.0


def serve(pipe: Connection, socket: str) -> None:
    """Child: role web as a client of the bus; sends its address, ends on any message."""
    bus, stop = open_bus(mode="client", socket=socket), threading.Event()
    thread = web_feed.serve_page(bus, stop, pipe.send)
    pipe.recv()
    stop.set()
    thread.join()
    bus.close()


def feed(bus: Any, stop: threading.Event, speed: float, sent: list[int]) -> None:
    """Publish like a rig, `speed` times as fast; counts the estimates in `sent`."""
    rng = np.random.default_rng(0)
    begin_s, images = time.monotonic(), 0
    while not stop.is_set():
        elapsed_s = time.monotonic() - begin_s
        due = int(5 * speed * elapsed_s) - sent[0]
        for _ in range(due):
            web_feed.publish_estimate(bus, web_feed.estimate(30.0 + 0.2 * sent[0], rng))
            sent[0] += 1
        for _ in range(int(due * STATUS_PER_ESTIMATE / 2)):  # two statuses a call
            web_feed.publish_status(bus)
        if elapsed_s * IMAGES_HZ > images:
            web_feed.publish_image(bus, images)
            images += 1
        stop.wait(0.02)


def resident_kb(pid: int) -> int:
    """Return the resident memory of a process, kB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    raise ValueError(f"no VmRSS of {pid}")


def look(address: str, done: threading.Event) -> threading.Thread:
    """Start one viewer of the values and one of the pictures."""
    thread = threading.Thread(target=lambda: asyncio.run(watch(address, 1, 1, done)))
    thread.start()
    return thread


def main(argv: list[str]) -> int:
    """Print the memory over time, and the growth in each quarter of the run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks web_memory", description=__doc__)
    parser.add_argument("--seconds", type=float, default=1500.0)
    parser.add_argument("--speed", type=float, default=20.0, help="times the rate of a rig")
    args = parser.parse_args(argv)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    points: list[tuple[float, int, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        socket = str(Path(folder) / "z.sock")
        bus, done, stop, sent = (
            open_bus(mode="router", socket=socket),
            threading.Event(),
            threading.Event(),
            [0],
        )
        child = context.Process(target=serve, args=(theirs, socket))
        child.start()
        address = ours.recv()
        viewers = look(address, done)
        feeder = threading.Thread(target=feed, args=(bus, stop, args.speed, sent))
        feeder.start()
        begin_s = time.monotonic()
        assert child.pid is not None
        while (elapsed_s := time.monotonic() - begin_s) < args.seconds:
            points.append((elapsed_s, sent[0], resident_kb(child.pid)))
            time.sleep(min(5.0, args.seconds / 40))
        for event in (done, stop):
            event.set()
        feeder.join()
        ours.send("end")
        child.join()
        viewers.join()
        bus.close()
    report(points)
    return 0


def report(points: list[tuple[float, int, int]]) -> None:
    """Print memory and growth of each quarter; growth is the slope of a straight line through it."""
    print("| part of the run | estimates sent | as hours of a rig | resident at its end, MB | growth, kB/s |")
    print("|---|---:|---:|---:|---:|")
    for k, part in enumerate(np.array_split(np.array(points, dtype=float), 4)):
        slope = np.polyfit(part[:, 0], part[:, 2], 1)[0]
        sent = int(part[-1, 1])
        print(f"| quarter {k + 1} | {sent} | {sent / 5 / 3600:.1f} | {part[-1, 2] / 1e3:.1f} | {slope:.2f} |")


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))
