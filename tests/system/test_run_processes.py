"""`vical run`: real processes, a real bus, an emulated IMU on a real terminal."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vical_mocks.gx3_emulator import Gx3Emulator

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import decode_diagnostics, decode_imu, decode_points
from vical_daemon.bus.zenoh_bus import open_bus
from vical_daemon.logs import open_recording
from vical_daemon.vision.target import Checkerboard

pytestmark = pytest.mark.system


class Daemon:
    """A folder with a config, and the `vical` processes started on it."""

    def __init__(self, folder: Path, port: str) -> None:
        self.folder, self.port = folder, port
        self.processes: list[subprocess.Popen[str]] = []
        self.environment = os.environ | {
            "VICAL_RUNTIME_DIR": str(folder / "run"),
            "VICAL_STATE_DIR": str(folder / "state"),
            "OMP_NUM_THREADS": "1",
        }
        (folder / "target.yaml").write_text(Checkerboard(8, 5, 0.05, 0.05).to_yaml())
        (folder / "vical.yaml").write_text(
            f"rig: rover\nimus: {{imu0: {{port: {port}, rate_hz: 100}}}}\n"
            "cameras: {cam0: {uri: 'v4l2:/dev/video77'}}\ntarget: target.yaml\nbus: {tcp_port: 0}\n"
        )

    def vical(self, *words: str, **more: Any) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "vical_daemon", *words, "-c", str(self.folder / "vical.yaml")]
        process = subprocess.Popen(
            command, env=self.environment | more, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.processes.append(process)
        return process

    @property
    def socket(self) -> Path:
        return self.folder / "run" / "zenoh.sock"


@pytest.fixture(autouse=True)
def hang_up_as_usual() -> Iterator[None]:
    """Children inherit an ignored SIGHUP, for example where the tests themselves run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    emulator = Gx3Emulator(link="direct", serial_number="6223-00007")
    emulator.plug()
    with emulator:
        daemon = Daemon(tmp_path, emulator.port_name)
        yield daemon
        for process in daemon.processes:
            if process.poll() is None:
                process.terminate()
            try:
                process.communicate(timeout=15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _wait_for(condition: Callable[[], Any], timeout_s: float = 60.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it does not happen"
        time.sleep(0.05)


def test_all_processes_run_record_and_stop_cleanly(daemon: Daemon) -> None:
    parent = daemon.vical("run")
    _wait_for(daemon.socket.exists)
    bus = open_bus(mode="client", socket=daemon.socket)
    got: list[Sample] = []
    bus.subscribe("vical/rover/**", got.append)
    roles = {"imu", "camera", "record", "detect", "estimate"}
    _wait_for(lambda: {s.key.split("/")[3] for s in list(got) if "/status/" in s.key} == roles)
    _wait_for(lambda: sum("/imu/imu0" in s.key for s in list(got)) > 50)
    _wait_for(lambda: any("/calibration/cam0" in s.key for s in list(got)))
    watch = daemon.vical("watch", "--once", "--json")
    out, _ = watch.communicate(timeout=60)
    assert json.loads(out)["rig"] == "rover" and json.loads(out)["status"] == "waiting"
    bus.close()
    parent.send_signal(signal.SIGTERM)
    _, err = parent.communicate(timeout=60)
    assert parent.returncode == 0, err
    assert "Traceback" not in err
    offsets = {
        component.values["wall_minus_monotonic_ns"]
        for sample in got
        if "/status/" in sample.key
        for component in decode_diagnostics(sample.payload).statuses
        if component.name == "clock"
    }
    assert len(offsets) == 1  # one clock for all processes
    numbers = [s.sequence for s in got if s.key.endswith("/imu/imu0")]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))  # none lost on the bus
    (log,) = (daemon.folder / "state" / "log").glob("*.mcap")
    recorded = open_recording(log, check=False).imu_arrays("imu0").t_ns
    live = [decode_imu(s.payload).stamp_ns for s in got if s.key.endswith("/imu/imu0")]
    # Nothing that was on the bus is missing in the file. (Evenness is no matter of this test: a virtual
    # machine that stands still for seconds overruns the terminal: that hole is the emulated device's.)
    first = int(np.searchsorted(recorded, live[0]))
    np.testing.assert_array_equal(recorded[first : first + len(live)], live)


def test_systemd_is_told_ready_alive_and_stopping(daemon: Daemon) -> None:
    path = daemon.folder / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        systemd.settimeout(60)
        process = daemon.vical("run", "acquire", NOTIFY_SOCKET=str(path))
        said: list[str] = []
        # A camera that is missing is said, and is no reason to die.
        for wanted in ("READY=1", "WATCHDOG=1", "camera/cam0: /dev/video77"):
            while not any(wanted in text for text in said):
                said.append(systemd.recv(4096).decode())
        process.send_signal(signal.SIGTERM)
        while "STOPPING=1" not in said[-1]:
            said.append(systemd.recv(4096).decode())
    assert process.wait(60) == 0


def test_a_second_host_of_the_bus_is_one_line(daemon: Daemon) -> None:
    first = daemon.vical("run", "acquire")
    _wait_for(daemon.socket.exists)
    second = daemon.vical("run", "acquire")
    _, err = second.communicate(timeout=60)
    assert second.returncode == 1 and "already hosts the bus" in err.splitlines()[-1]
    assert first.poll() is None


def test_a_host_whose_socket_was_removed_starts_again(daemon: Daemon) -> None:
    """With its login session the folder of a laptop's service went: no process that restarted could join."""
    first = daemon.vical("run", "acquire")
    _wait_for(daemon.socket.exists)
    bus = open_bus(mode="client", socket=daemon.socket)
    got: list[Sample] = []
    bus.subscribe("vical/rover/imu/imu0", got.append)
    _wait_for(lambda: got)
    shutil.rmtree(daemon.socket.parent)
    _, err = first.communicate(timeout=60)
    assert first.returncode == 1
    assert "zenoh.sock was removed: no process can join; starting again" in err.splitlines()[-1]
    daemon.vical("run", "acquire")  # by systemd, or by `vical run`
    got.clear()
    _wait_for(lambda: got)  # a client that was there before joins again
    bus.close()


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["run", "aquire"], 2, "did you mean acquire"),
        (["watch", "--once"], 1, "no bus at"),
        (["watch", "--connect", "robot7"], 1, "'robot7' is no endpoint: write it like tcp/"),
    ],
)
def test_mistakes_are_one_line(daemon: Daemon, words: list[str], code: int, text: str) -> None:
    process = daemon.vical(*words)
    _, err = process.communicate(timeout=60)
    assert process.returncode == code and text in err.splitlines()[-1]
    assert "Traceback" not in err and ".rs:" not in err  # nor a place in a library's source


def _children(parent: subprocess.Popen[str]) -> list[int]:
    text = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text()
    return [int(word) for word in text.split()]


def _alive(pids: list[int]) -> list[int]:
    """Those that still run: a zombie that nobody has collected holds nothing."""
    found = []
    for pid in pids:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            continue
        found += [pid] if state != "Z" else []
    return found


def _holders(port: str, pids: list[int]) -> list[int]:
    """Processes that have the IMU's terminal open."""
    found = []
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                found += [pid] if str(link.readlink()) == port else []
            except OSError:
                continue  # closed meanwhile
    return found


def _running(daemon: Daemon, parent: subprocess.Popen[str]) -> list[int]:
    """Wait until all children run and one holds the IMU; return them."""
    port = str(Path(daemon.port).resolve())
    _wait_for(lambda: len(_children(parent)) == 3 and _holders(port, _children(parent)), 120)
    return _children(parent)


def _ends(parent: subprocess.Popen[str], number: signal.Signals) -> None:
    """Send a signal to the parent: no child outlives it."""
    children = _alive(_children(parent))
    assert len(children) > 1
    parent.send_signal(number)
    parent.wait(60)
    _wait_for(lambda: not _alive(children), 15)
    assert parent.returncode == (-signal.SIGKILL if number is signal.SIGKILL else 0)


def test_no_child_outlives_a_hang_up(daemon: Daemon) -> None:
    parent = daemon.vical("run")
    children = _running(daemon, parent)
    _ends(parent, signal.SIGHUP)
    assert parent.returncode == 0 and not _alive(children)


def test_a_second_interrupt_hurries_and_leaves_nobody(daemon: Daemon) -> None:
    parent = daemon.vical("run")
    children = _running(daemon, parent)
    os.kill(children[1], signal.SIGSTOP)  # record does not answer: an orderly stop would wait for it
    parent.send_signal(signal.SIGINT)
    time.sleep(0.3)
    begin_s = time.monotonic()
    parent.send_signal(signal.SIGINT)
    parent.wait(60)
    assert time.monotonic() - begin_s < 10.0
    assert not _alive(children)


def test_a_child_whose_parent_is_already_gone_does_not_start(daemon: Daemon) -> None:
    process = daemon.vical("run", "acquire", "--parent", "1")  # the test is its parent, not process 1
    process.communicate(timeout=60)
    assert process.returncode == 1 and not daemon.socket.exists()


def test_under_nohup_a_hang_up_ends_nobody_and_a_killed_child_is_started_again(daemon: Daemon) -> None:
    """Where the parent is killed, too, its children end."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # inherited, as nohup does it
    try:
        parent = daemon.vical("run")
    finally:
        signal.signal(signal.SIGHUP, before)
    children = _running(daemon, parent)
    parent.send_signal(signal.SIGHUP)
    time.sleep(11.0)  # a child that fails at once is not started again
    assert parent.poll() is None and _alive(_children(parent)) == children
    os.kill(children[1], signal.SIGKILL)
    _wait_for(lambda: len(found := _alive(_children(parent))) == 3 and children[1] not in found)
    after = _alive(_children(parent))
    assert children[0] in after and children[2] in after and children[1] not in after
    _ends(parent, signal.SIGKILL)


EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_service_runs_without_hardware(daemon: Daemon) -> None:
    """`vical run -c examples/no_hardware.yaml`: emulated IMU and rendered camera, all else as on a robot."""
    text = (EXAMPLES / "no_hardware.yaml").read_text().replace("web: {enabled: true}", "bus: {tcp_port: 0}")
    assert "tcp_port" in text
    (daemon.folder / "vical.yaml").write_text(text)
    board = "no_hardware_target.yaml"
    (daemon.folder / board).write_text((EXAMPLES / board).read_text())
    parent = daemon.vical("run")
    _wait_for(daemon.socket.exists, 120)
    bus = open_bus(mode="client", socket=daemon.socket)
    got: list[Sample] = []
    for what in ("imu/imu0", "camera/cam0/points", "calibration/cam0"):
        bus.subscribe(f"vical/no_hardware/{what}", got.append)

    def seen(kind: str) -> list[Sample]:
        return [s for s in list(got) if s.key.endswith(kind)]

    _wait_for(lambda: sum(len(decode_points(s.payload).ids) == 54 for s in seen("/points")) > 10, 120)
    _wait_for(lambda: len(seen("/imu0")) > 500 and seen("/calibration/cam0"), 120)
    age_s = time.time() - decode_imu(seen("/imu0")[-1].payload).stamp_ns * 1e-9
    assert -1 < age_s < 60
    bus.close()
    _ends(parent, signal.SIGINT)
    _, err = parent.communicate(timeout=60)
    assert "Traceback" not in err, err


def test_halves_of_the_emulated_rig_are_refused(daemon: Daemon) -> None:
    text = (EXAMPLES / "no_hardware.yaml").read_text()
    (daemon.folder / "vical.yaml").write_text(text + "bus: {tcp_port: 0}\n")
    process = daemon.vical("run", "imu")
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and "run both in one process (`vical run acquire`)" in err.splitlines()[-1]
