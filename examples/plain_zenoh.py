"""Without vical: eclipse-zenoh and rosbags are enough to follow where a camera sits.

    python examples/plain_zenoh.py [ENDPOINT]      # default: the service on this computer, for its group

Payloads are ROS 2 messages in CDR; the pose comes as geometry_msgs/PoseWithCovarianceStamped, in
addition to our own, richer message.
"""

from __future__ import annotations

import json
import os
import sys
import time

import zenoh
from rosbags.typesys import Stores, get_typestore

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def main(endpoint: str = "unixsock-stream//run/vical/zenoh.sock") -> int:
    """Ask for the last pose of every camera, then print each new one; 1 where there is no bus."""
    typestore = get_typestore(Stores.ROS2_JAZZY)
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")

    def show(sample: zenoh.Sample) -> None:
        message = typestore.deserialize_cdr(sample.payload.to_bytes(), POSE)
        p, q = message.pose.pose.position, message.pose.pose.orientation
        print(
            f"{sample.key_expr}: p {p.x:.4f} {p.y:.4f} {p.z:.4f} m, q {q.w:.4f} {q.x:.4f} {q.y:.4f} {q.z:.4f}"
        )

    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        own = f"unixsock-stream/{os.environ.get('XDG_RUNTIME_DIR', '/run/user/1000')}/vical/zenoh.sock"
        print(f"no bus at {endpoint}; start `vical run -c FILE`, or name its bus: {own}", file=sys.stderr)
        return 1
    with session:
        for reply in session.get("vical/*/calibration/*/pose"):
            if reply.ok is not None:
                show(reply.ok)
        session.declare_subscriber("vical/*/calibration/*/pose", show)
        while True:
            time.sleep(1)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
