"""The acquiring roles over a LocalBus: stamps, settings, and a message for every sample."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest
from vical_drivers.microstrain import device as gx3_module
from vical_drivers.samples import DeviceInfo, Frame, ImuSample, SourceStats

from vical_daemon.acquire import camera as camera_module
from vical_daemon.acquire import imu as imu_module
from vical_daemon.acquire.camera import CameraEncoder
from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.messages import (
    Level,
    decode_diagnostics,
    decode_image,
    decode_imu,
)
from vical_daemon.config.model import Config, loads
from vical_daemon.service.wall_clock import WallClock

CLOCK = WallClock(1_700_000_000_000_000_000)
MS = 1_000_000


@pytest.fixture
def config() -> Config:
    return loads(
        "rig: rover\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
        "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [16, 16], rate_hz: 10}}\ntarget: t.yaml\n"
    )


def _frame(t_ms: int, **changes: Any) -> Frame:
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    values = {"t_exposure_mid_ns": t_ms * MS, "t_arrival_ns": 0, "sequence": 0, "image": image}
    return Frame(**(values | {"encoding": "mono8", "stamp_rule": "simulated"} | changes))


class TestAcquisition:
    def test_imu_stamp_is_that_of_the_measurement_on_the_shared_clock(self, config: Config) -> None:
        role = imu_module.ImuEncoder("rover", "imu0", CLOCK)
        payload = role.message(ImuSample(5_000, 9_000, 1, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0)))
        assert payload is not None
        message = decode_imu(payload)
        assert message.stamp_ns == CLOCK.offset_ns + 5_000
        assert message.gyro_rps == (0.1, 0.2, 0.3) and message.specific_force_mps2 == (1.0, 2.0, 3.0)
        assert role.message(ImuSample(5_000, 9_000, 1, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0))) is None
        assert role.counters()["stamps_backwards"] == "1"

    def test_an_imu_that_is_gone_does_not_claim_that_its_stamps_are_exact(self) -> None:
        """As 0 us it made the estimator see a drift of the clocks when the IMU came back."""
        role = imu_module.ImuEncoder("rover", "imu0", CLOCK)
        assert "stamp_sigma_us" not in role.counters()
        for t_ns, sigma_ns in ((5_000, 240_000), (6_000, 180_000)):
            role.message(ImuSample(t_ns, t_ns, 1, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), t_sigma_ns=sigma_ns))
        assert role.counters()["stamp_sigma_us"] == "240.0"
        assert "stamp_sigma_us" not in role.counters()

    def test_every_setting_of_an_imu_reaches_its_driver(self, monkeypatch: pytest.MonkeyPatch) -> None:
        asked: dict[str, Any] = {}
        monkeypatch.setattr(gx3_module, "open_imu", lambda port, **given: asked.update(given, port=port))
        imu = loads(
            "imus: {a: {port: /dev/x, protocol: mip, rate_hz: 250, filter_samples: 7, "
            "baud: 460800, link: uart}}"
        ).imus["a"]
        imu_module.open_imu(imu)
        assert asked == {
            "port": "/dev/x",
            "protocol": "mip",
            "rate_hz": 250.0,
            "filter_width": 7,
            "baud": 460800,
            "link": "uart",
        }

    def test_image_is_stamped_mid_exposure_and_says_by_which_rule(self) -> None:
        role = CameraEncoder("rover", "cam0", CLOCK)
        payload = role.message(_frame(7, stamp_rule="soe+exposure/2", dropped_before=2))
        assert payload is not None
        message = decode_image(payload)
        assert message.stamp_ns == CLOCK.unix_ns(7 * MS) and message.pixels()[5, 7] == 47
        assert role.counters()["stamp_rule"] == "soe+exposure/2 (1)"
        assert role.counters()["frames_dropped"] == "2"
        assert role.message(_frame(6)) is None

    def test_a_clock_that_was_set_back_holds_a_device_up_for_a_second_at_most(self) -> None:
        """One stamp of in an hour held all images back for an hour, and the status said that all is well."""
        role, hour_ms = CameraEncoder("rover", "cam0", CLOCK), 3_600_000
        passed = [role.message(_frame(k)) is not None for k in (1000, 1000 + hour_ms, 1050, 1100, 900, 1150)]
        assert passed == [True, True, True, True, False, True]
        assert role.counters()["stamps_backwards"] == "2"

    def test_run_publishes_every_sample_and_a_status(self, config: Config) -> None:
        bus, stop = LocalBus(), threading.Event()
        got: list[Sample] = []
        bus.subscribe("vical/rover/**", got.append)
        threads = [
            threading.Thread(
                target=imu_module.run,
                args=(config, bus, stop),
                kwargs={"clock": CLOCK, "open_source": lambda c: _Burst(_samples(200))},
            ),
            threading.Thread(
                target=camera_module.run,
                args=(config, bus, stop),
                kwargs={"clock": CLOCK, "open_source": lambda c: _OneByOne([_frame(i) for i in range(1, 6)])},
            ),
        ]
        for thread in threads:
            thread.start()
        _wait_for(lambda: _count(got, topics.IMU) == 200 and _count(got, topics.IMAGE) == 5)
        _wait_for(lambda: _count(got, topics.STATUS) >= 4)
        stop.set()
        for thread in threads:
            thread.join(5)
            assert not thread.is_alive()
        stamps = [decode_imu(s.payload).stamp_ns for s in got if s.key.endswith("imu/imu0")]
        assert stamps == sorted(stamps)
        last = {s.key: decode_diagnostics(s.payload) for s in got if "/status/" in s.key}
        imu = next(s for s in last["vical/rover/status/imu"].statuses if s.name == "imu/imu0")
        assert (imu.hardware_id, imu.level) == ("S1", Level.OK)
        clock = next(s for s in last["vical/rover/status/camera"].statuses if s.name == "clock")
        assert clock.values["wall_minus_monotonic_ns"] == str(CLOCK.offset_ns)


def _samples(count: int) -> list[ImuSample]:
    return [ImuSample((i + 1) * MS, 0, i, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)) for i in range(count)]


class _Burst:
    """Gives its samples once, then silence."""

    def __init__(self, items: list[Any]) -> None:
        self._items = items

    @property
    def info(self) -> DeviceInfo:
        return DeviceInfo("imu", "fake", "S1")

    def read(self, timeout_s: float) -> Any:
        items, self._items = self._items, []
        time.sleep(0.005)
        return items

    def stats(self) -> SourceStats:
        return SourceStats(rate_hz=100.0)

    def close(self) -> None:
        pass

    def __enter__(self) -> _Burst:
        return self

    def __exit__(self, *args: object) -> None:
        self.close()


class _OneByOne(_Burst):
    def read(self, timeout_s: float) -> Any:
        time.sleep(0.005)
        return self._items.pop(0) if self._items else None


def _count(got: list[Sample], topic: topics.Topic) -> int:
    parsed = [topics.parse_key(sample.key) for sample in got]
    return sum(p is not None and p.topic is topic for p in parsed)


def _wait_for(condition: Any, timeout_s: float = 5.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it does not happen"
        time.sleep(0.01)
