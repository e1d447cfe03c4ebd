"""A calibration over the bus while junk and extreme messages come on all keys; part of `bus_faults`.

This process hosts the bus and publishes a simulated rig in real time: inertial data and corners of cam0,
images of cam1. `vical run` does the rest in processes of their own: estimate for cam0, detect for cam1,
record.
"""

from __future__ import annotations

import multiprocessing as mp
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from vical_mocks.harness.bus_junk import RIG, Junk, unopened
from vical_mocks.harness.bus_rig import away_sigmas, good_messages, load_config
from vical_mocks.harness.processes import usage
from vical_mocks.points import SimulatedRun, simulate

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.calibrate.estimators import make_estimator
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import Config
from vical_daemon.estimation.result import CalibrationEstimate, Status

SECONDS, JUNK_FROM_S, JUNK_FOR_S = 60.0, 2.0, 50.0
_POOL = 8000  # different messages; the sender cannot make them as fast as it sends them
_ROLES = ("estimate", "detect", "record")
_CONTEXT = mp.get_context("spawn")


def undisturbed(run: SimulatedRun, config: Config, begin_ns: int) -> CalibrationEstimate:
    """What the same data give with nothing else on the bus."""
    role = EstimateRole(config, make_estimator(config))
    for _, key, payload in good_messages(run, begin_ns):
        if "cam1" not in key:
            role.take(Sample(key, payload, 0))
            role.step()
    role.finish()
    assert role.latest is not None
    return role.latest


@dataclass
class Seen:
    """What was heard and measured while it ran."""

    statuses: dict[str, dict[str, str]] = field(default_factory=dict)
    silent_s: dict[str, float] = field(default_factory=dict)
    memory_mb: list[tuple[float, list[float]]] = field(default_factory=list)
    last: CalibrationEstimate | None = None
    converged_s: float | None = None
    heard_s: dict[str, float] = field(default_factory=dict)

    def take(self, sample: Sample, t_s: float) -> None:
        """Take a status or an estimate; junk on those keys differs from the true ones in its content."""
        try:
            if "/status/" in sample.key:
                message = m.decode_diagnostics(sample.payload)
                role = message.frame_id
                if role not in _ROLES:
                    return
                self.silent_s[role] = max(self.silent_s.get(role, 0.0), t_s - self.heard_s.get(role, t_s))
                self.heard_s[role] = t_s
                self.statuses[role] = message.statuses[0].values
            else:
                estimate = m.admit_calibration(sample.payload).estimate
                if estimate.frames < 2**62:
                    self.last = estimate
                    if estimate.status is Status.CONVERGED and self.converged_s is None:
                        self.converged_s = t_s
        except m.MessageError:
            return


def send_junk(socket: str, count: int, over_s: float, begin_ns: int, pipe: Any) -> None:
    """Say when it is ready, wait, and send `count` messages at an even rate."""
    from vical_daemon.bus.zenoh_bus import open_bus

    source = Junk(24)
    pool = [source.message(k, begin_ns) for k in range(min(_POOL, count))]
    bus = open_bus(mode="client", socket=socket)
    pipe.send("ready")
    pipe.recv()
    begin_s, sent = time.monotonic(), 0
    while sent < count:
        due = count if over_s <= 0 else min(int((time.monotonic() - begin_s) / over_s * count) + 1, count)
        for k in range(sent, due):
            bus.publish(*pool[k % len(pool)])
        sent = due
        time.sleep(0.002)
    pipe.send(time.monotonic() - begin_s)
    bus.close()


def calibrating(junk: int, seed: int = 11) -> tuple[list[tuple[str, str]], bool]:
    """Run it; rows of the table, and whether everything held."""
    run = simulate(seed, SECONDS, timeshift_cam_imu_s=0.012, camera_rate_hz=15.0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o750)
        config = load_config(folder)
        load_config(folder, "cam1")
        begin_ns = time.time_ns()
        calm = undisturbed(run, config, begin_ns)
        seen, took_s = _live(run, folder, junk, begin_ns)
        logs = sorted((folder / "log").glob("*.mcap"))
        bad = [problems for log in logs if (problems := unopened(log, folder))]
    for problem in (text for problems in bad for text in problems):
        print(problem, file=sys.stderr)
    if seen.last is None or "cam0" not in seen.last.cameras:
        return [("calibration", f"none: {seen.last}")], False
    away = away_sigmas(calm, seen.last)
    first, last = (np.mean([mb for _, mb in part], axis=0) for part in _later_thirds(seen.memory_mb))
    estimate, record = seen.statuses["estimate"], seen.statuses["record"]
    grown = {role: f"{a:.0f} -> {b:.0f}" for role, a, b in zip(_ROLES, first, last, strict=True)}
    rows = [
        ("malformed and extreme messages, all keys", f"{junk} in {took_s:.0f} s"),
        ("status at the end, undisturbed / with them", f"{calm.status} / {seen.last.status}"),
        ("converged after (with them)", f"{seen.converged_s or float('nan'):.0f} s"),
        ("largest difference of the answers", f"{away:.2f} sigma"),
        ("images used, undisturbed / with them", f"{calm.frames} / {seen.last.frames}"),
        ("estimate: malformed, implausible, stamps refused, restarts", _values(
            estimate, "malformed", "implausible", "stamps_refused", "estimator_restarts")),
        ("detect: images, malformed, failures", _values(
            seen.statuses["detect"], "images", "malformed", "failures")),
        ("record: messages, malformed, dropped, lost on the bus", _values(
            record, "messages", "malformed", "dropped", "lost_on_bus")),
        ("longest silence of a role's status", f"{max(seen.silent_s.values()):.1f} s"),
        ("memory MB, second -> last third of that time", ", ".join(f"{r} {g}" for r, g in grown.items())),
        ("logs that open in mcap-ros2, rosbags, rosbags-convert", f"{len(logs) - len(bad)} of {len(logs)}"),
    ]  # fmt: skip
    held = seen.last.status is Status.CONVERGED and away < 1.0 and not bad and bool(logs)
    return rows, held and bool(np.all(last < 1.1 * first))


def _live(run: SimulatedRun, folder: Path, junk: int, begin_ns: int) -> tuple[Seen, float]:
    """Everything in processes of its own, in real time."""
    from vical_daemon.bus.zenoh_bus import open_bus

    seen, socket = Seen(), folder / "zenoh.sock"
    with ExitStack() as stack:
        bus = open_bus(mode="router", socket=socket)
        stack.callback(bus.close)
        begin_s = time.monotonic()
        for key in (topics.STATUS.pattern, topics.CALIBRATION.pattern):
            expression = key.format(rig=RIG, name="*")
            bus.subscribe(expression, lambda sample: seen.take(sample, time.monotonic() - begin_s))
        processes = [_start(role, folder) for role in _ROLES]
        for process in processes:
            stack.callback(process.kill)
        here, there = _CONTEXT.Pipe()
        arguments = (str(socket), junk, JUNK_FOR_S, begin_ns, there)
        sender = _CONTEXT.Process(target=send_junk, args=arguments, daemon=True)
        sender.start()
        stack.callback(sender.kill)
        here.recv()
        end_s = time.monotonic() + 90
        while set(seen.statuses) != set(_ROLES):
            if time.monotonic() > end_s:
                raise RuntimeError(f"only {sorted(seen.statuses)} have started")
            time.sleep(0.1)
        seen.silent_s.clear()
        begin_s = time.monotonic()
        seen.heard_s.clear()
        begun, measured_s = False, 0.0
        for stamp_ns, key, payload in good_messages(run, begin_ns):
            t_s = (stamp_ns - begin_ns) * 1e-9
            time.sleep(max(0.0, begin_s + t_s - time.monotonic()))
            bus.publish(key, payload)
            if not begun and t_s > JUNK_FROM_S:
                here.send("go")
                begun = True
            if t_s > measured_s + 1.0:
                measured_s = t_s
                if sender.is_alive():
                    seen.memory_mb.append((t_s, [usage(p.pid)[0] for p in processes]))
        took_s = float(here.recv())
        time.sleep(3.0)
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(60)
    return seen, took_s


def _start(role: str, folder: Path) -> subprocess.Popen[bytes]:
    config = folder / ("cam1.yaml" if role == "detect" else "cam0.yaml")
    environment = os.environ | {"VICAL_RUNTIME_DIR": str(folder), "VICAL_STATE_DIR": str(folder)}
    command = [sys.executable, "-m", "vical_daemon", "run", role, "-c", str(config), "--quiet"]
    return subprocess.Popen(command, env=environment)


def _later_thirds(rows: list[Any]) -> tuple[list[Any], list[Any]]:
    third = max(len(rows) // 3, 1)
    return rows[third : 2 * third], rows[-third:]


def _values(values: dict[str, str], *names: str) -> str:
    return ", ".join(values.get(name, "-") for name in names)
