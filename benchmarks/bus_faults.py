"""Acquisition next to frozen, slow, dying and hostile clients of the bus: what it costs the sensors.

    python -m benchmarks bus_faults --seconds 8

This process hosts the bus and publishes 1000 Hz inertial data and 30 Hz images of 360 kB, as `acquire`
does. A good subscriber in a process of its own counts what arrives and how late. Meanwhile, one fault
at a time. Last, a calibration runs in processes of its own with junk on all keys (`bus_calibration`):

    python -m benchmarks bus_faults --only calibration
"""

from __future__ import annotations

import argparse
import multiprocessing as mp
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bus_calibration import calibrating
from vical_daemon.bus import messages as m
from vical_daemon.bus import topics

IMU, IMAGE = topics.IMU.key("rig0", "imu0"), topics.IMAGE.key("rig0", "cam0")
JUNK = 1_000_000
CALIBRATION_JUNK = 100_000
_CONTEXT = mp.get_context("spawn")


def main(argv: list[str]) -> int:
    """One row for each fault."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks bus_faults")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--junk", type=int, default=JUNK)
    parser.add_argument("--calibration-junk", type=int, default=CALIBRATION_JUNK, help="junk messages")
    parser.add_argument("--only", nargs="+", help="names of faults, restart, or calibration")
    args = parser.parse_args(argv)
    faults: dict[str, Callable[[Path, float], list[Any]]] = {
        "none": lambda _, __: [],
        "frozen subscriber (SIGSTOP)": lambda socket, _: [_freeze(_start(subscribe_slowly, socket, 0.0))],
        "slow subscriber (5 ms a message)": lambda socket, _: [_start(subscribe_slowly, socket, 0.005)],
        "subscriber killed with -9 every 2 s": _die_again_and_again,
        f"{args.junk} malformed messages on our keys": lambda socket, _: [
            _start(publish_junk, socket, args.junk)
        ],
    }
    chosen = [name for name in (*faults, "restart", "calibration") if _wanted(name, args.only)]
    lost = _scenarios({name: fault for name, fault in faults.items() if name in chosen}, args.seconds)
    if "restart" in chosen:
        print()
        router_restart()
    held = True
    if "calibration" in chosen:
        rows, held = calibrating(args.calibration_junk)
        print("\n| figure | value |\n|---|---|")
        for what, value in rows:
            print(f"| {what} | {value} |")
    return int(lost > 0 or not held)


def _wanted(name: str, words: list[str] | None) -> bool:
    return not words or any(word in name for word in words)


def _scenarios(faults: dict[str, Callable[[Path, float], list[Any]]], seconds: float) -> int:
    """One row for each fault; inertial samples lost during all of them."""
    if not faults:
        return 0
    print("| fault | imu sent | lost | rejected | publish p50 / p99 / max ms | age p50 / p99 / max ms "
          "| images sent / got | RSS host MB |\n|---|---|---|---|---|---|---|---|")  # fmt: skip
    lost = 0
    for name, fault in faults.items():
        row = scenario(fault, seconds)
        lost += row["lost"] if name != "none" else 0
        print(f"| {name} | {row['sent']} | {row['lost']} | {row['refused']} | {_three(row['publish_ms'])} "
              f"| {_three(row['age_ms'])} | {row['images_sent']} / {row['images']} | {row['rss_mb']:.0f} |",
              flush=True)  # fmt: skip
    return lost


def scenario(fault: Callable[[Path, float], list[Any]], seconds: float) -> dict[str, Any]:
    """Publish for some seconds during a fault and return what the good subscriber saw."""
    from vical_daemon.bus.zenoh_bus import open_bus

    with tempfile.TemporaryDirectory() as folder:
        socket = Path(folder) / "z.sock"
        bus = open_bus(mode="router", socket=socket)
        here, there = _CONTEXT.Pipe()
        good = _CONTEXT.Process(target=subscribe_well, args=(str(socket), there))
        good.start()
        here.recv()  # it listens
        helpers = fault(socket, seconds)
        if helpers:
            time.sleep(1.0)
        published = publish(bus, seconds, lambda: any(_busy(h) for h in helpers if h.name == "publish_junk"))
        time.sleep(0.5)
        here.send("report")
        seen = here.recv()
        good.join()
        for helper in helpers:
            _end(helper)
        bus.close()
    return published | seen | {"lost": published["sent"] - seen["imu"]}


def publish(bus: Any, seconds: float, busy: Callable[[], bool]) -> dict[str, Any]:
    """1000 Hz and 30 Hz on one clock; `busy`: go on until the fault has run its course."""
    image = m.encode_image(1, "cam0", np.zeros((480, 752), np.uint8), "mono8")
    durations: list[float] = []
    begin_s, sent, images = time.monotonic(), 0, 0
    imu_thread_done = threading.Event()

    def images_loop() -> None:
        nonlocal images
        while not imu_thread_done.wait(1 / 30):
            bus.publish(IMAGE, image)
            images += 1

    thread = threading.Thread(target=images_loop)
    thread.start()
    while (elapsed_s := time.monotonic() - begin_s) < seconds or (busy() and elapsed_s < 120):
        while sent < elapsed_s * 1000:
            payload = m.encode_imu(time.monotonic_ns(), "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))
            before_s = time.perf_counter()
            bus.publish(IMU, payload)
            durations.append(time.perf_counter() - before_s)
            sent += 1
        time.sleep(0.0005)
    imu_thread_done.set()
    thread.join()
    return {"sent": sent, "images_sent": images, "publish_ms": np.array(durations) * 1e3, "rss_mb": _rss_mb()}


def subscribe_well(socket: str, pipe: Connection) -> None:
    """Count good samples and their age; refuse junk."""
    from vical_daemon.bus.zenoh_bus import open_bus

    bus = open_bus(mode="client", socket=socket)
    ages, refused, images = [], 0, 0

    def on_imu(sample: Any) -> None:
        nonlocal refused
        try:
            ages.append(time.monotonic_ns() - m.decode_imu(sample.payload).stamp_ns)
        except m.MessageError:
            refused += 1

    def on_image(sample: Any) -> None:
        nonlocal images
        images += len(sample.payload) > 1000  # the rest is junk

    bus.subscribe(IMU, on_imu)
    bus.subscribe(IMAGE, on_image)
    time.sleep(0.5)
    pipe.send("ready")
    pipe.recv()
    pipe.send({"imu": len(ages), "refused": refused, "images": images, "age_ms": np.array(ages) * 1e-6})
    bus.close()


def subscribe_slowly(socket: str, seconds_each: float) -> None:
    """Take everything, slowly."""
    from vical_daemon.bus.zenoh_bus import open_bus

    bus = open_bus(mode="client", socket=socket)
    bus.subscribe("vical/**", lambda _: time.sleep(seconds_each))
    time.sleep(600)


def publish_junk(socket: str, count: int) -> None:
    """Send rubbish of all sizes to every key of ours, as fast as it goes."""
    from vical_daemon.bus.zenoh_bus import open_bus

    bus = open_bus(mode="client", socket=socket)
    keys = [topic.key("rig0", "imu0" if topic.kind == "imu" else "cam0") for topic in topics.TOPICS]
    rng = np.random.default_rng(1)
    rubbish = [rng.integers(0, 256, int(n), dtype=np.uint8).tobytes() for n in rng.integers(0, 400, 97)]
    for i in range(count):
        bus.publish(keys[i % len(keys)], rubbish[i % 97])
    bus.close()


def _die_again_and_again(socket: Path, seconds: float) -> list[Any]:
    """A client that is killed every 2 s."""
    helpers = [_start(subscribe_slowly, socket, 0.0) for _ in range(int(seconds / 2))]

    def kill() -> None:
        for helper in helpers:
            time.sleep(2.0)
            helper.kill()

    threading.Thread(target=kill, daemon=True).start()
    return helpers


def _start(target: Callable[..., None], socket: Path, option: float) -> Any:
    process = _CONTEXT.Process(target=target, args=(str(socket), option), name=target.__name__, daemon=True)
    process.start()
    return process


def _freeze(process: Any) -> Any:
    time.sleep(2.0)
    os.kill(process.pid, signal.SIGSTOP)
    return process


def _busy(process: Any) -> bool:
    return bool(process.is_alive())


def _end(process: Any) -> None:
    if process.is_alive():
        process.kill()
    process.join()


def _rss_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _three(values: Any) -> str:
    if not len(values):
        return "-"
    return f"{np.median(values):.2f} / {np.percentile(values, 99):.2f} / {values.max():.1f}"


def router_restart(times: int = 5) -> None:
    """Close and open the router under two clients; how long until samples flow again."""
    from vical_daemon.bus.zenoh_bus import open_bus

    gaps, worst_publish = [], 0.0
    with tempfile.TemporaryDirectory() as folder:
        socket = Path(folder) / "z.sock"
        router = open_bus(mode="router", socket=socket)
        sender, receiver = (open_bus(mode="client", socket=socket) for _ in range(2))
        subscription = receiver.subscribe(IMU)
        for _ in range(times):
            router.close()
            time.sleep(1.0)
            router = open_bus(mode="router", socket=socket)
            begin_s = time.monotonic()
            while subscription.recv(0) is not None:
                pass
            while subscription.recv(0.002) is None:
                before_s = time.perf_counter()
                sender.publish(IMU, b"x")
                worst_publish = max(worst_publish, time.perf_counter() - before_s)
            gaps.append(time.monotonic() - begin_s)
        for bus in (sender, receiver, router):
            bus.close()
    print(
        f"Router restarted {times} times: samples flow again {np.median(gaps):.2f} s (at most "
        f"{max(gaps):.2f} s) after it is back; publish never took longer than {worst_publish * 1e3:.1f} ms."
    )
