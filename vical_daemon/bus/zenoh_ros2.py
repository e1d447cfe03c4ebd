"""Publishes our messages under ROS 2 names on the same zenoh session.

`ros2 topic echo /rig0/imu0/data` works. The payloads are ROS 2 CDR already: only key, attachment and tokens
are added. A ROS machine needs rmw_zenoh_cpp and a route to our router (`tcp/<robot>:7447`; see
docs/how-to/ros2.md).
"""

from __future__ import annotations

import threading
import time
from typing import Any

import zenoh

from vical_daemon.bus import ros2_names
from vical_daemon.bus.ros2_names import Ros2Topic

_HEARTBEAT_S = 0.2


class Ros2Publisher:
    """Publishes bus messages to ROS 2; thread-safe. See `ZenohBus.mirror_to`.

    Args:
        session: An open zenoh session.
        node: Name of the node in the ROS graph.
        domain: ROS_DOMAIN_ID.
        namespace: Of node and topics, with its leading slash; empty: none.
    """

    def __init__(self, session: Any, node: str = "vical", domain: int = 0, namespace: str = "") -> None:
        self._session, self._node, self._domain, self._namespace = session, node, domain, namespace
        self._session_id = str(session.info.zid())
        self._lock = threading.Lock()
        self._publishers: dict[str, _TopicPublisher | None] = {}
        self._by_topic: dict[str, _TopicPublisher] = {}
        token = ros2_names.node_token(self._session_id, 0, node, domain, namespace)
        self._node_token = session.liveliness().declare_token(token)

    def publish(self, key: str, payload: bytes) -> None:
        """Send one message if its key has a ROS name."""
        with self._lock:
            if key not in self._publishers:
                self._publishers[key] = self._publisher(key)
            publisher = self._publishers[key]
            if publisher is not None:
                publisher.put(payload)

    def _publisher(self, key: str) -> _TopicPublisher | None:
        topic = ros2_names.ros2_topic(key, self._namespace)
        if topic is None:
            return None
        if topic.name not in self._by_topic:  # /diagnostics has many keys
            number = len(self._by_topic) + 1
            token = ros2_names.publisher_token(
                self._session_id, 0, number, self._node, topic, self._domain, self._namespace
            )
            self._by_topic[topic.name] = _TopicPublisher(self._session, topic, self._domain, token)
        return self._by_topic[topic.name]

    def close(self) -> None:
        """Leave the ROS graph; may be called twice."""
        with self._lock:
            for publisher in self._by_topic.values():
                publisher.close()
            self._by_topic, self._publishers = {}, {}
            if self._node_token is not None:
                self._node_token.undeclare()
                self._node_token = None


class _TopicPublisher:
    """One ROS topic: publisher, token, sequence number."""

    def __init__(self, session: Any, topic: Ros2Topic, domain: int, token: str) -> None:
        self._gid = ros2_names.gid(token)
        self._sequence = 0
        key = ros2_names.data_key(topic, domain)
        congestion = zenoh.CongestionControl.BLOCK if topic.reliable else zenoh.CongestionControl.DROP
        self._publisher: Any
        if topic.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=congestion,
                cache=zenoh.ext.CacheConfig(topic.depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S
                ),
                publisher_detection=True,
            )
        else:
            self._publisher = session.declare_publisher(key, congestion_control=congestion)
        self._token = session.liveliness().declare_token(token)

    def put(self, payload: bytes) -> None:
        self._sequence += 1
        note = ros2_names.attachment(self._sequence, time.time_ns(), self._gid)
        self._publisher.put(payload, attachment=note)

    def close(self) -> None:
        self._token.undeclare()
        self._publisher.undeclare()
