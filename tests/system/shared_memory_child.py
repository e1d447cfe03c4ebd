"""What the children of test_shared_memory.py do.

Each says one line of JSON when it is ready, waits for a line, and says its result.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import zenoh

from vical_daemon.bus import topics
from vical_daemon.bus.zenoh_bus import open_bus

SMALL, IMAGE, LARGE = 300_000, 1_300_000, 5_000_000  # 640x480, 1.3 MP, larger than the pool


def _say(what: object) -> None:
    print(json.dumps(what), flush=True)


def _locked_kib() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmLck")).split()[1])


def _publish(bus: Any, sizes: dict[str, int], count: int) -> None:
    """Send images of each camera's size at 30 Hz."""
    begin = time.monotonic()
    for i in range(count):
        for name, size in sizes.items():
            bus.publish(topics.IMAGE.key("rig0", name), bytes(size))
        time.sleep(max(0.0, begin + (i + 1) / 30 - time.monotonic()))


def _end(bus: Any, names: Iterable[str]) -> None:
    """Send one byte for each camera, whose number shows images lost before it."""
    for name in names:
        bus.publish(topics.IMAGE.key("rig0", name), b".")


def _one_process(socket: str, sessions: int) -> None:
    router = open_bus(mode="router", socket=socket)
    clients = [open_bus(mode="client", socket=socket) for _ in range(sessions)]
    subscriptions = [client.subscribe("vical/rig0/**") for client in clients]
    time.sleep(0.3)  # until the subscriptions are known to the router
    sizes = {"cam0": SMALL, "cam1": IMAGE, "cam2": LARGE}
    _end(router, sizes)  # what is lost before the first sample nobody can count
    time.sleep(0.3)
    _publish(router, sizes, 10)
    received = []
    sent = 10 * len(sizes)
    for subscription in subscriptions:
        seen: list[int] = []
        ended: set[str] = set()
        end = time.monotonic() + 30
        while time.monotonic() < end:
            # A busy machine may drop all ten of a size; only a size that never gets through is a fault.
            missing = {name: size for name, size in sizes.items() if size not in seen}
            if len(ended) == len(sizes) and not missing:
                break
            _publish(router, missing if ended else {}, 1)
            sent += len(missing) if ended else 0
            _end(router, sizes)
            while (sample := subscription.recv(0.1)) is not None:
                seen.append(len(sample.payload))
                if seen[-1] == 1 and sample.sequence > 0:
                    ended.add(sample.key)
        received.append(([seen.count(size) for size in sizes.values()], subscription.dropped, sent))
    _say({"received": received, "locked_kib": _locked_kib()})


def _camera(mode: str, socket: str, names: str, sizes: str, count: int) -> None:
    bus = open_bus(mode=mode, socket=socket)
    cameras = names.split(",")
    each = [int(size) for size in sizes.split(",")] * len(cameras)
    _say("ready")
    sys.stdin.readline()
    _end(bus, cameras)  # what is lost before the first sample nobody can count
    time.sleep(0.3)
    _publish(bus, dict(zip(cameras, each, strict=False)), count)
    _say(count * len(cameras))
    while True:
        _end(bus, cameras)
        time.sleep(0.1)


def _receiver(kind: str, socket: str) -> None:
    lock = threading.Lock()
    images: list[int] = []
    received: dict[str, list[int]] = {}
    ended: set[str] = set()

    def take(key: str, size: int, number: int) -> None:
        with lock:
            received.setdefault(key, []).append(number)
            if size > 1:
                images.append(number)
            elif number > 0:  # the first one only begins the count
                ended.add(key)

    dropped: Callable[[], int | None] = lambda: None  # noqa: E731
    if kind == "ours":
        bus = open_bus(mode="client", socket=socket)
        subscription = bus.subscribe("vical/rig0/**", lambda s: take(s.key, len(s.payload), s.sequence))
        dropped = lambda: subscription.dropped  # noqa: E731
    else:
        session = _foreign_session(socket)

        def read(sample: Any) -> None:
            number = int.from_bytes(sample.attachment.to_bytes()[8:16], "little")
            take(str(sample.key_expr), len(sample.payload.to_bytes()), number)

        subscriber = session.declare_subscriber("vical/rig0/**", read)
        assert subscriber
    time.sleep(0.3)  # until the subscription is known to the router
    _say("ready")
    keys = int(sys.stdin.readline())
    end = time.monotonic() + 60
    while time.monotonic() < end and len(ended) < keys:
        time.sleep(0.05)
    with lock:
        gaps = sum(max(numbers) - min(numbers) + 1 - len(numbers) for numbers in received.values())
        _say({"ended": len(ended), "images": len(images), "gaps": gaps, "dropped": dropped()})


def _foreign_session(socket: str) -> Any:
    """Open a session as a program that knows nothing of vical does."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([f"unixsock-stream/{socket}"]))
    return zenoh.open(config)


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    if what == "one-process":
        _one_process(rest[0], int(rest[1]))
    elif what == "camera":
        _camera(*rest[:4], int(rest[4]))
    else:
        _receiver(rest[0], rest[1])
    os._exit(0)
