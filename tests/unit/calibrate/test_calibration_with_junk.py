"""A calibration with junk on all keys: the same answer, and logs that everybody can open.

The large version, with processes of their own and 10^5 messages: `python -m benchmarks bus_faults`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vical_mocks.harness.bus_junk import RIG, Junk, unopened
from vical_mocks.harness.bus_rig import away_sigmas, good_messages, load_config
from vical_mocks.harness.processes import usage
from vical_mocks.points import simulate

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.calibrate.estimators import input_keys, make_estimator
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.detect.role import DetectRole
from vical_daemon.estimation.result import Status
from vical_daemon.logs.mcap import LogFolder
from vical_daemon.record.queue import arrival
from vical_daemon.record.recorder import Recorder
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.web.state import WebState

BEGIN_NS = 1_800_000_000_000_000_000
SECONDS, JUNK_AT_ONCE = 16.0, 4  # before every image, 15 times a second


class Rig:
    """The roles on one bus, without threads: what happens does not depend on the machine."""

    def __init__(self, folder: Path) -> None:
        self.bus, clock = LocalBus(), private_clock()
        self.config = load_config(folder)
        self.estimate = EstimateRole(self.config, make_estimator(self.config))
        self.detect = DetectRole(self.config, "cam1", lambda image, stamp_ns: None)
        self.recorder = Recorder(self.config, LogFolder(folder / "log"), clock)
        self.page = WebState(RIG)
        self.recorder.tick()
        for key in input_keys(self.config):
            self.bus.subscribe(key, self.estimate.take)
        self.bus.subscribe(topics.IMAGE.key(RIG, "cam1"), self.detect.points)
        self.bus.subscribe("vical/**", self.page.take)

        def record(sample: Sample) -> None:
            item = arrival(sample, clock)
            if item is not None:
                self.recorder.write(item)

        self.bus.subscribe(f"vical/{RIG}/**", record)

    def run(self, run: Any, junk: Junk | None) -> None:
        """Publish a recording, with junk or without."""
        number = 0
        for stamp_ns, key, payload in good_messages(run, BEGIN_NS):
            if junk is not None and "image" in key:
                for _ in range(JUNK_AT_ONCE):
                    self.bus.publish(*junk.message(number, stamp_ns))
                    number += 1
            self.bus.publish(key, payload)
            for answer in self.estimate.step():
                self.bus.publish(*answer)
            if "image" in key:
                self.page.tick()
                self.recorder.tick()
        self.estimate.finish()
        self.recorder.close()


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Rig, Path]:
    run = simulate(11, SECONDS, timeshift_cam_imu_s=0.012, camera_rate_hz=15.0)
    calm = Rig(tmp_path_factory.mktemp("calm"))
    calm.run(run, None)
    folder = tmp_path_factory.mktemp("disturbed")
    disturbed = Rig(folder)
    disturbed.run(run, Junk(24))
    return calm, disturbed, folder


def test_the_answer_is_the_same(both: tuple[Rig, Rig, Path]) -> None:
    calm, disturbed, _ = both
    a, b = calm.estimate.latest, disturbed.estimate.latest
    assert a is not None and b is not None
    assert a.status == b.status == Status.CONVERGED
    assert b.frames == a.frames and away_sigmas(a, b) < 1.0
    values = disturbed.estimate.statuses()[0].values
    assert all(int(values[name]) > 3 for name in ("malformed", "implausible", "stamps_refused"))
    images = {role.detect.status().values["images"] for role in (calm, disturbed)}
    assert len(images) == 1 and disturbed.detect.status().values["malformed"] != "0"


def test_every_log_opens_in_mcap_ros2_rosbags_and_rosbags_convert(
    both: tuple[Rig, Rig, Path], tmp_path: Path
) -> None:
    _, disturbed, folder = both
    logs = sorted((folder / "log").glob("*.mcap"))
    assert logs and disturbed.recorder.malformed > 100
    assert [problem for log in logs for problem in unopened(log, tmp_path)] == []


def test_a_log_with_junk_in_it_would_be_noticed(tmp_path: Path) -> None:
    from vical_daemon.logs.mcap import LogWriter

    path = tmp_path / "bad.mcap"
    writer = LogWriter(path)
    writer.write(topics.IMU.key(RIG, "imu0"), b"\x00\x01\x00\x00junk", BEGIN_NS)
    writer.close()
    assert len(unopened(path, tmp_path)) == 3


def test_junk_alone_fills_no_memory(tmp_path: Path) -> None:
    rig, junk = Rig(tmp_path), Junk(5)
    pool = [junk.message(k, BEGIN_NS) for k in range(2000)]
    sizes = []
    for k in range(12):
        for key, payload in pool:
            rig.bus.publish(key, payload)
        rig.estimate.step()
        rig.page.tick()
        rig.recorder.tick()
        if k >= 2:
            sizes.append(usage(os.getpid())[0])
    rig.recorder.close()
    assert np.median(sizes[-3:]) < np.median(sizes[:3]) + 8.0  # MB
    assert rig.estimate.settled == rig.estimate.images
