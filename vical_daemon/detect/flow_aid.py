"""Feeds gyro and calibration to the flow prediction of a feature tracker. No I/O."""

from __future__ import annotations

from collections import deque

import numpy as np

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import MessageError, admit_calibration, admit_imu
from vical_daemon.config.model import Config
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import CameraEstimate, Status
from vical_daemon.vision.flow_prediction import FlowCamera, FlowPredictor

ENOUGH_HZ = 200.0  # enough for the mean rate between two images
_QUEUE_LIMIT = 4000
_USABLE = (Status.CONVERGING, Status.CONVERGED)


class GyroAid:
    """Feeds the flow predictor of one camera.

    Inertial samples are queued undecoded; `prepare` decodes them when an image needs them. Without a prior of
    the mounting, the gyro helps from the first calibration on.

    Args:
        config: The rig.
        camera: Name of the camera.
        prior: Its prior.
    """

    def __init__(self, config: Config, camera: str, prior: CameraPrior) -> None:
        self.camera = camera
        self.predictor = FlowPredictor(_from_prior(prior))
        imu = config.calibration.imu or next(iter(config.imus))
        self.imu_key = topics.IMU.key(config.rig, imu)
        self.calibration_key = topics.CALIBRATION.key(config.rig, camera)
        self._every = max(1, int(config.imus[imu].rate_hz / ENOUGH_HZ))
        self._count = 0
        self._samples: deque[bytes] = deque(maxlen=_QUEUE_LIMIT)

    def take_imu(self, sample: Sample) -> None:
        """Queue an inertial sample; cheap enough for the bus thread."""
        self._count += 1
        if self._count % self._every == 0:
            self._samples.append(sample.payload)

    def take_calibration(self, sample: Sample) -> None:
        """Use a calibration that is converging or converged; ignore any other."""
        try:
            message = admit_calibration(sample.payload)
        except MessageError:
            return
        known = message.camera_estimate
        if known is not None and message.estimate.status in _USABLE:
            self.predictor.camera = _from_estimate(known)

    def prepare(self) -> None:
        """Pass the queued samples to the predictor."""
        while self._samples:
            try:
                imu = admit_imu(self._samples.popleft())
            except MessageError:
                continue
            self.predictor.add_imu(imu.stamp_ns, imu.gyro_rps)


def _from_prior(prior: CameraPrior) -> FlowCamera | None:
    if prior.intrinsics is None:
        return None
    R = None if prior.T_imu_cam is None else np.asarray(prior.T_imu_cam)[:3, :3]
    distortion = prior.distortion or (0.0, 0.0, 0.0, 0.0)
    return FlowCamera(
        prior.intrinsics, distortion, prior.distortion_model, R, prior.timeshift_cam_imu_s or 0.0
    )


def _from_estimate(e: CameraEstimate) -> FlowCamera:
    fx, fy, cx, cy = e.intrinsics
    R = so3.matrix_from_quat(np.array(e.T_imu_cam.q_wxyz))
    return FlowCamera((fx, fy, cx, cy), tuple(e.distortion), e.distortion_model, R, e.timeshift_cam_imu_s)
