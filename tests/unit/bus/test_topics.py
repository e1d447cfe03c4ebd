"""The table of keys."""

from __future__ import annotations

import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import key_matches
from vical_daemon.bus.topics import TOPICS, TopicError, parse_key


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.kind)
def test_every_key_says_what_it_is(topic):
    key = topic.key("rig7", "thing_1")
    parsed = parse_key(key)
    assert parsed is not None
    assert (parsed.rig, parsed.topic) == ("rig7", topic)
    assert parsed.name == ("thing_1" if "{name}" in topic.pattern else "")
    assert key_matches(topics.rig_expression("rig7"), key)
    assert not key_matches(topics.rig_expression("rig8"), key)


@pytest.mark.parametrize(
    "name", ["", "../etc", "a/b", "*", "**", "0cam", "cam 0", "cam-0", "x" * 64, "ä", "a\n"]
)
def test_names_that_could_leave_their_key_are_refused(name):
    with pytest.raises(TopicError, match="valid name"):
        topics.IMU.key(name, "imu0")
    with pytest.raises(TopicError, match="valid name"):
        topics.IMU.key("rig0", name)


@pytest.mark.parametrize(
    "key", ["", "vical", "vical/rig0", "vical/rig0/imu", "other/rig0/imu/imu0", "vical/rig0/imu/a/b"]
)
def test_foreign_keys_are_nobodys(key):
    assert parse_key(key) is None


def test_key_functions_agree_with_the_table():
    assert topics.IMU.key("rig0", "imu0") == "vical/rig0/imu/imu0"
    assert topics.IMAGE.key("rig0", "cam0") == "vical/rig0/camera/cam0/image"
    assert topics.POINTS.key("rig0", "cam0") == "vical/rig0/camera/cam0/points"
    assert topics.CALIBRATION.key("rig0", "cam0") == "vical/rig0/calibration/cam0"
    assert topics.STATUS.key("rig0", "record") == "vical/rig0/status/record"
    assert topics.TF_STATIC.key("rig0") == "vical/rig0/tf_static"
