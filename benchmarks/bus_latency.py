"""How late messages arrive through the router, and what that costs: one client sends, another receives.

python -m benchmarks bus_latency --seconds 10
"""

from __future__ import annotations

import argparse
import multiprocessing as mp
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics

_CONTEXT = mp.get_context("spawn")


def main(argv: list[str]) -> int:
    """One row for each kind of message."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks bus_latency")
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args(argv)
    print("| message | sent | lost | age p50 / p99 / max ms | processor sender / receiver, % of a core |")
    print("|---|---|---|---|---|")
    pixels = np.zeros((480, 752), np.uint8)
    large = np.zeros((1024, 1280), np.uint8)
    kinds: list[tuple[str, str, float, Any]] = [
        ("Imu, 324 B, 1000 Hz", topics.IMU.key("rig0", "imu0"), 1000.0, _imu),
        ("Image 752 x 480, 30 Hz", topics.IMAGE.key("rig0", "cam0"), 30.0, lambda t: _image(t, pixels)),
        ("Image 1280 x 1024, 30 Hz", topics.IMAGE.key("rig0", "cam0"), 30.0, lambda t: _image(t, large)),
    ]
    for name, key, rate_hz, build in kinds:
        print(row(name, key, rate_hz, build, args.seconds), flush=True)
    return 0


def _imu(t_ns: int) -> bytes:
    return m.encode_imu(t_ns, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))


def _image(t_ns: int, pixels: Any) -> bytes:
    return m.encode_image(t_ns, "cam0", pixels, "mono8")


def row(name: str, key: str, rate_hz: float, build: Any, seconds: float) -> str:
    """Send at a rate from the process that hosts the bus, as `acquire` does."""
    from vical_daemon.bus.zenoh_bus import open_bus

    with tempfile.TemporaryDirectory() as folder:
        socket = str(Path(folder) / "z.sock")
        bus = open_bus(mode="router", socket=socket)
        here, there = _CONTEXT.Pipe()
        process = _CONTEXT.Process(target=receive, args=(socket, key, there))
        process.start()
        here.recv()
        begin_s, cpu_s, sent = time.monotonic(), time.process_time(), 0
        while sent < seconds * rate_hz:
            wait_s = begin_s + sent / rate_hz - time.monotonic()
            if wait_s > 0:
                time.sleep(wait_s)
            bus.publish(key, build(time.monotonic_ns()))
            sent += 1
        cpu_s = time.process_time() - cpu_s
        time.sleep(0.5)
        here.send("report")
        ages_ms, their_cpu_s = here.recv()
        process.join()
        bus.close()
    age = f"{np.median(ages_ms):.2f} / {np.percentile(ages_ms, 99):.2f} / {max(ages_ms):.1f}"
    return (
        f"| {name} | {sent} | {sent - len(ages_ms)} | {age} "
        f"| {100 * cpu_s / seconds:.0f} / {100 * their_cpu_s / seconds:.0f} |"
    )


def receive(socket: str, key: str, pipe: Connection) -> None:
    """Note the age of every message by its stamp (both processes share CLOCK_MONOTONIC)."""
    from vical_daemon.bus.zenoh_bus import open_bus
    from vical_daemon.logs.channel import stamp_of

    bus = open_bus(mode="client", socket=socket)
    ages_ms: list[float] = []
    bus.subscribe(key, lambda s: ages_ms.append((time.monotonic_ns() - (stamp_of(s.payload) or 0)) * 1e-6))
    time.sleep(0.5)
    cpu_s = time.process_time()
    pipe.send("ready")
    pipe.recv()
    pipe.send((ages_ms, time.process_time() - cpu_s))
    bus.close()
