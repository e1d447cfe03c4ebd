"""Images over the bus under every limit of locked memory: each arrives, or its number tells that it did not.

Every row runs in processes of its own, because the limit, and what a process has locked, are the process's.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from vical_daemon.bus import topics, zenoh_session
from vical_daemon.bus.zenoh_bus import open_bus

KIB = 1024
UNLIMITED = resource.RLIM_INFINITY
LIMITS = {
    "0.1 MiB": 100 * KIB,
    "2 MiB": 2048 * KIB,
    "8 MiB": 8192 * KIB,
    "64 MiB": 65536 * KIB,
    "all": UNLIMITED,
}
SMALL, IMAGE, LARGE = 300_000, 1_300_000, 5_000_000  # 640x480, 1.3 MP, larger than the pool
CAP_IPC_LOCK, PR_CAPBSET_DROP = 14, 24
HERE = Path(__file__)


def limited(limit: int) -> Callable[[], None] | None:
    """Return what a child does before it starts, so that the limit holds for it; skip where it cannot."""
    if limit == UNLIMITED:
        if not zenoh_session.can_share_memory():
            pytest.skip("this user may lock too little memory (ulimit -l)")
        return None
    _, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if hard != UNLIMITED and hard < limit:
        pytest.skip(f"this user's limit of locked memory cannot be raised to {limit // KIB} KiB")
    libc = ctypes.CDLL(None)

    def apply() -> None:
        libc.prctl(PR_CAPBSET_DROP, CAP_IPC_LOCK)  # root would be exempt
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (limit, limit))

    return apply


def child(limit: int, *words: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(HERE), *map(str, words)],
        preexec_fn=limited(limit),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )


def answer(process: subprocess.Popen[str]) -> Any:
    line = process.stdout.readline()
    assert line, f"child ended with {process.wait()}"
    return json.loads(line)


@pytest.fixture
def children() -> Iterator[list[subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            pipe.close()


@pytest.mark.parametrize("sessions", [1, 3])
@pytest.mark.parametrize("limit", LIMITS.values(), ids=LIMITS)
def test_sessions_of_one_process(tmp_path, children, limit, sessions):
    children.append(child(limit, "one-process", tmp_path / "bus", sessions))
    result = answer(children[0])
    assert len(result["received"]) == sessions
    for images, dropped in result["received"]:
        assert min(images) >= 1, "one size never arrives"
        assert sum(images) + dropped >= result["sent"]
    assert limit == UNLIMITED or result["locked_kib"] * KIB <= limit


@pytest.mark.parametrize("limit", LIMITS.values(), ids=LIMITS)
def test_two_processes(tmp_path, children, limit):
    """Images of the router, as acquire sends them, to us and to somebody else's program."""
    socket = tmp_path / "bus"
    sender = child(limit, "camera", "router", socket, "cam0,cam1", f"{SMALL},{IMAGE}", 20)
    children.append(sender)
    assert answer(sender) == "ready"
    receivers = [child(limit, "receiver", kind, socket) for kind in ("ours", "foreign")]
    children += receivers
    for receiver in receivers:
        assert answer(receiver) == "ready"
    release(sender)
    assert answer(sender) == 40
    for receiver in receivers:
        assert account(receiver, 2, 40) >= 20


def release(process: subprocess.Popen[str], word: object = "go") -> None:
    process.stdin.write(f"{word}\n")
    process.stdin.flush()


def account(receiver: subprocess.Popen[str], keys: int, images: int) -> int:
    """Check that a receiver has every image or knows that it does not; return how many it has."""
    release(receiver, keys)
    result = answer(receiver)
    assert result["ended"] == keys
    assert result["images"] + result["gaps"] >= images  # what follows a lost image may be lost as well
    assert result["dropped"] in (result["gaps"], None)
    return result["images"]


@pytest.mark.parametrize("processes", [1, 4])
@pytest.mark.parametrize("limit", [LIMITS["8 MiB"], LIMITS["all"]], ids=["8 MiB", "all"])
def test_four_cameras_and_five_subscribers(tmp_path, children, limit, processes):
    """Four cameras of 1.3 MP at 30 Hz; record, web and detect subscribe, and two foreign programs."""
    socket, images = tmp_path / "bus", 30
    names = [f"cam{i}" for i in range(4)]
    groups = [names] if processes == 1 else [[name] for name in names]
    cameras = []
    for i, group in enumerate(groups):
        mode = "router" if i == 0 else "client"
        cameras.append(child(limit, "camera", mode, socket, ",".join(group), IMAGE, images))
        children.append(cameras[-1])
        assert answer(cameras[-1]) == "ready"
    receivers = [child(limit, "receiver", "ours" if i < 3 else "foreign", socket) for i in range(5)]
    children += receivers
    for receiver in receivers:
        assert answer(receiver) == "ready"
    for camera in cameras:
        release(camera)
    for group, camera in zip(groups, cameras, strict=True):
        assert answer(camera) == images * len(group)
    for receiver in receivers:
        assert account(receiver, 4, 4 * images) >= 4


def test_copies_are_announced_once(caplog, monkeypatch, tmp_path):
    monkeypatch.setattr(zenoh_session, "can_share_memory", lambda: False)
    monkeypatch.setattr(zenoh_session, "_warned", False)
    with caplog.at_level("INFO"):
        router = open_bus(mode="router", socket=tmp_path / "bus")
        client = open_bus(mode="client", socket=tmp_path / "bus")
    client.close()
    router.close()
    said = [record.message for record in caplog.records if "copies images" in record.message]
    assert len(said) == 1
    assert "LimitMEMLOCK=infinity" in said[0]


# What the children do. Each says one line of JSON when it is ready, waits for a line, and says its result.


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
    """Send one byte for each camera, whose number tells of images lost before it."""
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
    for subscription in subscriptions:
        seen: list[int] = []
        ended: set[str] = set()
        end = time.monotonic() + 30
        while len(ended) < len(sizes) and time.monotonic() < end:
            _end(router, sizes)
            while (sample := subscription.recv(0.1)) is not None:
                seen.append(len(sample.payload))
                if seen[-1] == 1 and sample.sequence > 0:
                    ended.add(sample.key)
        received.append(([seen.count(size) for size in sizes.values()], subscription.dropped))
    _say({"sent": 10 * len(sizes), "received": received, "locked_kib": _locked_kib()})


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
