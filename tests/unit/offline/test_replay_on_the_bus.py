"""A recording back on the bus."""

from __future__ import annotations

import threading

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.logs import open_recording
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
