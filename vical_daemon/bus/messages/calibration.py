"""vical_msgs/CalibrationEstimate: the complete estimate of one camera at one moment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.bus.messages.announcements import (
    read_directions,
    read_events,
    read_guidance,
    untyped_events,
    write_directions,
    write_events,
    write_guidance,
)
from vical_daemon.bus.messages.cdr import PADDING, CdrReader, CdrWriter, MessageError
from vical_daemon.bus.messages.poses import read_pose, write_pose
from vical_daemon.estimation.guidance import Guidance
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    ImuEstimate,
    PoseEstimate,
    Status,
)
from vical_daemon.estimation.wording import event_text

CALIBRATION_TYPE = "vical_msgs/msg/CalibrationEstimate"
_NO_POSE = PoseEstimate([0.0] * 3, [1.0, 0.0, 0.0, 0.0], [[0.0] * 6] * 6)


@dataclass(frozen=True, slots=True)
class CalibrationMessage:
    """The estimate of one camera as it travels.

    Attributes:
        camera: Name of the camera.
        estimate: The estimate; `cameras` holds this camera alone, or nothing before the first solution.
    """

    camera: str
    estimate: CalibrationEstimate

    @property
    def camera_estimate(self) -> CameraEstimate | None:
        """What is known about the camera; None before the first solution."""
        return self.estimate.cameras.get(self.camera)


def encode_calibration(estimate: CalibrationEstimate, camera: str) -> bytes:
    """Build the message of one camera (which may not be in the estimate yet).

    Raises:
        MessageError: A pose without 3 + 4 numbers or a covariance that is not 6x6.
    """
    writer = CdrWriter()
    writer.header(estimate.t_ns, camera)
    writer.string(str(estimate.status))
    writer.string(estimate.reason)
    writer.string(estimate.guidance)
    writer.strings([event_text(event) for event in estimate.events])
    writer.scalar("d", estimate.progress)
    writer.scalar("d", estimate.duration_s)
    writer.scalar("Q", estimate.frames)
    writer.scalar("Q", estimate.imu_samples)
    writer.scalar("d", estimate.nis_per_dof)
    writer.scalar("d", estimate.rejected_fraction)
    writer.sequence(estimate.gravity_world_mps2)
    _write_imu(writer, estimate.imu)
    known = estimate.cameras.get(camera)
    _write_camera(writer, known)
    write_events(writer, estimate.events)
    write_guidance(writer, estimate.next_motion)
    write_directions(writer, [] if known is None else known.withheld)
    return writer.finish()


def decode_calibration(data: bytes) -> CalibrationMessage:
    """Read a vical_msgs/CalibrationEstimate, also one of version 0.1.0, which has events as text only.

    Raises:
        MessageError: These bytes are no such message.
    """
    reader = CdrReader(data)
    t_ns, camera = reader.header()
    status = reader.string()
    if status not in set(Status):
        raise MessageError(f"calibration status {status!r} does not exist")
    reason, guidance, texts = reader.string(), reader.string(), reader.strings()
    progress, duration_s = reader.scalar("d"), reader.scalar("d")
    frames, imu_samples = reader.scalar("Q"), reader.scalar("Q")
    nis_per_dof, rejected_fraction = reader.scalar("d"), reader.scalar("d")
    gravity = reader.sequence().tolist()
    imu, known = _read_imu(reader), _read_camera(reader)
    events, next_motion = untyped_events(texts), Guidance()
    if reader.remaining > PADDING:
        events, next_motion = read_events(reader, texts), read_guidance(reader)
        withheld = read_directions(reader)
        known = None if known is None else replace(known, withheld=withheld)
    reader.end()
    estimate = CalibrationEstimate(
        t_ns=t_ns,
        status=Status(status),
        reason=reason,
        progress=progress,
        guidance=guidance,
        duration_s=duration_s,
        frames=frames,
        imu_samples=imu_samples,
        cameras={} if known is None else {camera: known},
        imu=imu,
        gravity_world_mps2=gravity,
        nis_per_dof=nis_per_dof,
        rejected_fraction=rejected_fraction,
        events=events,
        next_motion=next_motion,
    )
    return CalibrationMessage(camera, estimate)


def merge_calibrations(messages: Iterable[CalibrationMessage]) -> CalibrationEstimate:
    """Put the messages of several cameras back into one estimate; shared figures come from the newest.

    Raises:
        MessageError: There are no messages.
    """
    ordered = sorted(messages, key=lambda message: message.estimate.t_ns)
    if not ordered:
        raise MessageError("no calibration message to merge")
    cameras = {camera: known for m in ordered for camera, known in m.estimate.cameras.items()}
    return replace(ordered[-1].estimate, cameras=dict(sorted(cameras.items())))


def _write_imu(writer: CdrWriter, imu: ImuEstimate | None) -> None:
    writer.scalar("?", imu is not None)
    known = imu or ImuEstimate([], [])
    writer.sequence(known.gyro_bias_rps)
    writer.sequence(known.accel_bias_mps2)
    writer.sequence(known.gyro_bias_sigma_rps)
    writer.sequence(known.accel_bias_sigma_mps2)
    writer.sequence(_flat(known.gyro_matrix, 3))
    writer.sequence(_flat(known.accel_matrix, 3))


def _read_imu(reader: CdrReader) -> ImuEstimate | None:
    known = bool(reader.scalar("B"))
    biases = [reader.sequence().tolist() for _ in range(4)]
    matrices = [_square(reader.sequence(), 3) for _ in range(2)]
    return ImuEstimate(*biases, *matrices) if known else None


def _write_camera(writer: CdrWriter, camera: CameraEstimate | None) -> None:
    writer.scalar("?", camera is not None)
    known = camera or CameraEstimate(_NO_POSE, 0.0, 0.0, [], [], "", [], [], 0.0)
    pose = known.T_imu_cam
    covariance = _flat(pose.covariance, 6)
    if len(pose.p_m) != 3 or len(pose.q_wxyz) != 4 or covariance.size != 36:
        raise MessageError("T_imu_cam needs 3 + 4 numbers and a covariance of 6 x 6")
    write_pose(writer, pose.p_m, pose.q_wxyz)
    writer.fixed(covariance)
    writer.scalar("d", known.timeshift_cam_imu_s)
    writer.scalar("d", known.timeshift_sigma_s)
    writer.sequence(known.intrinsics)
    writer.sequence(known.intrinsics_sigma)
    writer.string(known.distortion_model)
    writer.sequence(known.distortion)
    writer.sequence(known.distortion_sigma)
    writer.scalar("d", known.readout_s)
    writer.scalar("d", known.readout_sigma_s)
    writer.scalar("d", known.reprojection_rms_px)
    writer.scalar("d", known.corner_sigma_px)
    writer.strings(known.unobservable)


def _read_camera(reader: CdrReader) -> CameraEstimate | None:
    known = bool(reader.scalar("B"))
    p_m, q_wxyz = read_pose(reader)
    covariance = reader.fixed(36).reshape(6, 6).tolist()
    timeshift_s, timeshift_sigma_s = reader.scalar("d"), reader.scalar("d")
    intrinsics, intrinsics_sigma = reader.sequence().tolist(), reader.sequence().tolist()
    model = reader.string()
    distortion, distortion_sigma = reader.sequence().tolist(), reader.sequence().tolist()
    readout_s, readout_sigma_s, rms_px, corner_px = (reader.scalar("d") for _ in range(4))
    unobservable = reader.strings()
    if not known:
        return None
    return CameraEstimate(
        T_imu_cam=PoseEstimate(list(p_m), list(q_wxyz), covariance),
        timeshift_cam_imu_s=timeshift_s,
        timeshift_sigma_s=timeshift_sigma_s,
        intrinsics=intrinsics,
        intrinsics_sigma=intrinsics_sigma,
        distortion_model=model,
        distortion=distortion,
        distortion_sigma=distortion_sigma,
        reprojection_rms_px=rms_px,
        corner_sigma_px=corner_px,
        unobservable=unobservable,
        readout_s=readout_s,
        readout_sigma_s=readout_sigma_s,
    )


def _flat(matrix: list[list[float]], size: int) -> npt.NDArray[np.float64]:
    """Return a square matrix row by row, or nothing for []."""
    array = np.asarray(matrix, dtype=np.float64)
    if array.size and array.shape != (size, size):
        raise MessageError(f"matrix of shape {array.shape} where {size} x {size} is due")
    return array.reshape(-1)


def _square(values: npt.NDArray[np.float64], size: int) -> list[list[float]]:
    if len(values) not in (0, size * size):
        raise MessageError(f"matrix of {len(values)} numbers where {size} x {size} are due")
    return values.reshape(-1, size).tolist() if len(values) else []
