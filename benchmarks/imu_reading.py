"""Reading the IMU on a real pseudo terminal at 1000 Hz while another process loads every core."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
from vical_drivers.microstrain.device import MicrostrainImu, open_imu
from vical_drivers.samples import ImuSample

from vical_daemon import config as config_module
from vical_daemon.bus import LocalBus, Sample
from vical_daemon.roles import imu as imu_role
from vical_daemon.wall_clock import WallClock


def main(argv: list[str]) -> int:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(prog="benchmarks imu_reading", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--acquire", default="", help=argparse.SUPPRESS)  # the process under test: a port
    parser.add_argument("--fifo", action="store_true", help="real-time scheduling, as the service has it")
    args = parser.parse_args(argv)
    if args.acquire:
        return _acquire(args.acquire, args.rate, args.seconds, fifo=args.fifo)
    print("| load | samples | lost | read -> bus median us | p99 | max | CPU of the process |")
    print("|---|---|---|---|---|---|---|")
    for busy in (0, os.cpu_count() or 2):
        print(_case(busy, args.seconds, args.rate, fifo=args.fifo), flush=True)
    return 0


def _case(busy: int, seconds: float, rate_hz: float, *, fifo: bool) -> str:
    emulator = subprocess.Popen(
        [*_realtime(fifo), sys.executable, "-m", "vical_mocks.gx3_emulator", "--link", "direct"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert emulator.stdout is not None
    port = emulator.stdout.readline().strip()
    load = [multiprocessing.Process(target=_burn, daemon=True) for _ in range(busy)]
    for process in load:
        process.start()
    command = [sys.executable, "-m", "benchmarks", "imu_reading", "--acquire", port]
    command += ["--rate", str(rate_hz), "--seconds", str(seconds), *(["--fifo"] if fifo else [])]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    finally:
        for process in load:
            process.kill()
        emulator.terminate()
        emulator.wait()
        emulator.stdout.close()
    r = json.loads(answer.splitlines()[-1])
    name = f"{busy} busy processes" if busy else "idle"
    return (
        f"| {name} | {r['samples']} | {r['lost']} | {r['median']:.0f} | {r['p99']:.0f} | {r['max']:.0f} "
        f"| {100 * r['cpu']:.1f} % |"
    )


def _realtime(fifo: bool) -> list[str]:
    return ["chrt", "-f", "51"] if fifo else []


def _burn() -> None:
    matrix = np.random.default_rng(0).normal(size=(150, 150))
    while True:
        matrix = np.tanh(matrix @ matrix * 1e-2)


class _Noted(MicrostrainImu):
    """The driver, noting when each sample was read."""

    arrivals: list[int]

    def read(self, timeout_s: float) -> list[ImuSample]:
        samples = super().read(timeout_s)
        self.arrivals += [s.t_arrival_ns for s in samples]
        return samples


def _acquire(port: str, rate_hz: float, seconds: float, *, fifo: bool) -> int:
    """The role `imu` as `vical run acquire` runs it: device thread, queue, encoder, bus."""
    if fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    rig = config_module.loads(f"rig: bench\nimus:\n  imu0:\n    port: {port}\n    rate_hz: {rate_hz:g}\n")
    sources: list[MicrostrainImu] = []

    def open_source(imu: config_module.ImuConfig) -> MicrostrainImu:
        source = open_imu(imu.port, rate_hz=imu.rate_hz)
        source.__class__ = _Noted
        source.arrivals = []  # type: ignore[attr-defined]
        sources.append(source)
        return source

    published: list[int] = []
    bus, stop = LocalBus(), threading.Event()
    bus.subscribe("vical/bench/imu/imu0", _note_into(published))
    role = threading.Thread(target=imu_role.run, args=(rig, bus, stop), kwargs={
        "clock": WallClock(0), "open_source": open_source,
    })  # fmt: skip
    role.start()
    time.sleep(3.0)
    cpu_s, start_s = time.process_time(), time.monotonic()
    time.sleep(seconds)
    cpu = (time.process_time() - cpu_s) / (time.monotonic() - start_s)
    stop.set()
    role.join()
    arrivals = sources[0].arrivals  # type: ignore[attr-defined]
    count = min(len(arrivals), len(published))
    # The first second is held back on purpose, until the clock is known.
    skip = int(1.5 * rate_hz)
    latency_us = (np.array(published[:count]) - np.array(arrivals[:count]))[skip:] * 1e-3
    stats = sources[0].stats()
    result = {
        "samples": count - skip,
        "lost": stats.lost + len(arrivals) - len(published),
        "median": float(np.median(latency_us)),
        "p99": float(np.percentile(latency_us, 99)),
        "max": float(latency_us.max()),
        "cpu": cpu,
    }
    print(json.dumps(result))
    return 0


def _note_into(published: list[int]) -> Callable[[Sample], None]:
    return lambda _sample: published.append(time.monotonic_ns())
