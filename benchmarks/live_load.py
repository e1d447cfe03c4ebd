"""The daemon live under load: four cameras of 1.3 MP at 30 Hz; one at 20 Hz on a quarter of a core."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cpu_quota import CpuQuota
from vical_daemon.bus import topics
from vical_daemon.bus.messages import decode_calibration, decode_diagnostics, decode_points
from vical_daemon.bus.zenoh_bus import BusError, ZenohBus, open_bus
from vical_daemon.service.wall_clock import shared_clock

RIG = "bench"
COLUMNS = (
    "case", "images", "images lost (camera, bus, detector)", "IMU samples", "lost",
    "exposure to corners on the bus, ms: p50", "p99", "images in the estimate", "status",
    "CPU acquire (with the stand-ins), % of a core", "CPU calibrate",
)  # fmt: skip
SETTLED_S = 8.0  # by then the calibration has started; CPU is counted from here on


@dataclass(frozen=True)
class Case:
    """One load.

    Attributes:
        cameras: How many; all see the same film.
        size: Pixels.
        rate_hz: Of each camera.
        seconds: Of film.
        share: Of one core that the daemon has; 0: all there is.
        board: Whether there is one; else the tracker follows what the room shows.
    """

    cameras: int
    size: tuple[int, int]
    rate_hz: float
    seconds: float
    share: float = 0.0
    board: bool = True


CASES: Mapping[str, Case] = {
    "four cameras, 1280x1024 at 30 Hz": Case(4, (1280, 1024), 30.0, 14.0),
    "a quarter of a core, board, 640x480 at 20 Hz": Case(1, (640, 480), 20.0, 30.0, 0.25),
    "a quarter of a core, no board, 640x480 at 20 Hz": Case(1, (640, 480), 20.0, 30.0, 0.25, board=False),
}


@dataclass
class Heard:
    """What came over the bus."""

    imu: list[int] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    status: dict[str, dict[str, str]] = field(default_factory=dict)
    frames: int = 0
    verdict: str = ""


def main(argv: list[str]) -> int:
    """Run the cases and print a Markdown table."""
    parser = argparse.ArgumentParser(prog="benchmarks live_load", description=__doc__)
    parser.add_argument("--case", choices=("four", "board", "room"), action="append", help="default: all")
    parser.add_argument("--seconds", type=float, default=0.0, help="of each film; 0: as the case has it")
    args = parser.parse_args(argv)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    for key, (title, case) in zip(("four", "board", "room"), CASES.items(), strict=True):
        if args.case and key not in args.case:
            continue
        if args.seconds:
            case = Case(**{**case.__dict__, "seconds": args.seconds})
        with tempfile.TemporaryDirectory() as folder, CpuQuota(case.share) as quota:
            if case.share and not quota.folders:
                print(f"skipped: {title}: {quota.problem}", file=sys.stderr)
                continue
            print(_row(title, case, Path(folder), quota), flush=True)
    return 0


def _row(title: str, case: Case, folder: Path, quota: CpuQuota) -> str:
    from benchmarks.live_film import make_film

    make_film(case, folder)
    (folder / "vical.yaml").write_text(_settings(case, folder))
    environment = os.environ | {
        "VICAL_RUNTIME_DIR": str(folder / "run"), "VICAL_STATE_DIR": str(folder / "state"),
        "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    config = str(folder / "vical.yaml")
    commands = {
        "acquire": [sys.executable, "-m", "benchmarks.live_film", str(folder)],
        "calibrate": [sys.executable, "-m", "vical_daemon", "run", "calibrate", "-c", config, "--quiet"],
    }
    processes: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for name, command in commands.items():
            processes[name] = subprocess.Popen(command, env=environment, preexec_fn=quota.join)
        heard, cpu = _listen(case, folder, processes)
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGTERM)
        for process in processes.values():
            with suppress(subprocess.TimeoutExpired):
                process.wait(30)
            process.kill()
    images = case.cameras * int(np.load(folder / "stamps.npy").size)
    gaps = np.diff(heard.imu) - 1
    p50, p99 = np.percentile(heard.latency_ms, [50, 99]) if heard.latency_ms else (np.nan, np.nan)
    lost = _lost(images, heard.status)
    cells = [
        title, images, " + ".join(map(str, lost)), len(heard.imu), int(gaps.sum()),
        f"{p50:.0f}", f"{p99:.0f}", heard.frames, heard.verdict,
        f"{cpu['acquire']:.0f}", f"{cpu['calibrate']:.0f}",
    ]  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def _lost(images: int, status: Mapping[str, Mapping[str, str]]) -> tuple[int, int, int]:
    """Images that were lost in cameras and their queues, on the bus, and before busy detectors."""
    camera = _total(status, "camera/", ("lost", "queue_dropped"))
    detector = _total(status, "detect/", ("dropped",))
    seen = _total(status, "detect/", ("images", "skipped", "malformed"))
    return camera, images - camera - detector - seen, detector


def _total(status: Mapping[str, Mapping[str, str]], prefix: str, names: tuple[str, ...]) -> int:
    found = [values for name, values in status.items() if name.startswith(prefix)]
    return sum(int(float(values.get(name, 0))) for values in found for name in names)


def _settings(case: Case, folder: Path) -> str:
    focal = 520.0 * case.size[0] / 640
    lens = f"{{intrinsics: [{focal}, {focal}, {case.size[0] / 2}, {case.size[1] / 2}]}}"
    cameras = "\n".join(
        f"  cam{k}: {{uri: 'folder:{folder}', size: [{case.size[0]}, {case.size[1]}], "
        f"rate_hz: {case.rate_hz}, lens: {lens}}}"
        for k in range(case.cameras)
    )
    more = "target: target.yaml\n" if case.board else "calibration: {mode: target_free}\n"
    return f"rig: {RIG}\nimus: {{imu0: {{port: /dev/null, rate_hz: 200}}}}\ncameras:\n{cameras}\n{more}"


def _listen(
    case: Case, folder: Path, processes: Mapping[str, subprocess.Popen[bytes]]
) -> tuple[Heard, dict[str, float]]:
    """Listen until the film has ended; what came, and the CPU of each process, % of a core."""
    bus, clock, heard = _join(folder / "run" / "zenoh.sock"), shared_clock(folder / "run"), Heard()

    def points(sample: Any) -> None:
        late_ns = clock.unix_ns(time.monotonic_ns()) - decode_points(sample.payload).stamp_ns
        heard.latency_ms.append(1e-6 * late_ns)

    def status(sample: Any) -> None:
        heard.status.update({s.name: s.values for s in decode_diagnostics(sample.payload).statuses})

    def estimate(sample: Any) -> None:
        said = decode_calibration(sample.payload).estimate
        heard.frames, heard.verdict = said.frames, str(said.status)

    bus.subscribe(topics.IMU.key(RIG, "imu0"), lambda sample: heard.imu.append(sample.sequence))
    topic = topics.POINTS if case.board else topics.TRACKS
    for k in range(case.cameras):
        bus.subscribe(topic.key(RIG, f"cam{k}"), points)
    bus.subscribe(topics.CALIBRATION.key(RIG, "cam0"), estimate)
    bus.subscribe(f"vical/{RIG}/status/*", status)
    while not heard.status.keys() & {f"detect/cam{k}" for k in range(case.cameras)}:
        time.sleep(0.1)  # calibrate imports for a while, more on a quarter of a core
    (folder / "go").touch()
    begin_s = time.monotonic()
    time.sleep(min(SETTLED_S, 0.5 * case.seconds))
    before, since_s = {name: _cpu_s(p.pid) for name, p in processes.items()}, time.monotonic()
    time.sleep(max(0.0, begin_s + case.seconds - time.monotonic()))
    used = {name: _cpu_s(p.pid) - before[name] for name, p in processes.items()}
    cpu = {name: 100.0 * x / (time.monotonic() - since_s) for name, x in used.items()}
    time.sleep(3.0)  # until the last are through, and have been counted in a status
    bus.close()
    return heard, cpu


def _join(socket: Path) -> ZenohBus:
    for _ in range(600):
        with suppress(BusError):
            return open_bus(mode="client", socket=socket)
        time.sleep(0.1)
    raise SystemExit("live_load: the bus does not come up")


def _cpu_s(pid: int) -> float:
    """CPU time of a process and its threads so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
