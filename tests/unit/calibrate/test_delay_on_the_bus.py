"""Temporal calibration over a LocalBus: it starts the estimator and then watches the filter's delay."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pytest
from vical_mocks.points import SimulatedRun, board_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import log_so3

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, LocalBus, Sample
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    decode_calibration,
    decode_diagnostics,
    encode_imu,
    encode_points,
)
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import Config, loads
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.geometry.so3 import matrix_from_quat
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.estimation.temporal.td_icp_watch import DelayWatch
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import WallClock

CONFIG = loads(
    "rig: rover\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
    "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [640, 480], rate_hz: 10}}\ntarget: t.yaml\n"
)


def _messages(run: SimulatedRun) -> Iterator[tuple[int, str, bytes]]:
    """Everything recorded as messages, in the order of their stamps."""
    imu, points = topics.IMU.key("rover", "imu0"), topics.POINTS.key("rover", "cam0")
    out = [
        (int(t), imu, encode_imu(int(t), "imu0", tuple(w), tuple(f)))
        for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True)
    ]
    out += [
        (f.t_cam_ns, points, encode_points(f.t_cam_ns, "cam0", f.ids, f.uv_px, f.uv_px[:, 0] * 0 + 0.5))
        for f in run.frames
    ]
    return iter(sorted(out, key=lambda m: m[0]))


def _play(bus: Bus, run: SimulatedRun, role: EstimateRole, config: Config = CONFIG) -> None:
    """Put a recording on the bus and let the role answer there."""
    keys = (topics.IMU.key(config.rig, "imu0"), topics.POINTS.key(config.rig, "cam0"))
    for key in keys:
        bus.subscribe(key, role.take)
    for _, key, payload in _messages(run):
        bus.publish(key, payload)
        for answer in role.step():
            bus.publish(*answer)
    for answer in role.finish():
        bus.publish(*answer)


@pytest.mark.parametrize("shift", [0.4, -0.4])
def test_the_estimator_starts_without_knowing_delay_or_mounting(shift: float) -> None:
    rig = reference_rig(11, timeshift_cam_imu_s=shift)
    run = simulate(11, 9.0, rig=rig, camera_rate_hz=10.0, corner_sigma_px=0.3)
    lens = rig.lens
    prior = CameraPrior(
        lens.resolution, tuple(lens.intrinsics), lens.model, tuple(lens.distortion)
    )  # no pose, no delay
    options = CalibrationOptions(fix=frozenset({"intrinsics"}))
    role = EstimateRole(CONFIG, Calibrator(options, {"cam0": prior}, board_points()))
    bus, heard = LocalBus(), []
    bus.subscribe(topics.CALIBRATION.key("rover", "cam0"), heard.append)
    _play(bus, run, role)
    estimate = decode_calibration(heard[-1].payload).estimate
    assert estimate.status in (Status.CONVERGING, Status.CONVERGED, Status.DEGENERATE), estimate.reason
    camera = estimate.cameras["cam0"]
    assert abs(camera.timeshift_cam_imu_s - shift) < 5 * camera.timeshift_sigma_s < 2.5e-3
    turn = log_so3(matrix_from_quat(np.array(camera.T_imu_cam.q_wxyz)).T @ rig.R_imu_cam)
    assert np.linalg.norm(turn) < 0.01


class Believer:
    """An estimator that knows everything, and the delay as it is told to."""

    left_out: ClassVar[dict[str, int]] = {}

    def __init__(self, run: SimulatedRun, wrong_s: float) -> None:
        rig, lens = run.rig, run.rig.lens
        pose = PoseEstimate([0.0] * 3, [1.0, 0.0, 0.0, 0.0], (np.eye(6) * 1e-8).tolist())
        shift, unsure = rig.timeshift_cam_imu_s + wrong_s, [0.0] * 4
        self.camera = CameraEstimate(
            pose, shift, 2e-5, list(lens.intrinsics), unsure, lens.model, list(lens.distortion), unsure, 0.2
        )

    def add_imu(self, *_: Any) -> None: ...

    def add_points(self, frame: PointsFrame) -> None: ...

    waiting = 0

    def process(self) -> list[Any]:
        return []

    def finish(self) -> list[Any]:
        return []

    def estimate(self) -> CalibrationEstimate:
        cameras = {"cam0": self.camera}
        return CalibrationEstimate(
            0, Status.CONVERGED, "", 1.0, "", 1.0, 2, 3, cameras, None, [0.0, 0.0, -9.8], 1.0, 0.0
        )

    def trace(self, camera: str) -> list[Any]:
        return []


@pytest.fixture(scope="module")
def recording() -> SimulatedRun:
    return simulate(5, 18.0, timeshift_cam_imu_s=0.02, camera_rate_hz=8.0, corner_sigma_px=0.3)


def _watched(run: SimulatedRun, wrong_s: float) -> DiagnosticStatus:
    """What the role's status says on the bus after a recording that the filter judged `wrong_s` off."""
    watch = DelayWatch(board_points(), ["cam0"], window_s=6.0, every_s=7.0)
    role = EstimateRole(CONFIG, Believer(run, wrong_s), watch=watch)
    bus = LocalBus()
    heard: list[Sample] = []
    bus.subscribe(topics.STATUS.key("rover", "estimate"), heard.append)
    _play(bus, run, role)
    StatusSender("rover", "estimate", bus, WallClock(0)).tick(role.statuses, force=True)
    by_name = {s.name: s for s in decode_diagnostics(heard[-1].payload).statuses}
    return by_name["cam0 delay"]


def test_the_watch_agrees_with_a_filter_that_is_right(recording: SimulatedRun) -> None:
    status = _watched(recording, 0.0)
    assert status.level is Level.OK and "from rotations alone" in status.message
    values = status.values
    assert int(values["windows"]) == 2 and values["against"] == "0"
    error = float(values["timeshift_s"]) - 0.02
    assert abs(error) < 4 * float(values["timeshift_sigma_s"]) < 2e-3
    assert float(values["filter_timeshift_s"]) == pytest.approx(0.02)
    assert abs(float(values["drift_ppm"])) < 4 * float(values["drift_sigma_ppm"])


def test_the_watch_warns_of_a_filter_that_is_three_milliseconds_off(recording: SimulatedRun) -> None:
    status = _watched(recording, 3e-3)
    assert status.level is Level.WARN and "stamps" in status.message
    assert int(status.values["against"]) == 2
    assert abs(float(status.values["timeshift_s"]) - 0.02) < 1e-3


def test_a_rig_at_rest_costs_nothing_and_warns_of_nothing(recording: SimulatedRun) -> None:
    watch = DelayWatch(board_points(), ["cam0"], window_s=6.0, every_s=7.0)
    estimate = Believer(recording, 0.0).estimate()
    for k in range(1500):
        watch.add_imu(k * 10_000_000, (0.01, 0.0, 0.0))
        if k % 10 == 0:
            watch.add_points(PointsFrame("cam0", k * 10_000_000, np.arange(48), recording.frames[0].uv_px))
        watch.look(estimate)
    verdict = watch.verdicts["cam0"]
    assert verdict.windows == verdict.refused == 0 and not verdict.warning
