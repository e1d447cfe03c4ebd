"""The client API over a bus in memory: latest, subscribe, wait; for threads and for asyncio."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import encode_calibration
from vical_daemon.client import AsyncClient, Client, ClientError
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status


def payload(status: Status = Status.CONVERGED, camera: str = "cam0", frames: int = 1) -> bytes:
    pose = PoseEstimate([0.1, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [[0.0] * 6] * 6)
    known = CameraEstimate(pose, 0.0, 0.0, [], [], "radtan", [], [], 0.2)
    cameras = {} if status is Status.WAITING else {camera: known}
    estimate = CalibrationEstimate(
        5, status, "too early", 0.5, "rotate", 1.0, frames, 10, cameras, None, [], 1.0, 0.0
    )
    return encode_calibration(estimate, camera)


KEY = topics.CALIBRATION.key("rig0", "cam0")


@pytest.fixture
def bus():
    return LocalBus()


def test_latest(bus):
    client = Client(bus)
    assert client.latest() == []
    bus.publish(KEY, payload(frames=1))
    bus.publish(KEY, payload(frames=2))
    bus.publish(topics.CALIBRATION.key("rig1", "cam0"), payload(Status.CONVERGING))
    assert [(u.rig, u.camera, u.estimate.frames, u.converged) for u in client.latest()] == [
        ("rig0", "cam0", 2, True),
        ("rig1", "cam0", 1, False),
    ]
    assert [u.rig for u in Client(bus, "rig1").latest("cam0")] == ["rig1"]
    assert client.latest("cam9") == []
    assert client.latest()[0].known.T_imu_cam.p_m == [0.1, 0.0, 0.0]


def test_late_joiner_gets_the_last_value_at_once(bus):
    bus.publish(KEY, payload(frames=7))
    got = []
    subscription = Client(bus).subscribe(got.append)
    assert [u.estimate.frames for u in got] == [7]
    bus.publish(KEY, payload(frames=8))
    subscription.close()
    bus.publish(KEY, payload(frames=9))
    assert [u.estimate.frames for u in got] == [7, 8]


def test_junk_on_our_key_is_nothing(bus):
    got = []
    Client(bus).subscribe(got.append)
    bus.publish(KEY, b"junk")
    bus.publish(KEY, b"")
    assert got == []
    assert Client(bus).latest() == []


def test_names_are_checked(bus):
    with pytest.raises(topics.TopicError):
        Client(bus, "rig0/../..")
    with pytest.raises(topics.TopicError):
        Client(bus).latest("**")


def test_wait_converged(bus):
    bus.publish(KEY, payload(Status.CONVERGING))
    timer = threading.Timer(0.1, lambda: bus.publish(KEY, payload(frames=42)))
    timer.start()
    assert Client(bus).wait_converged(5).estimate.frames == 42
    timer.join()


@pytest.mark.parametrize(
    ("status", "says"), [(None, "no calibration heard"), (Status.WAITING, "waiting: rotate")]
)
def test_wait_gives_up_and_says_where_it_stands(bus, status, says):
    if status is not None:
        bus.publish(KEY, payload(status))
        with pytest.raises(ClientError, match="too early"):
            _ = Client(bus).latest()[0].known
    begin = time.monotonic()
    with pytest.raises(ClientError, match=says):
        Client(bus).wait_converged(0.2)
    assert time.monotonic() - begin < 2


def test_slow_reader_gets_the_newest(bus):
    updates = Client(bus).updates(timeout_s=0.05)
    bus.publish(KEY, payload(frames=0))
    next(updates)
    for i in range(1, 1000):
        bus.publish(KEY, payload(frames=i))
    frames = [u.estimate.frames for u in updates]
    assert frames[-1] == 999
    assert len(frames) == 256


def test_async_client(bus):
    async def story():
        async with AsyncClient(Client(bus, owns_bus=False)) as client:
            assert await client.latest() == []
            with pytest.raises(ClientError, match="no calibration heard"):
                await client.wait_converged(0.1)
            bus.publish(KEY, payload(Status.CONVERGING))
            waiting = asyncio.create_task(client.wait_converged(5))
            await asyncio.sleep(0.05)
            thread = threading.Thread(target=lambda: bus.publish(KEY, payload(frames=42)))
            thread.start()
            assert (await waiting).estimate.frames == 42
            thread.join()
            seen = []
            async for update in client.updates():
                seen.append(update.estimate.frames)
                if len(seen) == 2:
                    break
                bus.publish(KEY, payload(frames=43))
            assert seen == [42, 43]

    asyncio.run(story())
