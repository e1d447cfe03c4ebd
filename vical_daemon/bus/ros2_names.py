"""Names under which an unmodified ROS 2 machine with rmw_zenoh finds our messages. No I/O.

Conventions of rmw_zenoh since Jazzy (its docs/design.md): data travel on
``<domain>/<topic>/<dds type>/<type hash>`` with a 33-byte attachment; nodes and publishers are announced
as liveliness tokens below ``@ros2_lv``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b

from vical_daemon.bus import topics

ATTACHMENT = struct.Struct("<qqB16s")  # sequence, source time, length of the gid (a zenoh-ext varint), gid
GID_BYTES = 16


@dataclass(frozen=True, slots=True)
class Ros2Topic:
    """The ROS 2 side of one of our keys.

    Attributes:
        name: ROS topic with its leading slash.
        type_name: ROS 2 type, ``sensor_msgs/msg/Imu``.
        reliable: RELIABLE (else BEST_EFFORT).
        transient_local: The last message is kept for late subscribers (tf_static).
        depth: Length of the history.
    """

    name: str
    type_name: str
    reliable: bool = True
    transient_local: bool = False
    depth: int = 10


def ros2_topic(key: str, namespace: str = "") -> Ros2Topic | None:
    """Return the ROS 2 topic of a bus key; None for a key that ROS 2 does not get.

    Args:
        key: Of the bus.
        namespace: Before every topic, with its leading slash, so that robots on one router do not collide.

    >>> ros2_topic("vical/rig0/imu/imu0", "/rig0").name
    '/rig0/imu0/data'
    """
    parsed = topics.parse_key(key)
    if parsed is None:
        return None
    topic, name = parsed.topic, parsed.name
    names = {
        "imu": f"/{name}/data",
        "image": f"/{name}/image_raw",
        "compressed": f"/{name}/image_raw/compressed",
        "camera_info": f"/{name}/camera_info",
        "points": f"/{name}/target_points",
        "tracks": f"/{name}/feature_tracks",
        "predicted": f"/{name}/predicted_points",
        "calibration": f"/calibration/{name}",
        "stored": f"/calibration/{name}/stored",
        "verify": f"/calibration/{name}/verify",
        "pose": f"/calibration/{name}/pose",
        "tf_static": "/tf_static",
        "status": "/diagnostics",
    }
    if topic.kind not in names:
        return None
    static = topic.kind == "tf_static"
    reliable = topic.congestion is topics.Congestion.BLOCK or static
    return Ros2Topic(namespace + names[topic.kind], topic.type_name, reliable, static, 1 if static else 10)


def dds_type(type_name: str) -> str:
    """Return the DDS name of a ROS 2 type.

    >>> dds_type("sensor_msgs/msg/Imu")
    'sensor_msgs::msg::dds_::Imu_'
    """
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type's definition (REP 2016); 0.1 s the first time."""
    from vical_daemon.bus.messages.schemas import typestore

    return str(typestore().hash_rihs01(type_name))


def data_key(topic: Ros2Topic, domain: int = 0) -> str:
    """Return the zenoh key on which rmw_zenoh expects a topic's messages."""
    return f"{domain}/{topic.name.strip('/')}/{dds_type(topic.type_name)}/{type_hash(topic.type_name)}"


def mangle(name: str) -> str:
    """Write a ROS name as one chunk of a key: slashes become %, nothing becomes %.

    >>> mangle("/imu/data"), mangle("")
    ('%imu%data', '%')
    """
    return name.replace("/", "%") if name.strip("/") else "%"


def qos(topic: Ros2Topic) -> str:
    """Write the quality of service as rmw_zenoh does: fields at their default stay empty.

    >>> qos(Ros2Topic("/x", "std_msgs/msg/String"))
    '::,10:,:,:,,'
    """
    reliability = "" if topic.reliable else "2"
    durability = "1" if topic.transient_local else ""
    return f"{reliability}:{durability}:,{topic.depth}:,:,:,,"


def node_token(session_id: str, node_id: int, node: str, domain: int = 0, namespace: str = "") -> str:
    """Return the liveliness token that shows a node in the ROS graph."""
    return f"@ros2_lv/{domain}/{session_id}/{node_id}/{node_id}/NN/%/{mangle(namespace)}/{node}"


def publisher_token(
    session_id: str, node_id: int, entity_id: int, node: str, topic: Ros2Topic, domain: int = 0,
    namespace: str = "",
) -> str:  # fmt: skip
    """Return the liveliness token that shows a publisher in the ROS graph."""
    return (
        f"@ros2_lv/{domain}/{session_id}/{node_id}/{entity_id}/MP/%/{mangle(namespace)}/{node}/"
        f"{mangle(topic.name)}/{dds_type(topic.type_name)}/{type_hash(topic.type_name)}/{qos(topic)}"
    )


def gid(token: str) -> bytes:
    """Return 16 bytes that identify a publisher.

    rmw_zenoh hashes the token with XXH3. Subscribers only compare for equality, so any good hash works.
    """
    return blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(sequence: int, source_time_ns: int, publisher_gid: bytes) -> bytes:
    """Return the 33-byte attachment of a message; rmw_zenoh drops messages without it."""
    return ATTACHMENT.pack(sequence, source_time_ns, GID_BYTES, publisher_gid)
