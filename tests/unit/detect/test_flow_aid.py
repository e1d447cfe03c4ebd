"""The feature tracker hears gyro and calibration, and only what can be believed."""

from dataclasses import replace

import numpy as np
from vical_mocks.rig import reference_rig

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import encode_calibration, encode_imu
from vical_daemon.config.model import CalibrationConfig, CameraConfig, Config, ImuConfig, LensConfig
from vical_daemon.detect.role import DetectRole, attach_aid
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    PoseEstimate,
    Status,
)

STEP_NS = 1_000_000
START_NS = 10**15
LENS = LensConfig(intrinsics=(500.0, 500.0, 320.0, 240.0))


def config(mode="target_free", rate_hz=1000.0):
    return Config(
        rig="rig0",
        imus={"imu0": ImuConfig(port="/dev/null", rate_hz=rate_hz)},
        cameras={
            "cam0": CameraConfig(uri="folder:x", lens=LensConfig(intrinsics=(500.0, 500.0, 320.0, 240.0)))
        },
        calibration=CalibrationConfig(mode=mode),
    )


def estimate(status, rig):
    pose = PoseEstimate(
        rig.p_imu_cam.tolist(), so3.quat_from_matrix(rig.R_imu_cam).tolist(), np.eye(6).tolist()
    )
    lens = rig.lens
    known = (list(lens.intrinsics), [1.0] * 4, lens.model, list(lens.distortion), [0.1] * 4)
    camera = CameraEstimate(pose, 0.004, 1e-4, *known, 0.3, 0.3, [], 0.0, 0.0)
    return CalibrationEstimate(
        START_NS, status, "", 1.0, "", 10.0, 200, 1000, {"cam0": camera}, None, [], 1.0, 0.0, []
    )


def listening(**options):
    bus, role = LocalBus(), DetectRole(config(**options), "cam0")
    return bus, role, attach_aid(bus, role)


def test_gyro_and_calibration_reach_the_predictor():
    rig = reference_rig(1)
    bus, role, _ = listening()
    predictor = role.aid.predictor
    assert predictor.camera.R_imu_cam is None  # the config gives a lens and no mounting
    believed = encode_calibration(estimate(Status.CONVERGING, rig), "cam0")
    bus.publish(topics.CALIBRATION.key("rig0", "cam0"), believed)
    np.testing.assert_allclose(predictor.camera.R_imu_cam, rig.R_imu_cam, atol=1e-9)
    assert predictor.camera.timeshift_cam_imu_s == 0.004
    for k in range(200):
        turning = encode_imu(START_NS + k * STEP_NS, "imu0", (0.0, 0.0, 0.5), (0.0, 0.0, 9.8))
        bus.publish(topics.IMU.key("rig0", "imu0"), turning)
    assert predictor.rotation(START_NS + 20 * STEP_NS, START_NS + 70 * STEP_NS) is None  # decoded on demand
    role.aid.prepare()
    turned = predictor.rotation(START_NS + 20 * STEP_NS, START_NS + 70 * STEP_NS)
    expected = rig.R_imu_cam.T @ so3.exp(np.array([0.0, 0.0, -0.025])) @ rig.R_imu_cam
    np.testing.assert_allclose(turned, expected, atol=1e-6)


def test_an_answer_that_is_not_believed_itself_changes_nothing():
    bus, role, _ = listening()
    key = topics.CALIBRATION.key("rig0", "cam0")
    for status in (Status.INCONSISTENT, Status.DEGENERATE, Status.INITIALISING):
        bus.publish(key, encode_calibration(estimate(status, reference_rig(1)), "cam0"))
    nothing = replace(estimate(Status.CONVERGED, reference_rig(1)), cameras={})
    bus.publish(key, encode_calibration(nothing, "cam0"))
    bus.publish(key, b"\x00\x01\x00\x00rubbish")
    bus.publish(topics.IMU.key("rig0", "imu0"), b"rubbish")
    role.aid.prepare()
    assert role.aid.predictor.camera.R_imu_cam is None


def test_a_board_needs_no_gyro():
    role = DetectRole(config(mode="target"), "cam0", detector=lambda image, t_ns: None)
    assert role.aid is None
    assert attach_aid(LocalBus(), role) == []
