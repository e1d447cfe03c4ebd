"""Our logs in other people's hands: rosbags, mcap, rosbags-convert (ROS 1 and sqlite3), rerun's checker.

VICAL_LOG=demo_out/….mcap runs the same on a log of your own instead of one with every topic made here.
"""

import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.logs.mcap import LogWriter

pytestmark = pytest.mark.system
T0_NS = 1_700_000_000_000_000_000
COUNT = 25
LENS = [50.0, 50.0, 32.0, 24.0]
FINE = m.DiagnosticStatus(m.Level.OK, "imu/imu0", "fine")

MOVED = m.Change("position", 3e-3, 4e-4, (1.0, 0.0, 0.0))


def payload(topic, k, web_feed):
    """A message of each kind."""
    stamp = T0_NS + 40_000_000 * k
    grid, pose = (
        np.arange(12.0).reshape(6, 2),
        m.Transform(stamp, "imu0", "cam0", (0.1, 0.0, 0.0), (1.0, 0, 0, 0)),
    )
    estimate = web_feed.estimate(1.0 + k, np.random.default_rng(k))
    return {
        "imu": lambda: m.encode_imu(stamp, "imu0", (0.1, 0.2, 0.3), (0.0, 0.0, 9.8)),
        "image": lambda: m.encode_image(stamp, "cam0", np.full((48, 64), k, np.uint8), "mono8"),
        "compressed": lambda: m.encode_compressed_image(stamp, "cam0", "jpeg", b"\xff\xd8\xff\xd9"),
        "camera_info": lambda: m.encode_camera_info(stamp, "cam0", (64, 48), LENS, "radtan", [0] * 4),
        "points": lambda: m.encode_points(stamp, "cam0", np.arange(6), grid, None, (64, 48)),
        "tracks": lambda: m.encode_points(stamp, "cam0", np.arange(6), grid, np.ones(6), (64, 48)),
        "predicted": lambda: m.encode_points(stamp, "cam0", np.arange(6), grid),
        "calibration": lambda: m.encode_calibration(estimate, "cam0"),
        "stored": lambda: m.encode_calibration(estimate, "cam0"),
        "verify": lambda: m.encode_verification(
            m.VerifyResult(stamp, "cam0", m.CheckState.RESTING, "changed", stamp, changes=(MOVED,))
        ),
        "pose": lambda: m.encode_pose(stamp, "imu0", estimate.cameras["cam0"].T_imu_cam),
        "tf_static": lambda: m.encode_transforms([pose]),
        "status": lambda: m.encode_diagnostics(stamp, "imu", [FINE]),
        "command": lambda: m.encode_string("start"),
    }[topic.kind]()  # fmt: skip


@pytest.fixture(scope="module")
def log(tmp_path_factory, web_feed):
    given = os.environ.get("VICAL_LOG")
    if given:
        return Path(given).absolute()
    path = tmp_path_factory.mktemp("log") / "rig0.mcap"
    with LogWriter(path, {"vical": {"rig": "rig0"}}) as writer:
        for k in range(COUNT):
            for topic in topics.TOPICS:
                name = "imu0" if topic.kind == "imu" else "cam0"
                writer.write(topic.key("rig0", name), payload(topic, k, web_feed), T0_NS + 40_000_000 * k)
        writer.attach("config.yaml", "text/yaml", b"rig: rig0\n", T0_NS)
    return path


def counts(path):
    """Messages of each topic, every one of them deserialised."""
    found = Counter()
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            found[connection.topic] += 1
    return found


def first_rates(path):
    """Stamp and angular rate of the first inertial sample."""
    with AnyReader([path]) as reader:
        kept = [c for c in reader.connections if c.msgtype == "sensor_msgs/msg/Imu"]
        connection, _, raw = next(reader.messages(connections=kept))
        message = reader.deserialize(raw, connection.msgtype)
        rate, stamp = message.angular_velocity, message.header.stamp
        return stamp.sec, stamp.nanosec, message.header.frame_id, rate.x, rate.y, rate.z


def test_rosbags_reads_every_message(log):
    found = counts(log)
    assert found
    if "VICAL_LOG" not in os.environ:
        assert found == {
            f"/{t.key('rig0', 'imu0' if t.kind == 'imu' else 'cam0')}": COUNT for t in topics.TOPICS
        }


def test_mcap_reads_summary_and_messages(log):
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        assert sum(1 for _ in reader.iter_messages()) == summary.statistics.message_count


@pytest.mark.parametrize("target", ["log.bag", "log_sqlite3"])
def test_rosbags_convert_takes_it(log, target, tmp_path):
    tool = Path(sys.executable).with_name("rosbags-convert")
    assert tool.exists(), "rosbags is a dependency"
    out = tmp_path / target
    words = [str(tool), "--src", str(log), "--dst", str(out)]
    if target == "log_sqlite3":
        words += ["--dst-storage", "sqlite3"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert counts(out) == counts(log)
    assert first_rates(out) == first_rates(log)


def test_rerun_finds_nothing_wrong(log, tmp_path):
    tool = os.environ.get("VICAL_RERUN") or shutil.which("rerun")
    if tool is None:
        pytest.skip("no rerun here (pip install rerun-sdk into a venv of its own, VICAL_RERUN=…/bin/rerun)")
    check = subprocess.run(
        [tool, "mcap", "check", str(log)], capture_output=True, text=True, timeout=300, check=False
    )
    assert check.returncode == 0, check.stdout + check.stderr
    out = tmp_path / "log.rrd"
    words = [tool, "mcap", "convert", str(log), "-o", str(out)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert out.stat().st_size > 0
