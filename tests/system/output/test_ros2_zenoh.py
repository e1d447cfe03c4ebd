"""An independent ROS 2 subscriber (zenoh-ros2-sdk) hears us through a router of our own on loopback."""

import json
import socket
import threading
import time

import pytest
import zenoh
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_names_and_types
from zenoh_ros2_sdk.session import ZenohSession

from vical_daemon.bus.messages import Transform, encode_imu, encode_pose, encode_transforms
from vical_daemon.bus.messages.schemas import ros2_schema
from vical_daemon.bus.ros2_names import type_hash
from vical_daemon.bus.zenoh_ros2 import Ros2Publisher
from vical_daemon.estimation.result import PoseEstimate

pytestmark = pytest.mark.system
T0_NS = 1_700_000_000_123_456_789


@pytest.fixture
def router():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
    yield session, port
    session.close()


def subscribe(port, topic, type_name, callback):
    return ROS2Subscriber(
        topic, type_name, callback, msg_definition=ros2_schema(type_name), type_hash=type_hash(type_name),
        router_port=port,
    )  # fmt: skip


def test_an_unmodified_subscriber_hears_imu_and_late_static_transform(router):
    session, port = router
    publisher = Ros2Publisher(session, namespace="/rig0")
    static = Transform(T0_NS, "imu", "cam0", (0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
    publisher.publish("vical/rig0/tf_static", encode_transforms([static]))
    heard, enough = [], threading.Event()

    def on_imu(message):
        heard.append(message)
        if len(heard) >= 20:
            enough.set()

    subscriber = subscribe(port, "/rig0/imu/data", "sensor_msgs/msg/Imu", on_imu)
    try:
        payload = encode_imu(T0_NS, "imu", (0.1, 0.2, 0.3), (0.0, 0.0, 9.8))
        end = time.monotonic() + 45
        while not enough.is_set() and time.monotonic() < end:
            publisher.publish("vical/rig0/imu/imu", payload)
            time.sleep(0.01)
        assert enough.is_set()
        assert heard[0].linear_acceleration.z == 9.8
        assert heard[0].header.frame_id == "imu"
        assert heard[0].header.stamp.nanosec == 123_456_789

        names = dict(get_topic_names_and_types(router_port=port))
        assert names["/rig0/imu/data"] == ["sensor_msgs/msg/Imu"]
        assert "/rig0/tf_static" in names
    finally:
        subscriber.close()
        ZenohSession._instance = None
        publisher.close()
        publisher.close()


def test_the_bus_of_a_process_speaks_ros_when_told(tmp_path):
    from vical_daemon.cli.bus_access import open_for_roles
    from vical_daemon.config.model import BusConfig, Config, Ros2Config

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = Config(bus=BusConfig(socket=str(tmp_path / "z.sock"), tcp_port=port), ros2=Ros2Config(domain=4))
    bus = open_for_roles(config, ("imu", "camera"), threading.Event())
    own, ros = [], threading.Event()
    bus.subscribe("vical/rig0/imu/*", own.append)
    with zenoh.open(client_config(port)) as listener:
        subscriber = listener.declare_subscriber("4/rig0/imu0/data/**", lambda _sample: ros.set())
        payload = encode_imu(T0_NS, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))
        end = time.monotonic() + 45
        while not (ros.is_set() and own) and time.monotonic() < end:
            bus.publish("vical/rig0/imu/imu0", payload)
            time.sleep(0.02)
        subscriber.undeclare()
        tokens = [str(reply.ok.key_expr) for reply in listener.liveliness().get("@ros2_lv/4/**") if reply.ok]
        assert any("/NN/%/%rig0/" in token for token in tokens)  # the read-only endpoint shows the graph, too
        assert any("%rig0%imu0%data" in token for token in tokens)
        static = Transform(T0_NS, "imu", "cam0", (0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
        bus.publish("vical/rig0/tf_static", encode_transforms([static]))
        statics: list[object] = []
        late = zenoh.ext.declare_advanced_subscriber(
            listener, "4/rig0/tf_static/**", statics.append,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )  # fmt: skip
        end = time.monotonic() + 45
        while not statics and time.monotonic() < end:
            time.sleep(0.02)
        assert statics
        late.undeclare()
    assert ros.is_set()
    assert own[0].payload == payload
    assert bus.connected
    bus.close()
    bus.close()


def client_config(port):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    return config


def test_attachments_count_up_and_static_messages_wait_for_late_joiners(router):
    session, port = router
    publisher = Ros2Publisher(session, domain=3)
    pose = PoseEstimate([0.1, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [[0.0] * 6] * 6)
    static = Transform(T0_NS, "imu", "cam0", (0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
    publisher.publish("vical/rig0/tf_static", encode_transforms([static]))
    with zenoh.open(client_config(port)) as late:
        samples, statics = [], []
        plain = late.declare_subscriber("3/calibration/**", samples.append)
        advanced = zenoh.ext.declare_advanced_subscriber(
            late, "3/tf_static/**", statics.append,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )  # fmt: skip
        end = time.monotonic() + 45
        while (len(samples) < 3 or not statics) and time.monotonic() < end:
            publisher.publish("vical/rig0/calibration/cam0/pose", encode_pose(T0_NS, "imu", pose))
            time.sleep(0.02)
        sequences = [int.from_bytes(s.attachment.to_bytes()[:8], "little") for s in samples]
        assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
        assert len({s.attachment.to_bytes()[17:] for s in samples}) == 1
        assert len(samples[0].attachment.to_bytes()) == 33
        assert statics
        plain.undeclare()
        advanced.undeclare()
    publisher.close()
