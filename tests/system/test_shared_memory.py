"""Images over the bus under every limit of locked memory: each arrives, or its number shows that it did not.

Every row runs in processes of its own, because the limit, and what a process has locked, are the process's.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.system.shared_memory_child import IMAGE, SMALL
from vical_daemon.bus import zenoh_session
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
CAP_IPC_LOCK, PR_CAPBSET_DROP = 14, 24
CHILD = Path(__file__).with_name("shared_memory_child.py")  # without pytest: 50 of them start


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
        [sys.executable, str(CHILD), *map(str, words)],
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
    for images, dropped, sent in result["received"]:
        assert min(images) >= 1, "one size never arrives"
        assert sum(images) + dropped >= sent
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
