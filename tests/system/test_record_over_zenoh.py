"""`vical run record` as a process of its own: what is sent is in the file, also when it is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.zenoh_bus import open_bus
from vical_daemon.logs.mcap import LogReader

pytestmark = pytest.mark.system
IMU = topics.IMU.key("rig0", "imu0")


def start_recorder(folder: Path) -> subprocess.Popen[bytes]:
    config = folder / "vical.yaml"
    config.write_text(
        "rig: rig0\nimus:\n  imu0: {port: /dev/null, rate_hz: 500}\nbus: {tcp_port: 0}\n"
        f"record: {{directory: {folder / 'log'}, reserve_bytes: 0}}\n"
    )
    environment = os.environ | {"VICAL_RUNTIME_DIR": str(folder), "VICAL_STATE_DIR": str(folder)}
    command = [sys.executable, "-m", "vical_daemon", "run", "record", "-c", str(config), "--quiet"]
    return subprocess.Popen(command, env=environment)


def numbers(folder: Path) -> list[int]:
    return sorted(
        m.decode_imu(message.payload).stamp_ns
        for path in (folder / "log").glob("*.mcap")
        for message in LogReader(path).messages()
        if message.channel.topic == "/" + IMU
    )


def until(condition, timeout_s: float = 30.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return bool(condition())


def test_killed_recorder_loses_a_second_and_its_successor_goes_on(tmp_path):
    tmp_path.chmod(0o750)
    bus = open_bus(mode="router", socket=tmp_path / "zenoh.sock")
    status = topics.STATUS.key("rig0", "record")
    sent = 0

    def send(seconds: float) -> None:
        nonlocal sent
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            bus.publish(IMU, m.encode_imu(sent, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
            sent += 1
            time.sleep(0.002)

    def said(after: int) -> list[dict]:
        words = [m.decode_diagnostics(s.payload) for s in bus.latest(status)]
        return [w.statuses[0].values for w in words if w.stamp_ns > after]

    def recording(after: int) -> bool:
        return any(values["state"] == "recording" for values in said(after))

    first = start_recorder(tmp_path)
    assert until(lambda: recording(0))
    send(2.5)
    first.send_signal(signal.SIGKILL)
    first.wait()
    killed_at, before_ns = sent, time.time_ns()
    second = start_recorder(tmp_path)
    assert until(lambda: recording(before_ns))
    resumed_at = sent
    send(1.0)
    assert until(lambda: any(int(values["messages"]) >= sent - resumed_at for values in said(before_ns)))
    time.sleep(0.3)  # its own status counts among the messages: a few may still be on their way
    second.terminate()
    assert second.wait(60) == 0
    kept = numbers(tmp_path)
    assert len(kept) == len(set(kept))
    early = [n for n in kept if n < killed_at]
    assert early == list(range(early[0], early[-1] + 1))
    assert killed_at - 1 - early[-1] <= 500  # a second at 500 Hz
    assert [n for n in kept if n >= killed_at] == list(range(resumed_at, sent))
    assert not list((tmp_path / "log").glob("*.part"))
    bus.close()
