"""The status of a role whose loop is busy for seconds."""

from __future__ import annotations

import threading
import time

import pytest

from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import DiagnosticStatus, Level, decode_diagnostics
from vical_daemon.service import health, notify, wall_clock
from vical_daemon.service.wall_clock import WallClock, private_clock


def test_a_busy_role_repeats_its_status_until_it_is_stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "STATUS_PERIOD_S", 0.02)
    bus, heard = LocalBus(), list[DiagnosticStatus]()
    bus.subscribe("vical/rig0/status/*", lambda s: heard.append(decode_diagnostics(s.payload).statuses[0]))
    sender = health.StatusSender("rig0", "estimate", bus, WallClock(0))
    sender.repeat_while_busy(stuck_s=2.0)
    time.sleep(0.2)
    assert not heard  # there is nothing to repeat
    begin_s = time.monotonic()
    sender.tick(lambda: [DiagnosticStatus(Level.OK, "estimate", "initialising")])
    while heard[-1].level is not Level.STALE:
        assert time.monotonic() < begin_s + 30.0
        time.sleep(0.01)
    assert time.monotonic() >= begin_s + 2.0
    assert heard[-1].message.startswith("stuck: at one step for 2 s")
    assert len(heard) > 3 and {(s.level, s.message) for s in heard[1:3]} == {(Level.OK, "initialising")}
    sender.pause()  # another one reports
    time.sleep(0.1)
    count = len(heard)
    time.sleep(0.2)
    assert len(heard) == count
    sender.finish(lambda: [DiagnosticStatus(Level.OK, "estimate", "converging")])
    time.sleep(0.2)
    count = len(heard)
    time.sleep(0.2)
    assert len(heard) == count


def test_a_system_clock_that_is_set_is_announced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """NTP steps by an hour and back; IMU and camera run in one process; a slew of milliseconds is nothing."""
    events: list[str] = []
    monkeypatch.setattr(notify, "event", lambda name, text, **_: events.append(f"{name}: {text}"))
    monkeypatch.setattr(health, "_clock_steps", health._ClockSteps())
    clock, bus = private_clock(), LocalBus()
    senders = [health.StatusSender("rig0", role, bus, clock) for role in ("imu", "camera", "record")]
    for offset_s in (0.0, 0.004, 3600.0, 3600.0, 0.0, 0.0, -1.0, 1.7e9):
        monkeypatch.setattr(
            wall_clock, "measure_offset_ns", lambda s=offset_s: clock.offset_ns + round(1e9 * s)
        )
        for sender in senders:
            sender.tick(list, force=True)
    tail = "which keep the old time until the next boot"
    assert events == [
        f"clock_set: the system clock was set: it is 3600.0 s ahead of vical's stamps, {tail}",
        "clock_set: the system clock was set back: it agrees with vical's stamps again",
        f"clock_set: the system clock was set: it is 1.0 s behind vical's stamps, {tail}",
        f"clock_set: the system clock was set: it is 19676 days ahead of vical's stamps, {tail}",
    ]


def test_threads_of_a_process_that_was_stopped_are_not_called_stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    """After SIGCONT, or a pause of the virtual machine, the status comes after the devices' next turn."""

    class Computer(threading.Event):
        """Its clock runs while somebody waits; in its 30th wait the whole process is stopped for 20 s."""

        now_s, turned_s, waits = 100.0, 100.0, 0

        def monotonic(self) -> float:
            return self.now_s

        def wait(self, timeout: float | None = None) -> bool:
            self.now_s += timeout or 0.0
            self.waits += 1
            if self.waits == 30:
                self.now_s += 20.0
            else:
                self.turned_s = self.now_s  # a device loop turns within 0.2 s
            if self.waits == 60:
                self.set()
            return self.is_set()

    computer, ages_s = Computer(), list[float]()

    def statuses() -> list[DiagnosticStatus]:
        ages_s.append(computer.now_s - computer.turned_s)
        return []

    monkeypatch.setattr(health, "time", computer)
    health.StatusSender("rig0", "imu", LocalBus(), WallClock(0)).run_until(computer, statuses)
    assert len(ages_s) >= 5
    assert max(ages_s) < 1.0
