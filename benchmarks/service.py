"""The service under a real systemd: install, kill -9 each process, hang one, stop, start; what is lost."""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from vical_mocks.harness.machine import Machine, MachineError

from vical_daemon.logs import open_recording
from vical_daemon.logs.mcap import recover
from vical_daemon.vision.target import Checkerboard

REPOSITORY = Path(__file__).resolve().parents[1]
# This checkout runs, whatever is installed.
SOURCES = ":".join(str(REPOSITORY / name) for name in ("", "drivers", "mocks"))
PROCESSES = ("acquire", "record", "calibrate")
FEED = "/run/vical-feed"
CONFIG = f"""\
imus: {{imu0: {{port: {FEED}/imu, rate_hz: 100}}}}
cameras: {{cam0: {{uri: 'v4l2:/dev/video77', lens: {{intrinsics: [515, 515, 320, 240]}}}}}}
target: target.yaml
"""
FEED_UNIT = f"""\
[Service]
RuntimeDirectory=vical-feed
Environment=TMPDIR={FEED} OMP_NUM_THREADS=1
WorkingDirectory={REPOSITORY}
Environment=PYTHONPATH={SOURCES}
ExecStart={sys.executable} -m benchmarks.service_feed --runtime /run/vical --port {FEED}/imu
"""
# The emulated IMU is a pseudo terminal; the rest of the sandbox stays as it is.
DROP_IN = "[Service]\nDeviceAllow=char-pts rw\n"
COMMON_DROP_IN = f"[Service]\nEnvironment=PYTHONPATH={SOURCES}\n"


def main(argv: list[str]) -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks service", description=__doc__)
    parser.add_argument("--kills", type=int, default=20, help="of each process")
    parser.add_argument("--only", choices=PROCESSES, help="kill this one alone")
    parser.add_argument("--keep-log", metavar="FILE", help="write the journal there")
    args = parser.parse_args(argv)
    victims = (args.only,) if args.only else PROCESSES
    try:
        with Machine() as machine:
            _install(machine)
            try:
                rows = _study(machine, args.kills, victims)
            except MachineError as error:
                print(f"failed: {error}", file=sys.stderr)
                return 1
            finally:
                if args.keep_log:
                    journal = machine.run("journalctl", "--no-pager", "-o", "short-precise", check=False)
                    Path(args.keep_log).write_text(journal)
    except MachineError as error:
        print(f"skipped: {error}", file=sys.stderr)
        return 0
    print("| what | result |\n|---|---|")
    for what, result in rows:
        print(f"| {what} | {result} |")
    return 0


def _install(machine: Machine) -> None:
    """Put the service into the machine by its own command, and the feed next to it."""
    from vical_daemon.cli import main as vical

    root = machine.root
    (root / "root").chmod(0o711)  # where this Python may live
    (root / "etc/vical").mkdir(parents=True)
    (root / "etc/vical/vical.yaml").write_text(CONFIG)
    (root / "etc/vical/target.yaml").write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
    program = Path(sys.executable).with_name("vical")
    if vical(["install-service", "--root", str(root), "--program", str(program), "--json"]):
        raise MachineError("install-service failed")
    units = root / "etc/systemd/system"
    (units / "rig-feed.service").write_text(FEED_UNIT)
    (units / "vical-acquire.service.d").mkdir()
    (units / "vical-acquire.service.d/bench.conf").write_text(DROP_IN)
    (units / "vical-.service.d/bench.conf").write_text(COMMON_DROP_IN)


def _study(machine: Machine, kills: int, victims: tuple[str, ...]) -> list[tuple[str, str]]:
    rows = [("boot to basic.target", f"{machine.boot():.1f} s")]
    machine.run("systemctl", "start", "rig-feed")
    begin_s = time.monotonic()
    machine.run("systemctl", "start", "vical.target")
    for name in PROCESSES:
        _wait(lambda name=name: _ready_again(machine, name, "0"), f"{name} ready")
    rows.append(("vical.target started, every process ready", f"{time.monotonic() - begin_s:.1f} s"))
    _wait(lambda: "converged" in _status(machine, "calibrate"), "converged", 180)
    rows.append(("calibration converged", _status(machine, "calibrate")[:70]))
    deeds: list[tuple[float, str]] = []
    rows += [(f"kill -9 {name}, {kills} times", _kill(machine, name, kills, deeds)) for name in victims]
    rows += [(f"{name} hung (SIGSTOP)", _hang(machine, name, deeds)) for name in ("record", "acquire")]
    time.sleep(5.0)  # or the hole of the last one has no end in the log
    rows.append(_stops(machine, max(kills // 2, 1)))
    deeds.append((time.time(), "stop"))
    begin_s = time.monotonic()
    machine.run("systemctl", "stop", "vical.target", *[f"vical-{name}" for name in PROCESSES])
    results = {name: machine.show(f"vical-{name}", "Result")[0] for name in PROCESSES}
    rows.append(("systemctl stop vical.target", f"{time.monotonic() - begin_s:.1f} s, {_join(results)}"))
    rows += _judge_logs(machine.root, deeds)
    stored = list((machine.root / "var/lib/vical/calibration").glob("*.json"))
    rows.append(("stored calibrations", f"{len(stored)}: {', '.join(p.name for p in stored)}"))
    machine.run("systemctl", "start", "vical.target")
    _wait(lambda: "starting from the calibration stored" in _journal(machine), "prior taken", 60)
    rows.append(("started again", "takes the stored calibration as its prior"))
    machine.run("systemctl", "stop", "vical.target", "rig-feed")
    return rows


def _kill(machine: Machine, name: str, kills: int, deeds: list[tuple[float, str]]) -> str:
    """Kill one process again and again; return how long systemd and the process took to be ready again."""
    outages = []
    for _ in range(kills):
        (pid,) = machine.show(f"vical-{name}", "MainPID")
        begin_s = time.monotonic()
        machine.run("kill", "-9", pid)
        deeds.append((time.time(), f"kill {name}"))
        _wait(lambda pid=pid: _ready_again(machine, name, pid), f"{name} again", 90)
        outages.append(time.monotonic() - begin_s)
        print(f"{name} killed {len(outages)} of {kills}: {outages[-1]:.1f} s", file=sys.stderr, flush=True)
        time.sleep(2.0)
    (restarts,) = machine.show(f"vical-{name}", "NRestarts")
    return f"ready again after {np.median(outages):.1f} s (longest {max(outages):.1f} s), {restarts} restarts"


def _ready_again(machine: Machine, name: str, old_pid: str) -> bool:
    """Whether another process runs and all of its roles have published a status (READY comes before)."""
    pid, state, text = machine.show(f"vical-{name}", "MainPID", "ActiveState", "StatusText")
    started = bool(text) and not text.startswith(("starting", "waiting"))
    return state == "active" and pid not in (old_pid, "0") and started


def _hang(machine: Machine, name: str, deeds: list[tuple[float, str]]) -> str:
    """Stop a process without killing it: only the watchdog can notice."""
    (pid,) = machine.show(f"vical-{name}", "MainPID")
    begin_s = time.monotonic()
    machine.run("kill", "-STOP", pid)
    deeds.append((time.time(), f"hang {name}"))
    _wait(lambda: _ready_again(machine, name, pid), f"{name} after a hang", 120)
    return f"watchdog: ready again after {time.monotonic() - begin_s:.1f} s"


def _stops(machine: Machine, count: int) -> tuple[str, str]:
    """Stop the calibration at random moments of its start, where a step of it takes longest."""
    rng, durations, bad = random.Random(5), [], []
    for _ in range(count):
        time.sleep(rng.uniform(0.5, 8.0))
        begin_s = time.monotonic()
        machine.run("systemctl", "stop", "vical-calibrate")
        durations.append(time.monotonic() - begin_s)
        bad += [r for r in machine.show("vical-calibrate", "Result") if r != "success"]
        machine.run("systemctl", "start", "--no-block", "vical-calibrate")
    _wait(lambda: _ready_again(machine, "calibrate", "0"), "calibrate ready")
    result = f"{np.median(durations):.1f} s (longest {max(durations):.1f} s), {', '.join(bad) or 'all clean'}"
    return f"systemctl stop vical-calibrate, {count} times in its first seconds", result


def _judge_logs(root: Path, deeds: list[tuple[float, str]]) -> list[tuple[str, str]]:
    """Open every log (after recovery where it was not closed), compare the IMU's gaps with the actions."""
    folder = root / "var/lib/vical/log"
    for part in sorted(folder.glob("*.part")):
        recover(part)
    logs = sorted(folder.glob("*.mcap"))
    recordings = [open_recording(log, check=False) for log in logs]
    arrays = [r.imu_arrays("imu0").t_ns * 1e-9 for r in recordings if "imu0" in r.imus]
    stamps_s = np.unique(np.concatenate(arrays))
    rows = [("logs that open", f"{len(recordings)} of {len(logs)}")]
    holes: dict[str, list[tuple[float, float]]] = {name: [] for _, name in deeds[:-1]}
    for i in np.nonzero(np.diff(stamps_s) > 0.025)[0]:
        before = [(at_s, name) for at_s, name in deeds if at_s < stamps_s[i + 1]]
        if before:  # a hole belongs to the last deed before its end
            at_s, name = before[-1]
            holes[name].append((stamps_s[i + 1] - stamps_s[i], at_s - stamps_s[i]))
    for name, found in holes.items():
        text = ", ".join(f"{length:.2f}" for length, _ in sorted(found, reverse=True)[:12])
        if found:
            text += f"; last sample before the deed {max(lost for _, lost in found):.2f} s at the most"
        rows.append((f"holes in the recorded IMU after {name}, s", text or "none"))
    return rows


def _status(machine: Machine, name: str) -> str:
    return machine.show(f"vical-{name}", "StatusText")[0]


def _journal(machine: Machine) -> str:
    return machine.run("journalctl", "--no-pager", "-u", "vical-calibrate", "-n", "60", "-o", "cat")


def _join(values: dict[str, str]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())


def _wait(condition: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end_s:
            raise MachineError(f"timed out: {what}")
        time.sleep(0.2)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
