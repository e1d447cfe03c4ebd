"""Golden keys and tokens: verbatim from rmw_zenoh's design document, hashes as seen in the wild."""

import struct

import pytest
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr

from vical_daemon.bus import ros2_names as names
from vical_daemon.bus import topics
from vical_daemon.config.model import ConfigError, loads

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = names.Ros2Topic("/chatter", "std_msgs/msg/String", depth=7)


def test_data_key_of_the_design_document():
    assert names.data_key(CHATTER) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"


def test_tokens_of_the_design_document():
    listener = names.node_token("aac3178e146ba6f1fc6e6a4085e77f21", 0, "listener")
    assert listener == "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    talker = names.publisher_token("8b20917502ee955ac4476e0266340d5c", 0, 10, "talker", CHATTER)
    assert talker == (
        "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    )


def test_hash_of_imu_as_in_the_wild():
    assert names.type_hash("sensor_msgs/msg/Imu").startswith("RIHS01_7d9a00ff131080897a5ec7e26e315954")


@pytest.mark.parametrize(
    ("topic", "text"),
    [
        (names.Ros2Topic("/a", "std_msgs/msg/String"), "::,10:,:,:,,"),
        (names.Ros2Topic("/tf_static", "tf2_msgs/msg/TFMessage", True, True, 1), ":1:,1:,:,:,,"),
        (names.Ros2Topic("/a", "std_msgs/msg/String", reliable=False, depth=7), "2::,7:,:,:,,"),
    ],
)
def test_quality_of_service(topic, text):
    assert names.qos(topic) == text


def test_attachment_has_33_bytes_and_reads_back_elsewhere():
    gid = names.gid("some token")
    data = names.attachment(7, 1_700_000_000_000_000_001, gid)
    assert len(data) == 33
    assert struct.unpack_from("<qqB", data) == (7, 1_700_000_000_000_000_001, 16)
    read = Attachment.from_bytes(data)
    assert (read.sequence_id, read.timestamp_ns, read.gid) == (7, 1_700_000_000_000_000_001, gid)


def test_every_topic_but_commands_has_a_ros_name_of_its_own():
    seen = set()
    for topic in topics.TOPICS:
        ros = names.ros2_topic(topic.key("rig0", "cam0"))
        if topic is topics.COMMAND:
            assert ros is None
            continue
        assert ros.name.startswith("/")
        assert ros.name not in seen
        assert ros.type_name == topic.type_name
        seen.add(ros.name)
    assert names.ros2_topic("something/else") is None


def test_robots_on_one_router_do_not_collide():
    robots = {
        names.data_key(
            names.ros2_topic(topic.key(rig, "dev0"), loads(f"rig: {rig}\nros2: {{}}").ros2_namespace)
        )
        for rig in ("robot1", "robot2")
        for topic in topics.TOPICS
        if topic is not topics.COMMAND
    }
    assert len(robots) == 2 * (len(topics.TOPICS) - 1)


@pytest.mark.parametrize(
    ("text", "namespace"),
    [
        ("{}", "/rover"),
        ("{namespace: robot7}", "/robot7"),
        ("{namespace: /site/robot7}", "/site/robot7"),
        ("{namespace: _a/b_2}", "/_a/b_2"),
        ("{namespace: /}", ""),
        ("{domain: 7}", "/rover"),
    ],
)
def test_namespace_of_the_config(text, namespace):
    config = loads(f"rig: rover\nros2: {text}")
    assert config.ros2 is not None
    assert config.ros2_namespace == namespace
    assert names.ros2_topic("vical/rover/imu/imu0", config.ros2_namespace).name == f"{namespace}/imu0/data"


@pytest.mark.parametrize(
    "text", ["7up", "a//b", "a/", "a b", "a/7", "~/a", "a.b", "{a}", "''", "//", "a/*", "a" * 129]
)
def test_what_ros_would_refuse_is_refused(text):
    with pytest.raises(ConfigError, match=r"ros2\.namespace: .*\(config line 2\)"):
        loads(f"rig: rover\nros2: {{namespace: '{text.strip(chr(39))}'}}")


def test_without_the_section_there_are_no_ros_names():
    assert loads("rig: rover").ros2 is None


def test_tokens_are_understood_by_an_independent_parser():
    topic = names.ros2_topic("vical/rig0/imu/imu", "/rig0")
    token = names.publisher_token("abc", 0, 1, "vical", topic, domain=5, namespace="/rig0")
    parsed = _parse_liveliness_keyexpr(token)
    assert parsed["qualified_name"] == "/rig0/imu/data"
    assert parsed["namespace"] in ("/rig0", "%rig0")
    assert parsed["domain_id"] == 5
    assert parsed["dds_type"] == "sensor_msgs::msg::dds_::Imu_"
    assert parsed["node_name"].strip("/") == "vical"
