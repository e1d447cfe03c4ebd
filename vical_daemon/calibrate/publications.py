"""An estimate as messages: our own, which is complete, and the standard ROS ones."""

from __future__ import annotations

from collections.abc import Mapping

from vical_daemon.bus import topics
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    Transform,
    encode_calibration,
    encode_camera_info,
    encode_pose,
    encode_transforms,
)
from vical_daemon.bus.outgoing import Message
from vical_daemon.config.model import Config
from vical_daemon.estimation.result import CalibrationEstimate, Status


def calibration_messages(config: Config, estimates: Mapping[str, CalibrationEstimate]) -> list[Message]:
    """Return the estimate of every camera, by its name, and its pose once there is a solution."""
    messages: list[Message] = []
    imu = config.calibration_imu
    for name, estimate in estimates.items():
        messages.append((topics.CALIBRATION.key(config.rig, name), encode_calibration(estimate, name)))
        camera = estimate.cameras.get(name)
        if camera is not None:
            pose = encode_pose(estimate.t_ns, imu, camera.T_imu_cam)
            messages.append((topics.POSE.key(config.rig, name), pose))
    return messages


def companion_messages(config: Config, estimate: CalibrationEstimate) -> list[Message]:
    """Return CameraInfo of every camera, and tf_static once converged.

    No transform is sent before convergence: users of tf take it as final.
    """
    messages: list[Message] = []
    transforms = []
    for name in config.calibration_cameras:
        camera = estimate.cameras.get(name)
        if camera is None:
            continue
        info = encode_camera_info(
            estimate.t_ns,
            name,
            config.cameras[name].size,
            camera.intrinsics,
            camera.distortion_model,
            camera.distortion,
        )
        messages.append((topics.CAMERA_INFO.key(config.rig, name), info))
        pose = camera.T_imu_cam
        x, y, z = pose.p_m
        qw, qx, qy, qz = pose.q_wxyz
        transforms.append(Transform(estimate.t_ns, config.calibration_imu, name, (x, y, z), (qw, qx, qy, qz)))
    if transforms and estimate.status is Status.CONVERGED:
        messages.append((topics.TF_STATIC.key(config.rig), encode_transforms(transforms)))
    return messages


def calibration_status(estimate: CalibrationEstimate | None, counters: dict[str, str]) -> DiagnosticStatus:
    """Return the health of the estimator: its progress and what limits it."""
    if estimate is None:
        return DiagnosticStatus(Level.OK, "estimate", "waiting for data", "", counters)
    bad = estimate.status in (Status.DEGENERATE, Status.INCONSISTENT)
    message = f"{estimate.status} {estimate.progress:.0%} {estimate.reason or estimate.guidance}".strip()
    values = {
        "status": str(estimate.status),
        "progress": f"{estimate.progress:.3f}",
        "guidance": estimate.guidance,
        "frames": str(estimate.frames),
        "imu_samples": str(estimate.imu_samples),
        "nis_per_dof": f"{estimate.nis_per_dof:.3f}",
        "rejected_fraction": f"{estimate.rejected_fraction:.4f}",
    }
    return DiagnosticStatus(Level.WARN if bad else Level.OK, "estimate", message, "", values | counters)
