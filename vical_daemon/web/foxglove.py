"""Serves the bus to Foxglove over its WebSocket: the same bytes, fetched only while a viewer subscribes.

Points are also sent as image annotations, so that Foxglove draws them into the image. The annotations are
not ROS messages and are never recorded.
"""

from __future__ import annotations

import threading
from typing import Any

import foxglove
from foxglove.channels import ImageAnnotationsChannel
from foxglove.messages import (
    Color,
    ImageAnnotations,
    Point2,
    PointsAnnotation,
    PointsAnnotationType,
    Timestamp,
)

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample, Subscription
from vical_daemon.bus.messages import MessageError, decode_points
from vical_daemon.bus.messages.schemas import ros2_schema
from vical_daemon.config.model import Config

BACKLOG = 256  # messages kept for a slow viewer; the oldest are dropped first
_SUFFIX = "/annotations"
_GREEN, _ORANGE = Color(r=0.0, g=0.8, b=0.4, a=1.0), Color(r=1.0, g=0.55, b=0.26, a=1.0)
_DRAWN = {topics.POINTS: _GREEN, topics.TRACKS: _GREEN, topics.PREDICTED: _ORANGE}


class FoxgloveError(Exception):
    """The WebSocket cannot be served; the message says where and what to try."""


class FoxgloveServer:
    """Serves one rig.

    Args:
        bus: Source of the messages.
        config: Names of the rig's devices.
        host: Address to listen on.
        port: 0: any free one, see `port`.

    Raises:
        FoxgloveError: The address cannot be used.
    """

    def __init__(self, bus: Bus, config: Config, host: str, port: int) -> None:
        self._bus = bus
        self._lock = threading.Lock()
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._annotations: dict[str, Any] = {}
        self._wanted: dict[str, int] = {}
        self._subscriptions: dict[str, Subscription] = {}
        for key in rig_keys(config):
            self._advertise(key)
        try:
            self._server = foxglove.start_server(
                name=f"vical {config.rig}", host=host, port=port, context=self._context,
                server_listener=self, message_backlog_size=BACKLOG, session_id=f"vical-{config.rig}",
            )  # fmt: skip
        except (OSError, RuntimeError) as error:
            text = " ".join(str(error).split())
            raise FoxgloveError(f"cannot serve Foxglove on {host}:{port}: {text}") from error
        self.port = int(self._server.port)

    def _advertise(self, key: str) -> None:
        parsed = topics.parse_key(key)
        assert parsed is not None
        type_name = parsed.topic.type_name
        schema = foxglove.Schema(name=type_name, encoding="ros2msg", data=ros2_schema(type_name).encode())
        topic = f"/{key}"
        self._channels[topic] = foxglove.Channel(
            topic, schema=schema, message_encoding="cdr", context=self._context
        )
        if parsed.topic in _DRAWN:
            drawn = topic + _SUFFIX
            self._annotations[drawn] = ImageAnnotationsChannel(drawn, context=self._context)

    def on_subscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002
        """Fetch a topic from its first viewer on."""
        self._count(channel.topic, 1)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002
        """Stop fetching a topic after its last viewer."""
        self._count(channel.topic, -1)

    def _count(self, topic: str, change: int) -> None:
        with self._lock:
            if topic not in self._channels and topic not in self._annotations:
                return
            now = self._wanted[topic] = max(self._wanted.get(topic, 0) + change, 0)
            if now and topic not in self._subscriptions:
                key = topic.removesuffix(_SUFFIX).removeprefix("/")
                take = self._draw if topic in self._annotations else self._pass_on
                self._subscriptions[topic] = self._bus.subscribe(key, take)
                last = [] if take == self._draw else self._bus.latest(key, 0.2)
            elif not now and topic in self._subscriptions:
                self._subscriptions.pop(topic).close()
                return
            else:
                return
        for sample in last:
            self._pass_on(sample)

    def _pass_on(self, sample: Sample) -> None:
        self._channels[f"/{sample.key}"].log(sample.payload)

    def _draw(self, sample: Sample) -> None:
        parsed = topics.parse_key(sample.key)
        try:
            points = decode_points(sample.payload)
        except MessageError:
            return
        assert parsed is not None
        stamp = Timestamp(sec=points.stamp_ns // 10**9, nsec=points.stamp_ns % 10**9)
        dots = PointsAnnotation(
            timestamp=stamp,
            type=PointsAnnotationType.Points,
            points=[Point2(x=float(u), y=float(v)) for u, v in points.uv_px],
            outline_color=_DRAWN[parsed.topic],
            thickness=3.0,
        )
        self._annotations[f"/{sample.key}{_SUFFIX}"].log(ImageAnnotations(points=[dots]))

    def close(self) -> None:
        """Stop serving; may be called twice."""
        with self._lock:
            subscriptions, self._subscriptions = list(self._subscriptions.values()), {}
        for subscription in subscriptions:
            subscription.close()
        if self._server is not None:
            self._server.stop()
            self._server = None


def rig_keys(config: Config) -> list[str]:
    """Return every key that a rig of this config publishes on (commands left out)."""
    names = {
        "imu": list(config.imus),
        "calibration": list(config.cameras),
        "pose": list(config.cameras),
        "status": ["imu", "camera", "detect", "estimate", "record", "web"],
        "tf_static": [""],
    }
    keys = []
    for topic in topics.TOPICS:
        if topic is not topics.COMMAND:
            keys += [topic.key(config.rig, name) for name in names.get(topic.kind, list(config.cameras))]
    return keys
