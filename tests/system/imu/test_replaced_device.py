"""The imu role when another device comes back on the port: nobody can take its samples for the old one's."""

from __future__ import annotations

import threading
import time

import pytest

from vical_daemon.acquire import imu
from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.messages import decode_diagnostics
from vical_daemon.config.model import Config, ImuConfig
from vical_daemon.service import notify
from vical_daemon.service.wall_clock import private_clock

pytestmark = pytest.mark.system


class Heard:
    """What the bus carried, in order: serial numbers as they were announced, and a dot for each sample."""

    def __init__(self, bus: LocalBus) -> None:
        self.story: list[str] = []
        self.announced: list[str] = []
        bus.subscribe(topics.IMU.key("rig0", "imu0"), lambda _: self._add("."))
        bus.subscribe(topics.STATUS.key("rig0", "imu"), self._status)

    def _status(self, sample: Sample) -> None:
        for status in decode_diagnostics(sample.payload).statuses:
            if status.name == "imu/imu0" and status.hardware_id:
                self._add(status.hardware_id)

    def _add(self, word: str) -> None:
        if not self.story or self.story[-1] != word:
            self.story.append(word)

    def event(self, name: str, text: str, **_: object) -> None:
        """Stands in for the journal."""
        self.announced.append(f"{name}: {text}")
        if name == "device_replaced":
            self._add("replaced")

    def wait_for(self, *story: str) -> None:
        end_s = time.monotonic() + 60
        while tuple(self.story[-len(story) :]) != story:
            assert time.monotonic() < end_s, self.story
            time.sleep(0.01)


def test_its_serial_number_is_told_before_its_first_sample(emulate, monkeypatch):
    emulator = emulate(serial_number="A")
    config = Config(imus={"imu0": ImuConfig(port=emulator.port_name, rate_hz=100.0)})
    bus, stop = LocalBus(), threading.Event()
    heard = Heard(bus)
    monkeypatch.setattr(notify, "event", heard.event)
    role = threading.Thread(target=imu.run, args=(config, bus, stop), kwargs={"clock": private_clock()})
    role.start()
    try:
        heard.wait_for("A", ".")
        emulator.unplug()
        emulator.device.state.identity.serial_number = "B"
        emulator.plug()
        heard.wait_for("B", ".")
    finally:
        stop.set()
        role.join(60)
    at = heard.story.index("replaced")
    assert "." in heard.story[:at] and "B" not in heard.story[:at]
    assert heard.story[at + 1] == "B" and "A" not in heard.story[at:]
    (replaced,) = [text for text in heard.announced if text.startswith("device_replaced")]
    assert replaced.endswith("is another device now: 3DM-GX3-25 serial B, not 3DM-GX3-25 serial A")
