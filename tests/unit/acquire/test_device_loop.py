"""Keeping a device streaming: late plug-in, loss, silence, a stuck driver, and a bus that is slow."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from vical_drivers.errors import DataEndedError, DeviceLostError, DeviceNotFoundError, DeviceReplacedError
from vical_drivers.samples import DeviceInfo, SourceStats

from vical_daemon.acquire.device_loop import DeviceLoop
from vical_daemon.acquire.device_status import STUCK_S, _level, device_status
from vical_daemon.acquire.direct_queue import BackupReader, DirectQueue
from vical_daemon.acquire.publish_queue import PublishQueue
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import Level
from vical_daemon.service import notify
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import private_clock


class ScriptedSource:
    """Plays a list of batches; an exception in it is raised."""

    def __init__(self, script: list[Any], serial_number: str = "S1") -> None:
        self.script = script
        self.serial_number = serial_number
        self.closed = False

    @property
    def info(self) -> DeviceInfo:
        return DeviceInfo("imu", "scripted", self.serial_number)

    def read(self, timeout_s: float) -> list[int]:
        if not self.script:
            time.sleep(min(timeout_s, 0.01))
            return []
        step = self.script.pop(0)
        if isinstance(step, Exception):
            raise step
        return step

    def stats(self) -> SourceStats:
        return SourceStats(samples=3, rate_hz=100.0)

    def __enter__(self) -> ScriptedSource:
        return self

    def __exit__(self, *args: object) -> None:
        self.closed = True


@pytest.fixture
def stop():
    event = threading.Event()
    yield event
    event.set()


def _wait_for(condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it does not happen"
        time.sleep(0.005)


def _loop(opener, got, stop, **options) -> DeviceLoop[int]:
    loop = DeviceLoop(
        "imu/imu0",
        opener,
        got.append,
        stop,
        read_timeout_s=0.02,
        first_pause_s=0.02,
        longest_pause_s=0.05,
        **options,
    )
    loop.start()
    return loop


def test_a_device_that_appears_later_is_opened_then(stop) -> None:
    attempts: list[Any] = [DeviceNotFoundError("not there"), DeviceNotFoundError("not there")]

    def opener() -> ScriptedSource:
        if attempts:
            raise attempts.pop()
        return ScriptedSource([[1, 2], [3]])

    got: list[int] = []
    loop = _loop(opener, got, stop)
    _wait_for(lambda: got == [1, 2, 3])
    assert loop.health().state == "streaming" and loop.health().problem == ""


def test_a_lost_device_is_reported_and_comes_back_by_itself(stop) -> None:
    source = ScriptedSource([[1], DeviceLostError("unplugged"), DeviceLostError("unplugged")])
    got: list[int] = []
    loop = _loop(lambda: source, got, stop)
    _wait_for(lambda: loop.health().state == "lost")
    assert loop.health().problem == "unplugged" and not source.closed
    source.script.append([2])
    _wait_for(lambda: got == [1, 2] and loop.health().state == "streaming")
    assert loop.health().openings == 1


def test_a_driver_that_dies_again_and_again_is_logged_once(stop, caplog) -> None:
    caplog.set_level("INFO")
    opened: list[int] = []

    def opener() -> ScriptedSource:
        opened.append(1)
        return ScriptedSource([RuntimeError("a bug")] if len(opened) < 6 else [[1]])

    got: list[int] = []
    loop = _loop(opener, got, stop)
    _wait_for(lambda: bool(got) and loop.health().state == "streaming")
    assert loop.health().openings == 6
    lines = [record.message for record in caplog.records]
    assert lines == [
        f"imu/imu0: {line}" for line in ("open: imu scripted serial S1", "RuntimeError: a bug", "back")
    ]


def test_another_device_is_opened_from_scratch_and_told_in_the_journal(stop, monkeypatch) -> None:
    events: list[tuple[str, str]] = []
    monkeypatch.setattr(notify, "event", lambda name, text, **_: events.append((name, text)))
    lost = DeviceLostError("unplugged")
    sources = [
        ScriptedSource([[1], lost, DeviceReplacedError("another device came back")], serial_number="S1"),
        ScriptedSource([[2], lost, [3]], serial_number="S2"),
    ]
    waiting = sources[:]
    got: list[int] = []
    loop = _loop(lambda: waiting.pop(0), got, stop)
    _wait_for(lambda: got == [1, 2, 3])
    assert sources[0].closed and not sources[1].closed and loop.openings == 2
    info = loop.health().info
    assert info is not None and info.serial_number == "S2"
    replaced = [text for name, text in events if name == "device_replaced"]
    assert replaced == ["imu/imu0 is another device now: scripted serial S2, not scripted serial S1"]


def test_a_device_that_is_opened_is_told_at_once(stop) -> None:
    """Not with the next status: samples of another device must not run ahead of its serial number."""
    sent, openings = [], iter([0, 1, 1, 1, 2])

    def count() -> int:
        try:
            return next(openings)
        except StopIteration:
            stop.set()
            return 2

    class CountingBus(LocalBus):
        def publish(self, key: str, payload: bytes) -> None:
            sent.append(key)

    sender = StatusSender("rig0", "imu", CountingBus(), private_clock())
    sender.run_until(stop, list, count)
    assert len(sent) >= 3  # the first, and one for each opening


def test_a_silent_device_is_opened_again(stop) -> None:
    sources: list[ScriptedSource] = []

    def opener() -> ScriptedSource:
        sources.append(ScriptedSource([[len(sources)]]))
        return sources[-1]

    got: list[int] = []
    loop = _loop(opener, got, stop, silence_s=0.1)
    _wait_for(lambda: got[:3] == [0, 1, 2])
    assert sources[0].closed and loop.health().openings >= 3


def test_a_recording_at_its_end_is_neither_lost_nor_opened_again(stop, monkeypatch) -> None:
    events: list[str] = []
    monkeypatch.setattr(notify, "event", lambda name, text, **_: events.append(name))
    source = ScriptedSource([[1], DataEndedError("run.mcap has ended")])
    got: list[int] = []
    loop = _loop(lambda: source, got, stop, silence_s=0.05)
    _wait_for(lambda: loop.health().state == "ended")
    time.sleep(0.2)  # longer than a silent device is waited for
    health = loop.health()
    assert health.openings == 1 and health.loop_age_s < STUCK_S and events == ["recording_ended"]
    outbox = PublishQueue(LocalBus(), 4, "out")
    status = device_status("imu/imu0", health, outbox, 100.0)
    assert status.level is Level.WARN and status.message == "run.mcap has ended"
    outbox.close()
    stop.set()
    assert loop.join(2.0) and source.closed


def test_stop_closes_the_device(stop) -> None:
    source = ScriptedSource([[1]])
    loop = _loop(lambda: source, [], stop)
    _wait_for(lambda: loop.health().info is not None)
    stop.set()
    assert loop.join(2.0) and source.closed


def test_a_stuck_driver_makes_the_status_stale(stop) -> None:
    blocked = threading.Event()

    class Stuck(ScriptedSource):
        def read(self, timeout_s: float) -> list[int]:
            blocked.wait(10)
            return []

    bus = LocalBus()
    queue = PublishQueue(bus, 4, "out")
    loop = _loop(lambda: Stuck([]), [], stop)
    _wait_for(lambda: loop.health().info is not None)
    loop._t_loop_s -= STUCK_S + 1
    status = device_status("imu/imu0", loop.health(), queue, 100.0)
    assert status.level is Level.STALE and "stuck" in status.message
    blocked.set()
    stop.set()
    queue.close()


def test_publish_queue_keeps_order_and_drops_the_oldest_when_the_bus_is_slow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus, gate, got = LocalBus(), threading.Event(), []

    def slow(sample) -> None:
        gate.wait(5)
        got.append(sample.payload)

    bus.subscribe("vical/**", slow)
    queue = PublishQueue(bus, 3, "out")
    queue.put("vical/a", b"0")
    _wait_for(lambda: queue.waiting == 0)  # the first is in the hands of the bus
    for i in range(1, 6):
        queue.put("vical/a", str(i).encode())
    assert (queue.waiting, queue.dropped) == (3, 2)
    assert _level(_streaming(), queue, 100.0)[0] is Level.WARN
    gate.set()
    queue.close()
    assert got == [b"0", b"3", b"4", b"5"] and queue.published == 4
    later_s = time.monotonic() + 60.0
    monkeypatch.setattr(time, "monotonic", lambda: later_s)  # the bus has recovered
    level, text = _level(_streaming(), queue, 100.0)
    assert level is Level.OK and "2 samples dropped before" in text


def test_a_bus_that_raises_does_not_end_acquisition() -> None:
    class Broken(LocalBus):
        def publish(self, key: str, payload: bytes) -> None:
            raise RuntimeError("no link")

    queue = PublishQueue(Broken(), 3, "out")
    queue.put("vical/a", b"0")
    _wait_for(lambda: queue.dropped == 1)
    queue.put("vical/a", b"1")
    _wait_for(lambda: queue.dropped == 2)
    queue.close()


class HeldUpBus(LocalBus):
    """Takes everything at once, but for one message, which it holds up until the gate opens."""

    def __init__(self, held: bytes) -> None:
        super().__init__()
        self.held, self.gate, self.got = held, threading.Event(), []

    def publish(self, key: str, payload: bytes) -> None:
        if payload == self.held:
            self.gate.wait(10)
        self.got.append((payload, threading.current_thread().name))


def test_a_direct_queue_publishes_in_order_and_drops_the_oldest() -> None:
    bus = HeldUpBus(b"")
    queue = DirectQueue(bus, 3)
    for i in range(5):
        queue.put("vical/a", b"%d" % i)
    assert (queue.waiting, queue.dropped, queue.progress) == (3, 2, None)
    queue.flush()
    assert [payload for payload, _ in bus.got] == [b"2", b"3", b"4"]
    assert (queue.waiting, queue.published) == (0, 3)


def test_a_direct_queue_survives_a_bus_that_raises() -> None:
    class Broken(LocalBus):
        def publish(self, key: str, payload: bytes) -> None:
            raise RuntimeError("no link")

    queue = DirectQueue(Broken(), 3)
    queue.put("vical/a", b"0")
    queue.close()
    assert (queue.dropped, queue.published, queue.progress) == (1, 0, None)


def direct_pipeline(bus, script, stop):
    """A device whose reading thread publishes, with its backup reader, running."""
    queue, source = DirectQueue(bus, 1000), ScriptedSource(script)
    loop: DeviceLoop[int] = DeviceLoop(
        "imu/imu0", lambda: source, lambda i: queue.put("vical/a", b"%d" % i), stop,
        flush=queue.flush, read_timeout_s=0.02,
    )  # fmt: skip
    loop.start()
    BackupReader(queue, loop.read_on, stop, "backup").start()
    return source, loop, queue


def test_while_the_bus_holds_the_reading_thread_up_another_one_reads_on(stop) -> None:
    bus = HeldUpBus(b"3")
    source, loop, queue = direct_pipeline(bus, [[i] for i in range(8)], stop)
    _wait_for(lambda: not source.script)  # all was read, though 3 is not out yet
    assert [payload for payload, _ in bus.got] == [b"0", b"1", b"2"]
    assert loop.health().data_age_s < 5.0
    bus.gate.set()
    _wait_for(lambda: len(bus.got) == 8)
    source.script += [[8], [9]]
    _wait_for(lambda: len(bus.got) == 10)
    assert bus.got == [(b"%d" % i, "imu/imu0") for i in range(10)]
    assert queue.dropped == 0


def test_a_loop_held_up_by_the_bus_still_ends_and_closes_its_device(stop) -> None:
    bus = HeldUpBus(b"0")
    source, loop, queue = direct_pipeline(bus, [[0], [1]], stop)
    _wait_for(lambda: not source.script)
    stop.set()
    assert not loop.join(0.05)
    bus.gate.set()
    assert loop.join(5.0) and source.closed
    loop.read_on()  # a backup reader that comes too late finds nothing to read
    queue.close()
    assert [payload for payload, _ in bus.got] == [b"0", b"1"]


def _streaming():
    from vical_daemon.acquire.device_loop import DeviceHealth

    return DeviceHealth("streaming", stats=SourceStats(rate_hz=100.0), data_age_s=0.01)


def test_levels() -> None:
    from dataclasses import replace

    bus = LocalBus()
    queue = PublishQueue(bus, 3, "out")
    good = _streaming()
    assert _level(good, queue, 100.0)[0] is Level.OK
    assert _level(replace(good, data_age_s=3.0), queue, 100.0)[0] is Level.ERROR
    assert _level(replace(good, data_age_s=3.0), queue, 1.0)[0] is not Level.ERROR
    assert _level(replace(good, state="lost", problem="gone"), queue, 100.0) == (Level.ERROR, "gone")
    assert _level(good, queue, 200.0)[0] is Level.WARN
    silent = replace(good, state="silent", openings=1)
    assert _level(replace(silent, state="opening", openings=0), queue, 100.0)[0] is Level.WARN
    assert _level(silent, queue, 100.0) == (Level.WARN, "open, no data yet")  # for a second at each start
    assert _level(replace(silent, openings=2), queue, 100.0)[0] is Level.ERROR
    queue.close()


def test_a_pause_between_two_attempts_to_open_is_not_a_stuck_thread(stop) -> None:
    attempts: list[int] = []

    def opener() -> ScriptedSource:
        attempts.append(1)
        raise DeviceNotFoundError("not there")

    loop = DeviceLoop("imu/imu0", opener, lambda _item: None, stop, read_timeout_s=0.02, first_pause_s=600.0)
    loop.start()
    _wait_for(lambda: bool(attempts))
    t_paused_s = loop._t_loop_s
    _wait_for(lambda: loop._t_loop_s > t_paused_s)  # the loop goes round while it waits
    assert len(attempts) == 1
    assert _level(loop.health(), PublishQueue(LocalBus(), 1, "out"), 100.0)[0] is Level.ERROR
