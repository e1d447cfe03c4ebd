"""One attempt to start from what was seen so far: a state that the filter can begin with, or why not.

Mounting and delay come from rotations (TD-ICP); where the motion turns too little for that, and only then,
from accelerations (`accel_alignment`), as a *partial* start: some of it stays unknown, and sigmas say so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.accel_alignment import align
from vical_daemon.estimation.imu_buffer import ImuBuffer
from vical_daemon.estimation.intrinsics_start import estimate_intrinsics
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, FloatArray, PointsFrame
from vical_daemon.estimation.motion_start import StartResult, motion_start
from vical_daemon.estimation.seen_poses import Lens, PoseCache, SeenPose
from vical_daemon.estimation.state import CameraState, Layout
from vical_daemon.estimation.td_icp import TdIcpResult, td_icp

_SHIFT_SIGMA_S = 1.0e-3
_ROTATION_SIGMA_RAD = np.deg2rad(1.0)
_PARTIAL_STRETCH_S = 8.0
_PARTIAL_MIN_S = 6.0
_PARTIAL_SHIFTS_S = (-1.0, 1.0)


@dataclass(frozen=True, slots=True)
class StartData:
    """What an attempt works on.

    Attributes:
        buffer: Inertial readings.
        frames: By camera: (stamp in s, points), in order.
        priors: By camera.
        options: Switches.
        layout: Which blocks are estimated.
        target: Points of the target, m, shape (n, 3).
        caches: Poses found in earlier attempts, by camera.
    """

    buffer: ImuBuffer
    frames: dict[str, list[tuple[float, PointsFrame]]]
    priors: dict[str, CameraPrior]
    options: CalibrationOptions
    layout: Layout
    target: FloatArray
    caches: dict[str, PoseCache]


def attempt(data: StartData) -> StartResult:
    """Try to start with everything known; see `StartData`.

    Returns:
        A state at the first usable frame, or the reason why not.
    """
    cameras: dict[str, CameraState] = {}
    gyro_bias: dict[str, FloatArray] = {}
    seen: dict[str, list[SeenPose]] = {}
    for name, prior in data.priors.items():
        lens, poses = _poses(data, name)
        needed = 20 if data.layout.cameras[name].intrinsics is None else 30
        if len(poses) < needed:
            return StartResult(
                None, f"{name}: the target is seen in {len(poses)} frames so far: show the whole board"
            )
        result = _timing(data.buffer, poses, lens)
        why = result.reason or _not_sure_yet(result)
        if why:
            return StartResult(None, f"{name}: {why}", motion_missing=True)
        seen[name], gyro_bias[name] = poses, result.gyro_bias_rps
        cameras[name] = _camera(lens, prior, result.R_imu_cam, result.timeshift_cam_imu_s)
        _hold_priors(cameras[name], prior, data.options)
    return motion_start(data.buffer, seen, cameras, gyro_bias, data.options)


def partial_attempt(data: StartData, reason: str) -> StartResult:
    """Try to start where rotations alone do not show the mounting: accelerations may.

    Args:
        data: See `StartData`.
        reason: What `attempt` said; it stays true, whatever is found here.

    Returns:
        A state that is a guess where the motion shows nothing, or the reason again.
    """
    cameras: dict[str, CameraState] = {}
    gyro_bias: dict[str, FloatArray] = {}
    seen: dict[str, list[SeenPose]] = {}
    refused = StartResult(None, reason, motion_missing=True)
    for name, prior in data.priors.items():
        lens, poses = _poses(data, name, data.frames[name][-1][0] - _PARTIAL_STRETCH_S)
        if not poses or poses[-1].t_cam_s - poses[0].t_cam_s < _PARTIAL_MIN_S:
            return refused
        found = align(
            data.buffer.rows,
            np.array([p.t_cam_s for p in poses]),
            np.array([p.R_target_cam for p in poses]),
            np.array([p.p_target_cam for p in poses]),
            np.maximum([p.sigma_m for p in poses], 2e-4),
            np.maximum([p.sigma_rad for p in poses], 0.2 / float(lens.intrinsics[0])),
            _PARTIAL_SHIFTS_S,
        )
        if found is None or not found.trusted:
            return refused
        seen[name], gyro_bias[name] = poses, found.gyro_bias_rps
        cameras[name] = _camera(lens, prior, found.R_imu_cam, found.timeshift_s)
        _hold_priors(cameras[name], prior, data.options)
    result = motion_start(data.buffer, seen, cameras, gyro_bias, data.options, partial=True)
    return refused if result.state is None else replace(result, reason=reason)


def _poses(data: StartData, name: str, since_s: float = -np.inf) -> tuple[Lens, list[SeenPose]]:
    """Lens of a camera, as known or estimated, and its poses since a stamp."""
    lens = Lens.from_prior(data.priors[name])
    if data.layout.cameras[name].intrinsics is not None:
        estimate_intrinsics(lens, [f for _, f in data.frames[name]], data.target)
    cache = data.caches.setdefault(name, PoseCache())
    return lens, cache.poses(data.frames[name], lens, data.target, since_s)


def _camera(lens: Lens, prior: CameraPrior, R_imu_cam: FloatArray, timeshift_s: float) -> CameraState:
    """A camera whose lever arm is still to be found."""
    return CameraState(
        R_imu_cam,
        np.zeros(3),
        timeshift_s,
        lens.intrinsics,
        lens.distortion,
        lens.model,
        lens.resolution,
        prior.readout_s,
    )


def _timing(buffer: ImuBuffer, poses: list[SeenPose], lens: Lens) -> TdIcpResult:
    rows = buffer.rows
    return td_icp(
        rows[:, 0],
        rows[:, 1:4],
        np.array([p.t_cam_s for p in poses]),
        np.array([p.R_target_cam for p in poses]),
        np.maximum([p.sigma_rad for p in poses], 0.2 / float(lens.intrinsics[0])),
    )


def _not_sure_yet(result: TdIcpResult) -> str:
    """Why TD-ICP's answer does not do yet; empty when it does."""
    if result.timeshift_sigma_s > _SHIFT_SIGMA_S:
        known = 1e3 * result.timeshift_sigma_s
        return f"time shift known to {known:.1f} ms so far: turn the rig faster, about changing axes"
    if float(np.max(result.rotation_sigma_rad)) > _ROTATION_SIGMA_RAD:
        worst = np.rad2deg(float(np.max(result.rotation_sigma_rad)))
        return f"mounting rotation known to {worst:.1f} deg so far: turn the rig about a second axis"
    return ""


def _hold_priors(camera: CameraState, prior: CameraPrior, options: CalibrationOptions) -> None:
    """Put values that are held fixed back to what was given."""
    if "timeshift" in options.fix and prior.timeshift_cam_imu_s is not None:
        camera.timeshift_s = prior.timeshift_cam_imu_s
    if "extrinsics" in options.fix and prior.T_imu_cam is not None:
        camera.R_imu_cam, camera.p_imu_cam = prior.T_imu_cam[0].copy(), prior.T_imu_cam[1].copy()
