"""Recorder and store killed at random moments: what is lost, what is harmed, what the store holds after.

    python -m benchmarks power_cut --kills 200

A child process writes 1000 Hz inertial data and 20 Hz points through the recorder's own session (flush
each second, a new segment every 2 s) and saves a calibration every 20 ms; it is ended by SIGKILL. The
parent then recovers the folder and compares with what the child had handed over, which it wrote into
shared memory.
"""

from __future__ import annotations

import argparse
import mmap
import os
import random
import shutil
import signal
import struct
import tempfile
import time
from pathlib import Path

import numpy as np

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.logs.mcap import LogError, LogFolder, LogReader, LogSession
from vical_daemon.results.store import CalibrationStore

_SHARED = struct.Struct(
    "<qqq"
)  # last number handed over, its time (ns), number of the last calibration begun
_RATE_HZ = 1000


def main(argv: list[str]) -> int:
    """Kill and count."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks power_cut")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--longest", type=float, default=2.6, help="seconds until the kill, at most")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(argv)
    rng = random.Random(args.seed)
    load_before_forking()
    outcomes = [kill_once(rng.uniform(0.02, args.longest)) for _ in range(args.kills)]
    lost = [o["lost_s"] for o in outcomes]
    print("| figure | value |\n|---|---|")
    print(f"| kills (while writing) | {len(outcomes)} ({sum(o['written'] > 0 for o in outcomes)}) |")
    print(f"| inertial messages handed over | {sum(o['written'] for o in outcomes)} |")
    print(f"| lost at the end, median / largest | {np.median(lost):.3f} / {max(lost):.3f} s |")
    print(f"| kills that cost more than 1 s | {sum(s > 1.05 for s in lost)} |")
    print(f"| holes inside what was recovered | {sum(o['holes'] for o in outcomes)} |")
    print(f"| finished files harmed | {sum(o['harmed'] for o in outcomes)} |")
    print(f"| files that do not open after recovery | {sum(o['unreadable'] for o in outcomes)} |")
    print(f"| parts left over | {sum(o['parts'] for o in outcomes)} |")
    print(f"| store: old or new / neither | {sum(o['store'] for o in outcomes)} / "
          f"{sum(not o['store'] for o in outcomes)} |")  # fmt: skip
    bad = any(o["holes"] or o["harmed"] or o["unreadable"] or not o["store"] for o in outcomes)
    return int(bad or any(s > 1.05 for s in lost))


def load_before_forking() -> None:
    """A child must spend its short life writing, not importing."""
    import foxglove.mcap  # noqa: F401

    for kind in (m.IMU_TYPE, m.POINTS_TYPE):
        m.ros2_schema(kind)


def kill_once(after_s: float) -> dict[str, float]:
    """Run a writer, kill it after a while, recover, judge."""
    folder = Path(tempfile.mkdtemp(prefix="vical-cut-"))
    shared = mmap.mmap(-1, _SHARED.size)
    shared[:] = _SHARED.pack(-1, 0, -1)
    child = os.fork()
    if not child:
        try:
            write_for_ever(folder, shared)
        finally:
            os._exit(1)
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    try:
        return judge(folder, *_SHARED.unpack(shared[:]))
    finally:
        shutil.rmtree(folder)


def write_for_ever(folder: Path, shared: mmap.mmap) -> None:
    """What the recorder does, at 1000 Hz."""
    logs = LogFolder(folder / "log")
    logs.lock()
    session = LogSession(
        logs, "rig0", time.time_ns(), rotate_s=2.0, rotate_bytes=10**9, metadata=dict, attachments=list
    )
    store = CalibrationStore(folder / "store")
    imu, points = topics.IMU.key("rig0", "imu0"), topics.POINTS.key("rig0", "cam0")
    begin_s, number, saved = time.monotonic(), 0, -1
    while True:
        due = int((time.monotonic() - begin_s) * _RATE_HZ)
        while number < due:
            now_ns = time.time_ns()
            session.write(imu, m.encode_imu(number, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)), now_ns)
            if number % 50 == 0:
                seen = m.encode_points(number, "cam0", np.arange(144), np.ones((144, 2)))
                session.write(points, seen, now_ns)
            shared[:] = _SHARED.pack(number, now_ns, saved)
            number += 1
        session.tick(time.time_ns())
        if number // 20 > saved:
            saved += 1
            shared[16:] = struct.pack("<q", saved)
            store.save("imu", "cam", "cam0", _calibration(saved), saved)
        time.sleep(0.001)


def _calibration(number: int) -> CalibrationEstimate:
    pose = PoseEstimate([number * 1e-6, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], np.eye(6).tolist())
    camera = CameraEstimate(pose, 0.0, 0.0, [1.0] * 4, [0.0] * 4, "radtan", [0.0] * 4, [0.0] * 4, 0.2)
    return CalibrationEstimate(
        number, Status.CONVERGED, "", 1.0, "", 1.0, 1, 1, {"cam0": camera}, None, [], 1.0, 0.0
    )


def judge(folder: Path, last: int, last_ns: int, saved: int) -> dict[str, float]:
    """Recover and compare with what had been handed over."""
    log = folder / "log"
    finished = {path: path.read_bytes() for path in log.glob("*.mcap")}
    logs = LogFolder(log)
    logs.lock()
    logs.recover()
    logs.unlock()
    harmed = sum(path.read_bytes() != data for path, data in finished.items())
    numbers, times, unreadable = [], [last_ns], 0
    for path in sorted(log.glob("*.mcap")):
        try:
            reader = LogReader(path)
            for message in reader.messages():
                if message.channel.type_name == m.IMU_TYPE:
                    numbers.append(m.decode_imu(message.payload).stamp_ns)
                    times.append(message.log_time_ns)
            unreadable += not reader.complete
        except LogError:
            unreadable += 1
    holes = int(numbers != list(range(len(numbers))))
    newest_ns = max(times[1:], default=None)
    begin_ns = last_ns - max(last, 0) * 1_000_000
    lost_s = 0.0 if last < 0 else (last_ns - (newest_ns if newest_ns is not None else begin_ns)) * 1e-9
    stored = CalibrationStore(folder / "store").load("imu", "cam")
    found = -1 if stored is None else stored.saved_ns
    return {
        "written": last + 1,
        "lost_s": max(0.0, lost_s),
        "holes": holes,
        "harmed": harmed,
        "unreadable": unreadable,
        "parts": len([p for p in log.glob("*.part") if p.stat().st_size]),
        "store": found in (saved, saved - 1),
    }
