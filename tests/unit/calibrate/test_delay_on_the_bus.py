"""The estimator on a LocalBus starts without knowing delay or mounting."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from vical_mocks.points import SimulatedRun, board_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import log_so3

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, LocalBus
from vical_daemon.bus.messages import decode_calibration, encode_imu, encode_points
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import Config, loads
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.geometry.so3 import matrix_from_quat
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.result import Status

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
