"""The estimate role: order by stamp, what it publishes, what it counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    decode_calibration,
    decode_camera_info,
    decode_points,
    decode_pose,
    decode_transforms,
    encode_diagnostics,
    encode_imu,
    encode_points,
)
from vical_daemon.calibrate.arrival_stamps import LiveStamps
from vical_daemon.calibrate.estimators import input_keys
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import Config, loads
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    PoseEstimate,
    Status,
)

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

    def do_without(self, cameras: frozenset[str]) -> None:
        self.without = cameras

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> None:
        self.fed.append(("imu", t_imu_ns))

    def add_points(self, frame: PointsFrame) -> None:
        self.fed.append((frame.camera, frame.t_cam_ns))

    waiting = 0
    left_out: ClassVar[dict[str, int]] = {"imu_spikes": 3}

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
            "vical/rover/status/camera",
            "vical/rover/status/detect",
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

    def test_live_images_that_are_stamped_on_arrival_get_even_stamps(self, config: Config) -> None:
        class Reporting(FakeEstimator):
            def add_points(self, frame: PointsFrame) -> None:
                super().add_points(frame)
                self.newest = frame

            def process(self) -> list[Any]:
                f, none = self.newest, np.zeros(0, bool)
                report = FrameReport(f.t_cam_ns, f.camera, f.ids, f.uv_px, f.uv_px, none, used=True)
                return [replace(report, predicted_px=f.uv_px)]

        estimator, stamps = Reporting(), LiveStamps()
        role = EstimateRole(config, estimator, stamps=stamps)
        rng, begin_ns, sent, predicted = np.random.default_rng(1), 10**18, set(), []
        corners = rng.uniform(1.0, 15.0, (12, 2))
        for k in range(600):
            t_s = 0.05 * k
            uv = corners + 0.5 * np.sin(3.0 * t_s) + rng.normal(0.0, 1e-3, (12, 2))
            stamp_ns = begin_ns + round((t_s + rng.exponential(4e-3)) * 1e9)
            sent.add(stamp_ns)
            payload = encode_points(stamp_ns, "cam0", range(12), uv, image_size=(16, 16))
            role.take(Sample("vical/rover/camera/cam0/points", payload, 0))
            predicted += [p for key, p in role.step() if key.endswith("/predicted")]
        assert len(stamps.news()) == 1
        even_s = np.array([(t - begin_ns) * 1e-9 for _, t in estimator.fed[-200:]])
        late_s = even_s - 0.05 * np.round(even_s / 0.05)
        assert np.abs(late_s).max() < 1e-3 and late_s.std() < 2e-4
        assert {decode_points(p).stamp_ns for p in predicted} <= sent  # the page shows them in their images
        fresh = Reporting()
        role.reset(fresh)
        assert fresh.stamp_sigma_s == pytest.approx(stamps.sigma_s) and 0.0 < stamps.sigma_s < 1e-3
