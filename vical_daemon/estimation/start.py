"""Collects the first seconds and turns them into a state that the filter can start from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.camera_model import unproject
from vical_daemon.estimation.imu_buffer import ImuBuffer
from vical_daemon.estimation.initialise import LinearStart, linear_start
from vical_daemon.estimation.intrinsics_start import estimate_intrinsics
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, FloatArray, PointsFrame
from vical_daemon.estimation.planar_pose import PlanarPose, planar_pose
from vical_daemon.estimation.state import CameraState, Layout, State
from vical_daemon.estimation.td_icp import TdIcpResult, td_icp

MIN_SPAN_S = 3.0
MAX_FRAMES = 500
_STRETCH_S = 10.0
_MIN_POINTS = 8
_SHIFT_SIGMA_S = 1.0e-3
_ROTATION_SIGMA_RAD = np.deg2rad(1.0)


@dataclass(slots=True)
class Lens:
    """Intrinsics in use while starting: given, guessed, or estimated from the first frames."""

    intrinsics: FloatArray
    distortion: FloatArray
    model: str
    resolution: tuple[int, int]

    @classmethod
    def from_prior(cls, prior: CameraPrior) -> Lens:
        """Take what is given; a lens of 60 degrees across where nothing is."""
        width, height = prior.resolution
        guess = (0.87 * width, 0.87 * width, 0.5 * (width - 1), 0.5 * (height - 1))
        return cls(
            np.array(prior.intrinsics if prior.intrinsics is not None else guess, dtype=np.float64),
            np.array(prior.distortion if prior.distortion is not None else (0.0,) * 4, dtype=np.float64),
            prior.distortion_model,
            prior.resolution,
        )


@dataclass(slots=True)
class SeenPose:
    """Pose of the camera from one image: instant in the camera's clock and pose in the target frame."""

    t_cam_s: float
    pose: PlanarPose
    frame: PointsFrame

    @property
    def R_target_cam(self) -> FloatArray:
        """Attitude of the camera in the target frame."""
        return np.asarray(self.pose.R_cam_target.T)

    @property
    def p_target_cam(self) -> FloatArray:
        """Camera origin in the target frame, m."""
        return np.asarray(-self.pose.R_cam_target.T @ self.pose.p_cam_target)


@dataclass(slots=True)
class StartResult:
    """What one attempt gave: a state, or the reason why there is none yet.

    Attributes:
        state: Where the filter can start.
        reason: Why it cannot, in words.
        timing: TD-ICP's answer by camera, as far as it came.
        linear: The linear start of the first camera.
        motion_missing: It is motion that is missing, not time.
    """

    state: State | None
    reason: str
    timing: dict[str, TdIcpResult] = field(default_factory=dict)
    linear: LinearStart | None = None
    motion_missing: bool = False


def pose_of(frame: PointsFrame, t_cam_s: float, lens: Lens, target: FloatArray) -> SeenPose | None:
    """Planar pose of one frame; None where too few points are seen or the two-fold ambiguity is open."""
    if len(frame.ids) < _MIN_POINTS:
        return None
    rays, ok = unproject(frame.uv_px, lens.intrinsics, lens.distortion, lens.model)
    found = planar_pose(target[frame.ids[ok]], rays[ok, :2] / rays[ok, 2:])
    if not found.candidates or found.ambiguous:
        return None
    return SeenPose(t_cam_s, found.candidates[0], frame)


class PoseCache:
    """Poses already found, so that repeated attempts cost little; a new lens empties it."""

    def __init__(self) -> None:
        self._lens: tuple[float, ...] = ()
        self._poses: dict[int, SeenPose | None] = {}

    def poses(
        self, frames: list[tuple[float, PointsFrame]], lens: Lens, target: FloatArray, most: int = 160
    ) -> list[SeenPose]:
        """Poses of at most `most` of the frames, evenly thinned, in order of time."""
        key = (*lens.intrinsics.tolist(), *lens.distortion.tolist())
        step = max(1, -(-len(frames) // most))
        chosen = frames[len(frames) - 1 :: -step][::-1]
        if key != self._lens:
            self._lens, self._poses = key, {}
        known = {f.t_cam_ns: self._poses[f.t_cam_ns] for _, f in chosen if f.t_cam_ns in self._poses}
        for t, f in chosen:
            if f.t_cam_ns not in known:
                known[f.t_cam_ns] = pose_of(f, t, lens, target)
        self._poses = known
        return [p for _, f in chosen if (p := known[f.t_cam_ns]) is not None]


def attempt(
    buffer: ImuBuffer,
    frames: dict[str, list[tuple[float, PointsFrame]]],
    priors: dict[str, CameraPrior],
    options: CalibrationOptions,
    layout: Layout,
    target: FloatArray,
    caches: dict[str, PoseCache],
) -> StartResult:
    """Try to start from what has been seen so far.

    Args:
        buffer: Inertial readings.
        frames: By camera: (stamp in s, points), in order.
        priors: By camera.
        options: Switches.
        layout: Which blocks are estimated.
        target: Points of the target, m, shape (n, 3).
        caches: Poses found in earlier attempts, by camera.

    Returns:
        A state at the first usable frame, or the reason why not.
    """
    cameras: dict[str, CameraState] = {}
    timing: dict[str, TdIcpResult] = {}
    seen: dict[str, list[SeenPose]] = {}
    for name, prior in priors.items():
        lens = Lens.from_prior(prior)
        if layout.cameras[name].intrinsics is not None:
            estimate_intrinsics(lens, [f for _, f in frames[name]], target)
        poses = caches.setdefault(name, PoseCache()).poses(frames[name], lens, target)
        needed = 20 if layout.cameras[name].intrinsics is None else 30
        if len(poses) < needed:
            return StartResult(
                None, f"{name}: the target is seen in {len(poses)} frames so far: show the whole board"
            )
        seen[name] = poses
        result = _timing(buffer, poses, lens)
        timing[name] = result
        if result.reason:
            return StartResult(None, f"{name}: {result.reason}", timing, motion_missing=True)
        cameras[name] = CameraState(
            result.R_imu_cam,
            np.zeros(3),
            result.timeshift_cam_imu_s,
            lens.intrinsics,
            lens.distortion,
            lens.model,
            lens.resolution,
            prior.readout_s,
        )
        why = _not_sure_yet(result)
        if why:
            return StartResult(None, f"{name}: {why}", timing, motion_missing=True)
        _hold_priors(cameras[name], prior, options)
    return _motion_start(buffer, seen, cameras, timing, options)


def _timing(buffer: ImuBuffer, poses: list[SeenPose], lens: Lens) -> TdIcpResult:
    rows = buffer.rows
    sigma = np.array([np.sqrt(np.trace(p.pose.covariance[3:, 3:]) / 3.0) for p in poses])
    floor = 0.2 / float(lens.intrinsics[0])
    return td_icp(
        rows[:, 0],
        rows[:, 1:4],
        np.array([p.t_cam_s for p in poses]),
        np.array([p.R_target_cam for p in poses]),
        np.maximum(sigma, floor),
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


def _motion_start(
    buffer: ImuBuffer,
    seen: dict[str, list[SeenPose]],
    cameras: dict[str, CameraState],
    timing: dict[str, TdIcpResult],
    options: CalibrationOptions,
) -> StartResult:
    """Lever arms, velocity and gravity; the state stands at the first pose of the first camera."""
    first: LinearStart | None = None
    state: State | None = None
    for name, poses in seen.items():
        camera = cameras[name]
        # Only the latest stretch: the double integral drifts, and what was long ago costs more than it gives.
        since = max(buffer.oldest_s, poses[-1].t_cam_s + camera.timeshift_s - _STRETCH_S)
        inside = [p for p in poses if since < p.t_cam_s + camera.timeshift_s < buffer.newest_s]
        if len(inside) < 15:
            return StartResult(None, f"{name}: inertial data cover {len(inside)} frames so far", timing)
        linear = _linear(buffer, inside, camera, timing[name])
        if linear is None or float(np.max(linear.sigma_p_imu_cam)) > 0.1:
            return StartResult(
                None,
                f"{name}: lever arm not yet visible: turn the rig about two axes",
                timing,
                motion_missing=True,
            )
        if "extrinsics" not in options.fix:
            camera.p_imu_cam = linear.p_imu_cam
        if state is None:
            first, state = linear, _state_at(inside[0], camera, linear, timing[name], cameras, options)
    size = float(np.linalg.norm(first.gravity)) if first is not None else 0.0
    if not 0.7 * options.gravity_mps2 < size < 1.3 * options.gravity_mps2:
        why = (
            f"gravity comes out as {size:.2f} m/s^2 instead of {options.gravity_mps2:.2f}: "
            "check the target's size in its YAML and the unit of the accelerometer"
        )
        return StartResult(None, why, timing, first)
    return StartResult(state, "", timing, first)


def _linear(
    buffer: ImuBuffer, poses: list[SeenPose], camera: CameraState, timing: TdIcpResult
) -> LinearStart | None:
    R = np.array([p.R_target_cam for p in poses]) @ camera.R_imu_cam.T
    p = np.array([p.p_target_cam for p in poses])
    # Of a planar pose the position follows the rotation error at the board's distance.
    sigma = np.array([np.sqrt(np.trace(s.pose.covariance[:3, :3]) / 3.0) for s in poses])
    t = np.array([s.t_cam_s for s in poses]) + camera.timeshift_s
    return linear_start(buffer, t, R, p, timing.gyro_bias_rps, np.maximum(sigma, 5e-4))


def _state_at(
    seen: SeenPose,
    camera: CameraState,
    linear: LinearStart,
    timing: TdIcpResult,
    cameras: dict[str, CameraState],
    options: CalibrationOptions,
) -> State:
    R = seen.R_target_cam @ camera.R_imu_cam.T
    gravity = linear.gravity * (options.gravity_mps2 / np.linalg.norm(linear.gravity))
    return State(
        seen.t_cam_s + camera.timeshift_s,
        R,
        seen.p_target_cam - R @ camera.p_imu_cam,
        linear.v_world_imu,
        timing.gyro_bias_rps.copy(),
        linear.accel_bias.copy(),
        gravity,
        cameras,
    )
