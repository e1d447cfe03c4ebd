"""Many robots on one site router: does a subscriber of the site see all, and what does the router cost.

    python -m benchmarks many_rigs --rigs 50 --seconds 20

Each rig is a zenoh client with status (1 Hz, three roles), calibration (5 Hz) and inertial data (100 Hz)
under its own key; ten rigs share a process. The subscriber of the site takes everything.
"""

from __future__ import annotations

import argparse
import multiprocessing as mp
import os
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.estimation.result import CalibrationEstimate, Status

_CONTEXT = mp.get_context("spawn")
_RIGS_PER_PROCESS = 10


def main(argv: list[str]) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks many_rigs")
    parser.add_argument("--rigs", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args(argv)
    from vical_daemon.bus.zenoh_bus import open_bus
    from vical_daemon.client import Client

    with tempfile.TemporaryDirectory() as folder:
        socket = Path(folder) / "site.sock"
        site = open_bus(mode="router", socket=socket)
        counts: dict[str, int] = {}
        ages: list[int] = []
        lock = threading.Lock()

        def take(sample: Any) -> None:
            parsed = topics.parse_key(sample.key)
            if parsed is None:
                return
            with lock:
                counts[parsed.rig] = counts.get(parsed.rig, 0) + 1
                if parsed.topic is topics.IMU:
                    ages.append(time.monotonic_ns() - m.decode_imu(sample.payload).stamp_ns)

        viewer = open_bus(mode="client", socket=socket)
        subscription = viewer.subscribe("vical/**", take)
        names = [f"robot{i}" for i in range(args.rigs)]
        groups = [names[i : i + _RIGS_PER_PROCESS] for i in range(0, len(names), _RIGS_PER_PROCESS)]
        sent = _CONTEXT.Array("q", len(groups))
        processes = [
            _CONTEXT.Process(target=run_rigs, args=(str(socket), group, args.seconds, sent, i))
            for i, group in enumerate(groups)
        ]
        cpu_s = time.process_time()
        for process in processes:
            process.start()
        time.sleep(args.seconds / 2 + 3)
        before_s = time.perf_counter()
        latest = Client(viewer, owns_bus=False).latest()
        asked_ms = (time.perf_counter() - before_s) * 1e3
        for process in processes:
            process.join()
        time.sleep(0.5)
        cpu_s = time.process_time() - cpu_s
        total = sum(counts.values())
        print("| figure | value |\n|---|---|")
        print(f"| rigs seen / started | {len(counts)} / {args.rigs} |")
        print(f"| messages sent / received at the site | {sum(sent)} / {total} |")
        print(f"| lost (gaps in the numbers) | {subscription.dropped} |")
        print(f"| rate | {total / args.seconds:.0f} messages/s |")
        print(f"| age of inertial data p50 / p99 / max | {np.median(ages) * 1e-6:.2f} / "
              f"{np.percentile(ages, 99) * 1e-6:.1f} / {max(ages) * 1e-6:.1f} ms |")  # fmt: skip
        print(f"| last calibrations, asked for at once | {len(latest)} answers in {asked_ms:.1f} ms |")
        print(f"| processor of router and subscriber | {100 * cpu_s / args.seconds:.0f} % of a core |")
        print(f"| memory of router and subscriber | {_rss_mb():.0f} MB |")
        viewer.close()
        site.close()
    return int(total != sum(sent))


def run_rigs(socket: str, names: list[str], seconds: float, sent: Any, slot: int) -> None:
    """Some rigs in one process, each with a session of its own."""
    from vical_daemon.bus.zenoh_bus import open_bus

    buses = {name: open_bus(mode="client", socket=socket) for name in names}
    time.sleep(1.0)
    estimate = CalibrationEstimate(1, Status.CONVERGING, "", 0.5, "", 1.0, 1, 1, {}, None, [], 1.0, 0.0)
    calibration = m.encode_calibration(estimate, "cam0")
    begin_s, step = time.monotonic(), 0
    while (now_s := time.monotonic() - begin_s) < seconds:
        if now_s < step * 0.01:
            time.sleep(0.001)
            continue
        for name, bus in buses.items():
            payload = m.encode_imu(time.monotonic_ns(), "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))
            bus.publish(topics.IMU.key(name, "imu0"), payload)
            sent[slot] += 1
            if step % 20 == 0:
                bus.publish(topics.CALIBRATION.key(name, "cam0"), calibration)
                sent[slot] += 1
            if step % 100 == 0:
                for role in ("imu", "camera", "estimate"):
                    status = m.encode_diagnostics(1, role, [m.DiagnosticStatus(m.Level.OK, role)])
                    bus.publish(topics.STATUS.key(name, role), status)
                    sent[slot] += 1
        step += 1
    time.sleep(0.5)
    for bus in buses.values():
        bus.close()


def _rss_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
