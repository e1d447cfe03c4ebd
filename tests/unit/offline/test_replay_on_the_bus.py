"""A recording back on the bus."""

from __future__ import annotations

import threading

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import encode_diagnostics, encode_imu
from vical_daemon.logs import open_recording
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.offline.replay import replay


def test_replay_publishes_in_time_and_order(asl_folder):
    recording = open_recording(asl_folder)
    bus, got = LocalBus(), []
    bus.subscribe("**", got.append)
    result = replay(recording, bus, threading.Event(), speed=0)
    assert [(s.key, s.payload) for s in got] == list(recording.messages())
    assert result["messages"] == 2600
    got.clear()
    result = replay(recording, bus, threading.Event(), speed=40, rig="robot7")
    assert 0.29 < result["duration_s"] < 5
    assert got[0].key == topics.IMU.key("robot7", "imu0")
    stop = threading.Event()
    stop.set()
    assert replay(recording, bus, stop)["messages"] == 0


def test_what_the_driver_said_of_its_stamps_comes_along(tmp_path):
    # without it a calibration of the replay states a smaller time shift sigma than that of the recording
    path, keys = tmp_path / "run.mcap", []
    with LogWriter(path) as writer:
        for k in range(3):
            writer.write("vical/rig0/imu/imu0", encode_imu(10 * k, "imu0", (k, 0, 0), (0, 0, 9.8)), 10 * k)
            writer.write("vical/rig0/status/imu", encode_diagnostics(10 * k + 1, "imu", []), 10 * k + 1)
            writer.write("vical/rig0/status/camera", encode_diagnostics(10 * k, "camera", []), 10 * k)
    bus = LocalBus()
    bus.subscribe("**", lambda sample: keys.append(sample.key))
    replay(open_recording(path, check=False, as_recorded=True), bus, threading.Event(), speed=0, rig="r7")
    assert keys == ["vical/r7/imu/imu0", "vical/r7/status/imu"] * 3
