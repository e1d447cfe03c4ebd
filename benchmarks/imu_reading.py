"""Reading the IMU on a real pseudo terminal at 1000 Hz, onto the real bus, while others load every core."""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import Any, cast

import numpy as np
from vical_drivers.microstrain.device import MicrostrainImu, open_imu
from vical_drivers.samples import ImuSample

from vical_daemon.acquire import imu as imu_role
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.config import model as config_module
from vical_daemon.service.wall_clock import WallClock

KEY = "vical/bench/imu/imu0"
COLUMNS = (
    "load", "samples", "lost", "missed by the subscriber", "most in one read",
    "read -> bus: median us", "p99", "max",
    "read -> subscriber in another process: median us", "p99", "CPU of the process, % of a core",
    "a bare wake-up of a thread: median us", "p99", "max",
)  # fmt: skip


def main(argv: list[str]) -> int:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(prog="benchmarks imu_reading", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--fifo", action="store_true", help="real-time scheduling, as the service has it")
    parser.add_argument("--protocol", choices=("single-byte", "mip"), default="single-byte")
    parser.add_argument("--no-bus", action="store_true", help="the bus in memory: the driver's part alone")
    parser.add_argument("--floor", action="store_true", help="with each case: only read and publish")
    parser.add_argument("--freeze", action="store_true", help="stop the subscriber (SIGSTOP) after 8 s")
    parser.add_argument("--only-floor", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--acquire", default="", help=argparse.SUPPRESS)  # the process under test: a port
    parser.add_argument("--subscribe", default="", help=argparse.SUPPRESS)  # the recorder's place: a socket
    parser.add_argument("--socket", default="", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.acquire:
        return _acquire(args)
    if args.subscribe:
        return _subscribe(args.subscribe)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for busy in (0, os.cpu_count() or 2):
        print(_case(busy, args), flush=True)
        if args.floor:
            print(_case(busy, argparse.Namespace(**vars(args) | {"only_floor": True})), flush=True)
    return 0


def _case(busy: int, args: argparse.Namespace) -> str:
    emulator = subprocess.Popen(
        [
            *_realtime(51, args.fifo), sys.executable, "-m", "vical_mocks.gx3_emulator",
            "--link", "direct", "--protocol", args.protocol,
        ],
        stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    assert emulator.stdout is not None
    port = emulator.stdout.readline().strip()
    load = [multiprocessing.Process(target=_burn, daemon=True) for _ in range(busy)]
    for process in load:
        process.start()
    with tempfile.TemporaryDirectory() as folder:
        socket = "" if args.no_bus else str(Path(folder) / "bus")
        try:
            r = _measure(port, socket, args)
        finally:
            for process in load:
                process.kill()
            emulator.terminate()
            emulator.wait()
            emulator.stdout.close()
    cells = [
        (f"{busy} busy processes" if busy else "idle") + ", floor" * args.only_floor,
        *(f"{r[k]}" for k in ("samples", "lost", "missed", "bunch")),
        *_spread(r["to_bus_us"]), *_spread(r["to_subscriber_us"])[:2], f"{100 * r['cpu']:.1f}",
        *_spread(r["wake_up_us"]),
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def _measure(port: str, socket: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run the process under test and its subscriber; join what both noted of each sample."""
    me = [sys.executable, "-m", "benchmarks", "imu_reading"]
    acquire = subprocess.Popen(
        [
            *me, "--acquire", port, "--rate", str(args.rate), "--seconds", str(args.seconds),
            "--socket", socket, *(["--fifo"] if args.fifo else []),
            *(["--only-floor"] if args.only_floor else []),
        ],
        stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    received: dict[int, int] = {}
    if socket:
        command = [*_realtime(40, args.fifo), *me, "--subscribe", socket]
        subscriber = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        if args.freeze:
            time.sleep(8.0)
            subscriber.send_signal(signal.SIGSTOP)
        else:
            received = dict(json.loads(subscriber.communicate()[0].splitlines()[-1]))
    answer, _ = acquire.communicate()
    if args.freeze:
        subscriber.kill()
        subscriber.communicate()
    r: dict[str, Any] = json.loads(answer.splitlines()[-1])
    # The first second is held back on purpose, until the clock is known; then the subscriber arrives.
    skip = max(int(1.5 * args.rate), min(received, default=0))
    arrivals, published = np.array(r.pop("arrivals")), np.array(r.pop("published"))
    count = min(len(arrivals), len(published))
    numbers = [n for n in range(skip, count) if n in received]
    return r | {
        "samples": count - skip,
        "lost": r["lost"] + len(arrivals) - len(published),
        "missed": count - skip - len(numbers) if received else "-",
        # Bunches are the device's and the machine's: they wait for one another on their way to the bus.
        "bunch": int(np.unique(arrivals[skip:count], return_counts=True)[1].max()),
        "to_bus_us": (published[skip:count] - arrivals[skip:count]) * 1e-3,
        "to_subscriber_us": np.array([received[n] - arrivals[n] for n in numbers]) * 1e-3,
    }


def _spread(values_us: Sequence[float]) -> list[str]:
    if not len(values_us):
        return ["-"] * 3
    return [f"{v:.0f}" for v in (*np.percentile(values_us, [50, 99]), np.max(values_us))]


def _realtime(priority: int, fifo: bool) -> list[str]:
    return ["chrt", "-f", str(priority)] if fifo else []


def _burn() -> None:
    matrix = np.random.default_rng(0).normal(size=(150, 150))
    while True:
        matrix = np.tanh(matrix @ matrix * 1e-2)


class _Noted(MicrostrainImu):
    """The driver, noting when each sample was read."""

    arrivals: list[int]

    def read(self, timeout_s: float) -> list[ImuSample]:
        samples = MicrostrainImu.read(self, timeout_s)
        for sample in samples:
            self.arrivals.append(sample.t_arrival_ns)
        return samples


class _NotedBus:
    """A bus, noting when it had each sample."""

    def __init__(self, bus: Any) -> None:
        self.bus = bus
        self.published: list[int] = []

    def publish(self, key: str, payload: bytes) -> None:
        self.bus.publish(key, payload)
        if key == KEY:
            self.published.append(time.monotonic_ns())


def _read_and_publish(source: _Noted, bus: _NotedBus, stop: threading.Event) -> None:
    """The floor: for each sample one read and one publication of 324 bytes, and nothing in between."""
    port, payload = cast("Any", source)._session._port, bytes(324)
    while not stop.is_set():
        data, t_read_ns = port.read(0.2)
        for _ in range(len(data) // 31):
            source.arrivals.append(t_read_ns)
            bus.publish(KEY, payload)
    source.close()


def _acquire(args: argparse.Namespace) -> int:
    """The process `acquire` as the service runs it: bus router, device thread, encoder."""
    from vical_daemon.bus.zenoh_bus import open_bus

    port, rate_hz, seconds, socket = args.acquire, args.rate, args.seconds, args.socket
    if args.fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    rig = config_module.loads(f"rig: bench\nimus:\n  imu0:\n    port: {port}\n    rate_hz: {rate_hz:g}\n")
    sources: list[_Noted] = []

    def open_source(imu: config_module.ImuConfig) -> MicrostrainImu:
        source = open_imu(imu.port, rate_hz=imu.rate_hz)
        source.__class__ = _Noted
        assert isinstance(source, _Noted)
        source.arrivals = []
        sources.append(source)
        return source

    real = open_bus(mode="router", socket=socket) if socket else LocalBus()
    bus, stop = _NotedBus(real), threading.Event()
    role = threading.Thread(
        target=imu_role.run, args=(rig, bus, stop),
        kwargs={"clock": WallClock(0), "open_source": open_source},
    )  # fmt: skip
    if args.only_floor:
        role = threading.Thread(target=_read_and_publish, args=(open_source(rig.imus["imu0"]), bus, stop))
    gc.collect()
    gc.freeze()  # as `vical run` does
    role.start()
    time.sleep(3.0)
    cpu_s, start_s = time.process_time(), time.monotonic()
    time.sleep(seconds)
    cpu = (time.process_time() - cpu_s) / (time.monotonic() - start_s)
    stop.set()
    role.join()
    time.sleep(0.3)
    real.close()
    result = {
        "arrivals": sources[0].arrivals,
        "published": bus.published,
        "lost": sources[0].stats().lost,
        "cpu": cpu,
        "wake_up_us": _wake_ups(1.0 / rate_hz, min(seconds, 10.0)),
    }
    print(json.dumps(result))
    return 0


def _wake_ups(period_s: float, seconds: float) -> list[float]:
    """How long one thread needs to wake another, with nothing else in the process, us: the machine's part."""
    waiting: SimpleQueue[int] = SimpleQueue()
    late_us: list[float] = []

    def wait() -> None:
        while (sent_ns := waiting.get()) >= 0:
            late_us.append((time.monotonic_ns() - sent_ns) * 1e-3)

    thread = threading.Thread(target=wait)
    thread.start()
    for _ in range(int(seconds / period_s)):
        time.sleep(period_s)
        waiting.put(time.monotonic_ns())
    waiting.put(-1)
    thread.join()
    return late_us


def _subscribe(socket: str) -> int:
    """What stands where the recorder does: note when each sample came, until the bus is gone."""
    from vical_daemon.bus.zenoh_bus import BusError, ZenohBus, open_bus

    bus: ZenohBus | None = None
    while bus is None:
        try:
            bus = open_bus(mode="client", socket=socket)
        except BusError:
            time.sleep(0.05)
    received: list[tuple[int, int]] = []
    bus.subscribe(KEY, _note_into(received))
    while bus.connected:
        time.sleep(0.2)
    bus.close()
    print(json.dumps(received))
    return 0


def _note_into(received: list[tuple[int, int]]) -> Callable[[Sample], None]:
    return lambda sample: received.append((sample.sequence, time.monotonic_ns()))
