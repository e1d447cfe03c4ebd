"""Processor time of the page with 0 and 4 viewers, fed like a rig: 5 Hz estimates, 10 Hz images.

The bus hands messages over in the thread that publishes them; what that thread uses is the data path, which
a page that nobody looks at would have as well. The rest is the page: values, pictures, HTTP.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import resource
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import aiohttp
import numpy as np
from vical_mocks.harness import web_feed

from vical_daemon.bus.interface import LocalBus
from vical_daemon.vision.target import Checkerboard


def serve(pipe: Connection, seconds: float, board: Path) -> None:
    """Child: role web over a LocalBus; sends its address, then CPU seconds of the page and of the bus."""
    recorded = LocalBus()
    messages: list[tuple[str, bytes]] = []
    recorded.subscribe("vical/**", lambda sample: messages.append((sample.key, sample.payload)))
    rng, steps = np.random.default_rng(0), []
    for k in range(int(10 * seconds)):  # made before the measurement: it is the page that is measured
        messages.clear()
        web_feed.publish_image(recorded, k)
        if k % 2:
            web_feed.publish_estimate(recorded, web_feed.estimate(0.1 * k, rng))
        if k % 10 == 0:
            web_feed.publish_status(recorded)
        steps.append(list(messages))
    bus, stop = LocalBus(), threading.Event()
    thread = web_feed.serve_page(bus, stop, pipe.send, board)
    pipe.recv()  # viewers are there
    begin, begin_bus = _cpu_s(), time.thread_time()
    for step in steps:
        for key, payload in step:
            bus.publish(key, payload)
        time.sleep(0.1)
    bus_s = time.thread_time() - begin_bus
    pipe.send((_cpu_s() - begin - bus_s, bus_s))
    stop.set()
    thread.join()


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


async def watch(address: str, events: int, pictures: int, done: threading.Event) -> int:
    """Read events and pictures like so many browsers; returns the bytes received."""
    received = 0

    async def read(url: str) -> None:
        nonlocal received
        async with session.get(url) as answer:
            async for chunk in answer.content.iter_any():
                received += len(chunk)

    async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(None)) as session:
        urls = [address + "events"] * events + [address + "camera/cam0/events"] * pictures
        tasks = [asyncio.create_task(read(url)) for url in urls]
        while not done.is_set():
            await asyncio.sleep(0.1)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return received


def measure(events: int, pictures: int, seconds: float, board: Path) -> tuple[float, float, float]:
    """Return CPU shares of page and bus, and kB/s received by the viewers."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    child = multiprocessing.get_context("spawn").Process(target=serve, args=(theirs, seconds, board))
    child.start()
    address = ours.recv()
    done, result = threading.Event(), []
    thread = threading.Thread(
        target=lambda: result.append(asyncio.run(watch(address, events, pictures, done)))
    )
    thread.start()
    time.sleep(1.0)
    begin = time.monotonic()
    ours.send("go")
    page_s, bus_s = ours.recv()
    elapsed = time.monotonic() - begin
    done.set()
    thread.join()
    child.join()
    return page_s / elapsed, bus_s / elapsed, result[0] / elapsed / 1e3


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks web_viewers", description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args(argv)
    print("| viewers of values | of pictures | page, % of a core | data path, % | sent, kB/s |")
    print("|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        board = Path(folder) / "board.yaml"
        board.write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
        for events, pictures in ((0, 0), (1, 0), (4, 0), (1, 1), (4, 4)):
            page, bus, rate = measure(events, pictures, args.seconds, board)
            print(f"| {events} | {pictures} | {100 * page:.2f} | {100 * bus:.2f} | {rate:.0f} |", flush=True)
    return 0
