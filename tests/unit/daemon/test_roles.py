"""Roles over a LocalBus: stamps, order, what is published, and that a replay gives what the live run gave."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
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
    DiagnosticStatus,
    Level,
    decode_calibration,
    decode_camera_info,
    decode_diagnostics,
    decode_image,
    decode_imu,
    decode_points,
    decode_pose,
    decode_transforms,
    encode_diagnostics,
    encode_image,
    encode_imu,
    encode_points,
)
from vical_daemon.calibrate.estimators import input_keys
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import Config, loads
from vical_daemon.detect.role import DetectRole
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    PoseEstimate,
    Status,
    TracePoint,
)
from vical_daemon.service.wall_clock import WallClock
from vical_daemon.vision.detection import Detection

CLOCK = WallClock(1_700_000_000_000_000_000)
MS = 1_000_000


@pytest.fixture
def config() -> Config:
    return loads(
        "rig: rover\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
        "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [16, 16], rate_hz: 10}}\ntarget: t.yaml\n"
    )


class FakeEstimator:
    """Remembers what it is fed, in order."""

    def __init__(self) -> None:
        self.fed: list[tuple[str, int]] = []
        self.status = Status.CONVERGING

    def stamps_known_to(self, sigma_s: float) -> None:
        self.stamp_sigma_s = sigma_s

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> None:
        self.fed.append(("imu", t_imu_ns))

    def add_points(self, frame: PointsFrame) -> None:
        self.fed.append((frame.camera, frame.t_cam_ns))

    waiting = 0

    def process(self) -> list[Any]:
        return ["verdict"]

    def finish(self) -> list[Any]:
        return ["last"]

    def estimate(self) -> CalibrationEstimate:
        pose = PoseEstimate([0.1, 0.2, 0.3], [1.0, 0.0, 0.0, 0.0], (np.eye(6) * 1e-4).tolist())
        camera = CameraEstimate(
            pose, 0.01, 1e-4, [5.0, 5.0, 4.0, 3.0], [0.0] * 4, "radtan", [0.0] * 4, [0.0] * 4, 0.2
        )
        newest = max((t for _, t in self.fed), default=0)
        return CalibrationEstimate(
            newest, self.status, "", 0.5, "", 1.0, 2, 3, {"cam0": camera}, None, [0.0, 0.0, -9.8], 1.0, 0.0
        )

    def trace(self, camera: str) -> list[TracePoint]:
        return []


def _imu_message(t_ms: int) -> Sample:
    payload = encode_imu(t_ms * MS, "imu0", (0.0, 0.0, 0.1), (0.0, 0.0, 9.8))
    return Sample("vical/rover/imu/imu0", payload, 0)


def _points_message(t_ms: int) -> Sample:
    payload = encode_points(t_ms * MS, "cam0", np.arange(4), np.ones((4, 2)))
    return Sample("vical/rover/camera/cam0/points", payload, 0)


class TestEstimate:
    def test_feeds_by_stamp_whatever_the_order_of_arrival(self, config: Config) -> None:
        estimator = FakeEstimator()
        role = EstimateRole(config, estimator)
        for sample in (_imu_message(1000), _imu_message(1100), _points_message(1050), _imu_message(1010)):
            role.take(sample)
        role.finish()
        assert [t // MS for _, t in estimator.fed] == [1000, 1010, 1050, 1100]

    def test_holds_back_the_lag(self, config: Config) -> None:
        estimator = FakeEstimator()
        role = EstimateRole(config, estimator)
        role.take(_imu_message(1000))
        role.take(_imu_message(1150))
        role.step()
        assert estimator.fed == []
        role.take(_imu_message(1200))
        role.step()
        assert estimator.fed == [("imu", 1000 * MS)]

    def test_publishes_five_times_a_second_of_data(self, config: Config) -> None:
        role = EstimateRole(config, FakeEstimator())
        sent = []
        for t_ms in range(0, 3000, 10):
            role.take(_imu_message(t_ms))
            sent += role.step()
        calibrations = [key for key, _ in sent if key == "vical/rover/calibration/cam0"]
        assert len(calibrations) == 15

    def test_what_travels(self, config: Config) -> None:
        estimator = FakeEstimator()
        role = EstimateRole(config, estimator)
        role.take(_imu_message(1000))
        before = dict(role.finish())
        assert set(before) == {
            "vical/rover/calibration/cam0",
            "vical/rover/calibration/cam0/pose",
            "vical/rover/camera/cam0/camera_info",
        }
        estimator.status = Status.CONVERGED
        after = dict(role.finish())
        assert decode_calibration(after["vical/rover/calibration/cam0"]).estimate.status is Status.CONVERGED
        pose = decode_pose(after["vical/rover/calibration/cam0/pose"])
        assert (pose.frame_id, pose.p_m) == ("imu0", (0.1, 0.2, 0.3))
        info = decode_camera_info(after["vical/rover/camera/cam0/camera_info"])
        assert (info.width, info.height, info.intrinsics) == (16, 16, (5.0, 5.0, 4.0, 3.0))
        (transform,) = decode_transforms(after["vical/rover/tf_static"])
        assert (transform.frame_id, transform.child_frame_id) == ("imu0", "cam0")

    def test_what_cannot_be_read_is_counted_not_raised(self, config: Config) -> None:
        role = EstimateRole(config, FakeEstimator())
        for payload in (b"", b"\x00\x01\x00\x00", b"x" * 1000):
            role.take(Sample("vical/rover/imu/imu0", payload, 0))
            role.take(Sample("vical/rover/camera/cam0/points", payload, 0))
        role.step()
        assert role.statuses(7)[0].values["malformed"] == "6"
        assert role.statuses(7)[0].values["dropped"] == "7"

    def test_verdicts_are_kept_on_request(self, config: Config) -> None:
        kept: list[Any] = []
        role = EstimateRole(config, FakeEstimator(), keep=kept.extend)
        role.take(_imu_message(0))
        role.take(_points_message(10))
        role.finish()
        assert kept == ["verdict", "last"]

    def test_input_keys(self, config: Config) -> None:
        assert input_keys(config) == [
            "vical/rover/imu/imu0",
            "vical/rover/status/imu",
            "vical/rover/camera/cam0/points",
        ]

    @pytest.mark.parametrize(
        ("name", "value", "known"),
        [("imu/imu0", "42.5", 42.5e-6), ("imu/other", "42.5", None), ("imu/imu0", "?", None)],
    )
    def test_passes_on_how_well_the_driver_knows_its_clock(
        self, config: Config, name: str, value: str, known: float | None
    ) -> None:
        estimator = FakeEstimator()
        status = DiagnosticStatus(Level.OK, name, values={"stamp_sigma_us": value})
        payload = encode_diagnostics(0, "imu", [status])
        EstimateRole(config, estimator).take(Sample("vical/rover/status/imu", payload, 0))
        heard = getattr(estimator, "stamp_sigma_s", None)
        assert heard == (None if known is None else pytest.approx(known))


def _frame(t_ms: int, **changes: Any) -> Frame:
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    values = {"t_exposure_mid_ns": t_ms * MS, "t_arrival_ns": 0, "sequence": 0, "image": image}
    return Frame(**(values | {"encoding": "mono8", "stamp_rule": "simulated"} | changes))


class TestDetect:
    def _role(self, config: Config, found: Detection | None) -> DetectRole:
        return DetectRole(config, "cam0", lambda image, t_ns: found)

    def _sample(self, t_ms: int) -> Sample:
        payload = encode_image(t_ms * MS, "cam0", _frame(t_ms).image, "mono8")
        return Sample("vical/rover/camera/cam0/image", payload, 0)

    def test_points_keep_the_stamp_of_their_image(self, config: Config) -> None:
        found = Detection(np.array([3, 5]), np.array([[1.5, 2.5], [3.0, 4.0]]), np.array([0.1, 0.2]))
        ((key, payload),) = self._role(config, found).points(self._sample(1234))
        message = decode_points(payload)
        assert key == "vical/rover/camera/cam0/points" and message.stamp_ns == 1234 * MS
        assert message.image_size == (8, 6) and message.ids.tolist() == [3, 5]
        np.testing.assert_array_equal(message.uv_px, found.uv_px)

    def test_an_image_without_a_board_is_said_too(self, config: Config) -> None:
        role = self._role(config, None)
        ((_, payload),) = role.points(self._sample(1))
        assert len(decode_points(payload).ids) == 0
        assert role.status().values["with_points"] == "0"

    def test_junk_is_counted(self, config: Config) -> None:
        role = self._role(config, None)
        assert role.points(Sample("vical/rover/camera/cam0/image", b"junk", 0)) == []
        assert role.status(3).values["malformed"] == "1" and role.status(3).values["dropped"] == "3"

    def test_rate_limit_counts_in_the_time_of_the_images(self, config: Config) -> None:
        role = self._role(config, None)  # detect_rate_hz is 30
        done = [bool(role.points(self._sample(1000 + 10 * i))) for i in range(100)]
        assert 28 <= sum(done) <= 34
        assert all(self._role(config, None).points(self._sample(t)) for t in range(0, 1000, 100))


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
