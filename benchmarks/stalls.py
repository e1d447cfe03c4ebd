"""SIGSTOP and kill -9 of each process of `vical run`: how soon the same calibration is converged again."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.stall_watcher import Watcher
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.estimation.wording import event_text
from vical_daemon.vision.target import Checkerboard

PROCESSES = {"acquire": "imu", "record": "record", "calibrate": "estimate", "web": "web"}
"""Process -> the role whose status says that it is back."""
DEEDS = ("stop", "kill")
WITHIN_S = 5.0  # what is asked for: converged again so soon after the return
GIVE_UP_S = 60.0
LATE_S = 2.0  # what is announced, or moves, only after the first images
SETTLE_S = 12.0  # between two deeds: beyond the 10 s within which a child's end ends `vical run`
CONFIG = """\
imus: {{imu0: {{port: {port}, rate_hz: 100}}}}
cameras: {{cam0: {{uri: 'v4l2:/dev/video77', lens: {{intrinsics: [515, 515, 320, 240]}}}}}}
target: target.yaml
bus: {{tcp_port: 0}}
web: {{enabled: true, port: 0}}
"""


@dataclass(slots=True)
class Outcome:
    """One deed.

    Attributes:
        process: To whom.
        deed: stop or kill.
        outage_s: Until the process was back (the first status of its role), s.
        again_s: From then until `converged` was published, s; None: not within `GIVE_UP_S`.
        z: Largest change of lever arm, mounting angles and time shift, in joint sigmas; None: not converged.
        moved_mm: Change of the lever arm, mm.
        events: What was announced meanwhile.
    """

    process: str
    deed: str
    outage_s: float
    again_s: float | None = None
    z: float | None = None
    moved_mm: float | None = None
    events: list[Event] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether it is as asked for: in time, the same numbers, and nothing taken for a bump."""
        in_time = self.again_s is not None and self.again_s <= WITHIN_S
        same = self.z is not None and self.z < 3.0  # of 7 numbers, by chance once in 50 deeds
        return in_time and same and not any(event.changed for event in self.events)


def main(argv: list[str]) -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks stalls", description=__doc__)
    parser.add_argument("--times", type=int, default=20, help="each deed to each process")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a stall")
    parser.add_argument("--only", choices=PROCESSES, help="this process alone")
    parser.add_argument("--deed", choices=DEEDS, help="this deed alone")
    parser.add_argument("--out", metavar="FILE", help="write every outcome there as a line of JSON")
    args = parser.parse_args(argv)
    victims = (args.only,) if args.only else tuple(PROCESSES)
    outcomes = []
    with tempfile.TemporaryDirectory() as folder, _service(Path(folder)) as (parent, watcher):
        _wait(lambda: watcher.converged_since(0.0) is not None, 240.0, "converged")
        time.sleep(SETTLE_S)
        for deed in (args.deed,) if args.deed else DEEDS:
            for name in victims:
                for number in range(args.times):
                    outcomes.append(_outcome(parent, watcher, name, deed, args.seconds))
                    text = json.dumps(asdict(outcomes[-1]))
                    print(f"{number + 1} of {args.times}: {text}", file=sys.stderr, flush=True)
                    time.sleep(SETTLE_S)
    if args.out:
        Path(args.out).write_text("".join(json.dumps(asdict(o)) + "\n" for o in outcomes))
    print(_table(outcomes))
    return 0 if all(outcome.good for outcome in outcomes) else 1


@contextmanager
def _service(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], Watcher]]:
    """Run the emulated rig, `vical run`, and somebody who listens; see `service_feed`."""
    port, runtime = folder / "imu", folder / "run"
    (folder / "target.yaml").write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
    (folder / "vical.yaml").write_text(CONFIG.format(port=port))
    environment = os.environ | {"VICAL_RUNTIME_DIR": str(runtime), "VICAL_STATE_DIR": str(folder / "state")}
    feed = [sys.executable, "-m", "benchmarks.service_feed", "--runtime", str(runtime), "--port", str(port)]
    daemon = [sys.executable, "-m", "vical_daemon", "run", "-c", str(folder / "vical.yaml")]
    started: list[subprocess.Popen[bytes]] = []
    watcher = Watcher(runtime / "zenoh.sock")
    try:
        started.append(subprocess.Popen(feed, env=environment))
        _wait(port.exists, 60.0, "the emulated IMU")
        started.append(subprocess.Popen(daemon, env=environment))
        watcher.start()
        yield started[1], watcher
    finally:
        watcher.close()
        for process in reversed(started):
            process.terminate()
            process.wait(60)


def _outcome(
    parent: subprocess.Popen[bytes], watcher: Watcher, name: str, deed: str, seconds: float
) -> Outcome:
    """Do one deed to one process and wait until all is as before."""
    with suppress(TimeoutError):  # after a deed that lost the calibration
        _wait(lambda: watcher.converged_since(time.monotonic() - 1.0) is not None, 120.0, "converged")
    before = watcher.last
    if before is None or before.status != "converged":
        return Outcome(
            name,
            deed,
            0.0,
            events=[Event(EventKind.OTHER, said=f"not converged before: {before and before.reason}")],
        )
    pid = _child(parent, name)
    begin_s = time.monotonic()
    if deed == "stop":
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid, signal.SIGCONT)
        back_s = time.monotonic()
    else:
        os.kill(pid, signal.SIGKILL)
        time.sleep(0.3)  # what it had published before
        gone_s = time.monotonic()
        _wait(lambda: watcher.spoke_s(PROCESSES[name]) > gone_s, 120.0, f"{name} again")
        back_s = watcher.spoke_s(PROCESSES[name])
    outcome = Outcome(name, deed, back_s - begin_s)
    with suppress(TimeoutError):
        _wait(lambda: watcher.converged_since(back_s) is not None, GIVE_UP_S, "converged")
        again_s, first = watcher.converged_since(back_s) or (0.0, before)
        outcome.again_s = again_s - back_s
        time.sleep(LATE_S)
        last = watcher.last or first
        if last.status != "converged":  # it was not to last
            outcome.again_s = None
        changes = [change(before, after) for after in (first, last)]
        outcome.z, outcome.moved_mm = max(changes)
    outcome.events = watcher.events_since(begin_s)
    return outcome


def change(before: CalibrationEstimate, after: CalibrationEstimate) -> tuple[float, float]:
    """Return the largest change of pose and time shift, in joint sigmas, and that of the lever arm, mm."""
    if "cam0" not in after.cameras:  # all is forgotten
        return float("inf"), float("inf")
    old, new = before.cameras["cam0"], after.cameras["cam0"]
    R_old, R_new = (so3.matrix_from_quat(np.asarray(c.T_imu_cam.q_wxyz)) for c in (old, new))
    moved_m = np.subtract(new.T_imu_cam.p_m, old.T_imu_cam.p_m)
    variance = sum(np.diag(np.asarray(c.T_imu_cam.covariance)) for c in (old, new))
    shift_s = new.timeshift_cam_imu_s - old.timeshift_cam_imu_s
    z = np.abs([*moved_m, *so3.log(R_old.T @ R_new)]) / np.sqrt(variance)
    z_shift = abs(shift_s) / float(np.hypot(old.timeshift_sigma_s, new.timeshift_sigma_s))
    return max(float(z.max()), z_shift), 1e3 * float(np.linalg.norm(moved_m))


def _child(parent: subprocess.Popen[bytes], name: str) -> int:
    """Return the process id of a child of `vical run`.

    Raises:
        TimeoutError: It is not there.
    """
    for word in Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split():
        with suppress(OSError):
            words = Path(f"/proc/{word}/cmdline").read_bytes().split(b"\0")
            if words[words.index(b"run") + 1] == name.encode():
                return int(word)
    raise TimeoutError(f"there is no process {name}")


def _table(outcomes: list[Outcome]) -> str:
    titles = (
        "process", "deed", "as asked for", "outage, s", "converged again after, s",
        "change, sigma", "lever arm, mm", "announced",
    )  # fmt: skip
    rows = ["| " + " | ".join(titles) + " |", "|---" * len(titles) + "|"]
    for key in dict.fromkeys((o.process, o.deed) for o in outcomes):
        some = [o for o in outcomes if (o.process, o.deed) == key]
        good = sum(o.good for o in some)
        again = _worst([o.again_s for o in some])
        events = sorted({event_text(event) for o in some for event in o.events})
        cells = [
            *key, f"{good} of {len(some)}", _worst([o.outage_s for o in some]), again,
            _worst([o.z for o in some]), _worst([o.moved_mm for o in some]),
            "; ".join(events)[:300] or "nothing",
        ]  # fmt: skip
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _worst(values: list[float | None]) -> str:
    """Median and maximum; never: one that did not come."""
    known = [value for value in values if value is not None]
    never = f", {len(values) - len(known)} never" if len(known) < len(values) else ""
    return (f"{np.median(known):.2f} (at most {max(known):.2f})" if known else "") + never


def _wait(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(f"timed out: {what}")
        time.sleep(0.02)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
