"""The way of an image: driver -> bus -> recorder in processes of their own, with an estimator's load."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

CASES = (((1280, 1024), 60.0), ((640, 480), 30.0))
EXPOSURE_S, READOUT_S, TRANSFER_S = 0.004, 0.008, 0.0004
KEY = "vical/bench/camera/cam0/image"


def main(argv: list[str]) -> int:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(prog="benchmarks camera_path", description=__doc__)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--no-load", action="store_true", help="without the estimator's load")
    args = parser.parse_args(argv)
    columns = (
        "camera",
        "frames",
        "lost in the driver",
        "not sent",
        "missed by the recorder",
        "recorded MB/s",
        "CPU acquire (with the stand-in) / record, % of a core",
        "capture to subscriber p50 / p99, ms",
    )
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for size, rate_hz in CASES:
        print(_run(size, rate_hz, args.seconds, load=not args.no_load), flush=True)
    return 0


def _run(size: tuple[int, int], rate_hz: float, seconds: float, *, load: bool) -> str:
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        stop, ready = context.Event(), context.Barrier(3)
        answers = context.Queue()
        common = (folder, stop, ready, answers)
        workers = [context.Process(target=_acquire, args=(*common, size, rate_hz))]
        workers.append(context.Process(target=_record, args=common))
        if load:
            workers.append(context.Process(target=_estimate, args=(stop,)))
        for worker in workers:
            worker.start()
        ready.wait(60)
        time.sleep(seconds)
        stop.set()
        found: dict[str, Any] = {}
        for _ in range(2):
            found.update(answers.get(timeout=60))
        for worker in workers:
            worker.join(20)
    latency = np.array(found["latency_ms"])
    p50, p99 = np.percentile(latency[len(latency) // 10 :], [50, 99])
    cells = (
        f"{size[0]}x{size[1]} mono8 at {rate_hz:g} Hz",
        *(str(found[key]) for key in ("frames", "lost", "unsent", "missed")),
        f"{found['bytes'] / found['elapsed_s'] / 1e6:.1f}",
        f"{found['acquire_cpu']:.1f} / {found['record_cpu']:.1f}",
        f"{p50:.2f} / {p99:.2f}",
    )
    return "| " + " | ".join(cells) + " |"


def _acquire(folder: str, stop: Any, ready: Any, answers: Any, size: tuple[int, int], rate_hz: float) -> None:
    """The process `acquire`: hosts the bus, runs the camera role on a fake kernel in real time."""
    from vical_drivers.camera import CameraSettings
    from vical_drivers.camera.v4l2.camera import V4l2Camera
    from vical_mocks.v4l2_camera import FakeCamera
    from vical_mocks.v4l2_kernel import FakeKernel, RealClock

    from vical_daemon.acquire.camera import QUEUE_DEPTH, CameraEncoder
    from vical_daemon.acquire.publish_queue import PublishQueue
    from vical_daemon.bus.interface import Bus
    from vical_daemon.bus.zenoh_bus import open_bus
    from vical_daemon.service.wall_clock import WallClock

    camera = FakeCamera(
        formats={"GREY": {size: (rate_hz,)}}, static=True, transfer_ns=round(TRANSFER_S * 1e9)
    )
    (Path(folder) / "kernel").mkdir()
    kernel = FakeKernel(Path(folder) / "kernel", RealClock())
    path = kernel.plug(camera)
    settings = CameraSettings(exposure_s=EXPOSURE_S, readout_s=READOUT_S, borrow=True)
    bus: Bus = open_bus(mode="router", socket=Path(folder) / "bus")
    role, queue = CameraEncoder("bench", "cam0", WallClock(0)), PublishQueue(bus, QUEUE_DEPTH, "out")
    ready.wait(60)
    time.sleep(0.5)  # the subscription has to get here first
    cpu_s, started = time.process_time(), time.monotonic()
    with V4l2Camera(path, settings, kernel=kernel) as source:
        while not stop.is_set():
            frame = source.read(0.2)
            payload = role.message(frame) if frame is not None else None
            if payload is not None:
                queue.put(KEY, payload)
        stats = source.stats()
    elapsed_s = time.monotonic() - started
    cpu_s = time.process_time() - cpu_s
    time.sleep(0.5)
    queue.close()
    answers.put({
        "frames": stats.samples, "lost": stats.lost, "unsent": queue.dropped, "sent": queue.published,
        "acquire_cpu": 100 * cpu_s / elapsed_s,
    })  # fmt: skip
    time.sleep(1.0)
    bus.close()


def _record(folder: str, stop: Any, ready: Any, answers: Any) -> None:
    """The process `record`: subscribes to everything of the camera and writes MCAP, flushed each second."""
    from vical_daemon.bus.messages import decode_image
    from vical_daemon.bus.zenoh_bus import BusError, open_bus
    from vical_daemon.logs.mcap.writer import LogWriter

    for _ in range(100):
        try:
            bus = open_bus(mode="client", socket=Path(folder) / "bus")
            break
        except BusError:
            time.sleep(0.1)
    samples = bus.subscribe(KEY, depth=32)
    ready.wait(60)
    cpu_s, started = time.process_time(), time.monotonic()
    late_ns = round((EXPOSURE_S / 2 + READOUT_S + TRANSFER_S) * 1e9)
    latency_ms, total, flushed = [], 0, time.monotonic()
    with LogWriter(Path(folder) / "log.mcap") as log:
        while True:
            sample = samples.recv(0.3)
            now_ns = time.monotonic_ns()
            if sample is None and stop.is_set():
                break
            if sample is not None:
                stamp_ns = decode_image(sample.payload).stamp_ns
                latency_ms.append((now_ns - stamp_ns - late_ns) * 1e-6)
                log.write(sample.key, sample.payload, stamp_ns)
                total += len(sample.payload)
            if now_ns * 1e-9 - flushed > 1.0:
                log.flush()
                flushed = now_ns * 1e-9
    elapsed_s = time.monotonic() - started
    answers.put({
        "missed": samples.dropped, "bytes": total, "elapsed_s": elapsed_s, "latency_ms": latency_ms,
        "record_cpu": 100 * (time.process_time() - cpu_s) / elapsed_s, "recorded": len(latency_ms),
    })  # fmt: skip
    samples.close()
    bus.close()


def _estimate(stop: Any) -> None:
    """The process `calibrate`: one core is never idle, in small matrices as a filter's."""
    import os

    os.nice(5)
    matrix = np.random.default_rng(0).normal(size=(60, 60))
    while not stop.is_set():
        for _ in range(200):
            np.linalg.qr(matrix @ matrix.T)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
