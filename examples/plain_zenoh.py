"""Without vical: eclipse-zenoh and rosbags are enough to follow where a camera sits.

    python examples/plain_zenoh.py [ENDPOINT]      # default: the service on this computer, for its group

Payloads are ROS 2 messages in CDR; the pose comes as geometry_msgs/PoseWithCovarianceStamped, in
addition to our own, richer message.
"""

from __future__ import annotations

import json
import os
import queue
import sys

import zenoh
from rosbags.typesys import Stores, get_typestore

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
KEY = "vical/*/calibration/*/pose"


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
        p_text = f"{p.x:.4f} {p.y:.4f} {p.z:.4f}"
        print(f"{sample.key_expr}: p {p_text} m, q {q.w:.4f} {q.x:.4f} {q.y:.4f} {q.z:.4f}", flush=True)

    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        own = f"unixsock-stream/{os.environ.get('XDG_RUNTIME_DIR', '/run/user/1000')}/vical/zenoh.sock"
        print(f"no bus at {endpoint}; start `vical run -c FILE`, or name its bus: {own}", file=sys.stderr)
        return 1
    with session:
        for reply in session.get(KEY):
            if reply.ok is not None:
                show(reply.ok)
        samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        session.declare_subscriber(KEY, samples.put)  # zenoh's own threads must not wait, and cannot raise
        while True:
            show(samples.get())


if __name__ == "__main__":
    try:
        sys.exit(main(*sys.argv[1:2]))
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # nobody reads any more, as after `| head -3`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
