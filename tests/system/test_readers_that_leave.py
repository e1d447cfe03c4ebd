"""Programs whose reader leaves (`| head -1`), or that get ^C, end in silence and with the usual exit code."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import encode_calibration, encode_pose
from vical_daemon.bus.zenoh_bus import open_bus
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status

pytestmark = pytest.mark.system
EXAMPLES = Path(__file__).parents[2] / "examples"
_INTERRUPTIBLE = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""
PROGRAMS = {
    "plain_zenoh": [str(EXAMPLES / "plain_zenoh.py")],
    "watch_calibration": [str(EXAMPLES / "watch_calibration.py")],
    "watch_async": [str(EXAMPLES / "watch_async.py")],
    "watch": ["-m", "vical_daemon", "watch", "--connect"],
    "watch --json": ["-m", "vical_daemon", "watch", "--json", "--connect"],
}


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A robot whose calibration and pose come ten times a second."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        free_port = int(probe.getsockname()[1])
    folder, stop = tmp_path_factory.mktemp("bus"), threading.Event()
    host = open_bus(mode="router", socket=folder / "zenoh.sock", tcp_port=free_port)
    thread = threading.Thread(target=_publish, args=(host, stop))
    thread.start()
    yield f"tcp/127.0.0.1:{free_port}"
    stop.set()
    thread.join()
    host.close()


def _publish(host: Bus, stop: threading.Event) -> None:
    pose = PoseEstimate([0.1, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [[0.0] * 6] * 6)
    camera = CameraEstimate(pose, 0.0, 0.0, [], [], "radtan", [], [], 0.2)
    estimate = CalibrationEstimate(
        5, Status.CONVERGED, "", 1.0, "", 1.0, 10, 100, {"cam0": camera}, None, [], 1.0, 0.0
    )
    while not stop.wait(0.1):
        host.publish(topics.CALIBRATION.key("rig0", "cam0"), encode_calibration(estimate, "cam0"))
        host.publish(topics.POSE.key("rig0", "cam0"), encode_pose(5, "imu", pose))


def _after_a_line(name: str, endpoint: str) -> subprocess.Popen[str]:
    """Start a program, with ^C as a shell's user has it, and read its first line."""
    words = [sys.executable, *PROGRAMS[name], endpoint]
    program = subprocess.Popen(
        [sys.executable, "-c", _INTERRUPTIBLE, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert program.stdout is not None
    assert program.stdout.readline()
    return program


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_reader_leaves_after_a_line(name: str, endpoint: str) -> None:
    program = _after_a_line(name, endpoint)
    assert program.stdout is not None
    program.stdout.close()
    try:
        _, said = program.communicate(timeout=30)
    finally:
        program.kill()
    assert (program.returncode, said) == (141, "")


@pytest.mark.parametrize("name", PROGRAMS)
def test_interrupted_after_a_line(name: str, endpoint: str) -> None:
    program = _after_a_line(name, endpoint)
    program.send_signal(signal.SIGINT)
    try:
        _, said = program.communicate(timeout=30)
    finally:
        program.kill()
    assert (program.returncode, said.replace("vical: interrupted\n", "")) == (130, "")
