"""The motion anew from a few images, with the calibration as it is known.

After gaps and lost poses (`MotionRestart`), and at the begin of another recording (`RecordingStart`).

Pose from the target; velocity linear in positions: `LinearMotion` with everything but p_0 and v_0 known.

A few corners at the edge of an image, where the lens fits least, give a pose that is off by many times what
its residuals say: on EuRoC 16 to 24 corners by 4 to 12 deg, at 0.7 to 1.0 deg. What innovations have shown to
be wrong with the images of a camera widens its poses, too.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.attempts import LONG_S, Attempts
from vical_daemon.estimation.init.linear_start import (
    BIAS,
    GRAVITY,
    LEAST_IMAGES,
    SPEED,
    LinearMotion,
    LinearStart,
    linear_start,
)
from vical_daemon.estimation.init.target_poses import TargetPose, attitude_sigmas, pose_of
from vical_daemon.estimation.measurements import IMAGE_GAP_S, FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.priors import AGAIN_SIGMAS
from vical_daemon.estimation.model.state import (
    ATTITUDE,
    POSITION,
    VELOCITY,
    BiasStart,
    CameraState,
    MotionStart,
    State,
)
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.temporal.rotation_turns import MIN_PAIRS
from vical_daemon.estimation.temporal.shift_step import ShiftFit
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_input import MIN_ORIENTATIONS

_LEAST_S = 0.1  # of motion: 1 mm of position noise is then 15 mm/s of velocity
_WIDE = 0.03
"""Sigma up to which images are near to linear: of attitude, rad; of position, over the target's distance."""
_WAIT_S = 2.0
"""For an image that shows the pose so well, or for a camera whose clock was set: a board comes back into view
within seconds, or not. Of another recording, so much shows a time shift: two swings of a hand."""
_WIDE_MPS = 0.3  # of velocity: ten times what a board in full view gives
_RECORDING_S = 1.5
"""Of motion: 2 mm of position noise in 15 images are then 10 mm/s^2 of gravity, a milliradian."""
_MOST_S = (
    2.0 * _WAIT_S
)  # of images without enough poses among them; what is older says nothing of the motion now
_POSITION_SIGMA_M = 2e-3  # of a pose of the target, m: weighs the prior of the bias


class Poses(NamedTuple):
    """Poses of the imu in the target's frame.

    Attributes:
        t_s: Instants, imu clock, s, shape (n,).
        R: Attitudes, shape (n, 3, 3).
        p: Positions, m, shape (n, 3).
        first: What the first was taken from.
    """

    t_s: FloatArray
    R: FloatArray
    p: FloatArray
    first: TargetPose


class MotionRestart:
    """Collects images until the motion can start anew from them.

    Args:
        target: Points of the target, m, shape (n, 3).
        before_ns: Stamp of the last image used before, by camera, ns.
        jumped: Images stopped to fit without a gap: the target may have moved.

    Attributes:
        jumped: See above.
        frames: Collected so far.
    """

    def __init__(self, target: FloatArray, before_ns: Mapping[str, int], *, jumped: bool = False) -> None:
        self._target, self.jumped = target, jumped
        self._before_ns = dict(before_ns)
        self.frames: Frames = []
        self._seen: list[TargetPose | None] = []

    def take(self, frame: PointsFrame, t_cam_s: float, state: State, buffer: ImuBuffer) -> None:
        """Add an image; where readings are missing since the one before, only the new one counts.

        Args:
            frame: The image.
            t_cam_s: Its stamp, s.
            state: With the calibration as it is known.
            buffer: Inertial readings.
        """
        t_s = t_cam_s + _camera(state, frame).timeshift_s
        # of the same camera: the clocks of others may still be off
        before_s = next((t for t, kept in reversed(self.frames) if kept.camera == frame.camera), None)
        if before_s is not None:
            before_s += _camera(state, frame).timeshift_s
            if t_s < before_s or buffer.gap_within(before_s, t_s):
                self.frames, self._seen = [], []
        if t_s < buffer.oldest_s or buffer.gap_within(t_s, t_s):
            return
        seen = pose_of(frame, t_cam_s, _camera(state, frame), self._target)
        if seen is None and not self.frames:
            return
        self.frames.append((t_cam_s, frame))
        self._seen.append(seen)

    def saw_lately(self, cameras: Collection[str], t_cam_s: float) -> bool:
        """Whether one of some cameras has sent an image within the last seconds; `t_cam_s`: now, s."""
        return any(kept.camera in cameras and t_cam_s - t < _WAIT_S for t, kept in self.frames)

    def leave_out(self, cameras: Collection[str]) -> None:
        """Forget the images of some cameras."""
        keep = [k for k, (_, frame) in enumerate(self.frames) if frame.camera not in cameras]
        self.frames, self._seen = [self.frames[k] for k in keep], [self._seen[k] for k in keep]

    def drop_before(self, t_cam_s: float) -> None:
        """Leave images out that were stamped before `t_cam_s`, and those after them up to one with a pose."""
        keep = [k for k, (t, _) in enumerate(self.frames) if t >= t_cam_s and self._seen[k] is not None]
        first = keep[0] if keep else len(self.frames)
        if self.frames and self.frames[0][0] < t_cam_s:
            self.frames, self._seen = self.frames[first:], self._seen[first:]

    def motion(self, f: CalibrationFilter, buffer: ImuBuffer) -> MotionStart | None:
        """Motion at the first image collected; None while the images do not suffice.

        Args:
            f: With the calibration as it is known.
            buffer: Inertial readings.
        """
        state = f.state
        if not self._begins_well(f):
            return None
        poses = self._enough_poses(state, LEAST_IMAGES, _LEAST_S)
        if poses is None:
            return None
        t_s, R = poses.t_s, poses.R
        found = LinearMotion.between(buffer, t_s, R, state.gyro_bias)
        if found is None:
            return None
        turned = _turned(float(t_s[0]), R[0], f, buffer) if self.jumped else None
        gravity = state.gravity if turned is None else turned @ state.gravity
        known = np.concatenate([np.zeros(3), gravity, np.zeros(3), state.accel_bias])
        start = linear_start(found, poses.p, np.ones(len(t_s)), unknown=[SPEED], known=known)
        wide = sigmas_of_motion(poses.first, f, float(found.T[-1]))
        elapsed_s = self._elapsed_s(poses.first.frame, float(t_s[0]) - state.t_s)
        motion = MotionStart(float(t_s[0]), R[0], start.p_world_cam, start.v_world_imu, wide, elapsed_s)
        return motion._replace(turned=turned)

    def _begins_well(self, f: CalibrationFilter) -> bool:
        """Begin with an image that shows the pose; False: none does so far, and better ones may come."""
        for (t_cam_s, _), seen in zip(self.frames, self._seen, strict=True):
            if seen is not None and _near(*_sigmas_seen(seen, f), _distance_m(seen.p_target_cam)):
                self.drop_before(t_cam_s)
                return True
        return bool(self.frames) and self.frames[-1][0] - self.frames[0][0] > _WAIT_S

    def _enough_poses(self, state: State, least: int, least_s: float) -> Poses | None:
        """Poses of the imu by the images collected and the calibration as it is known.

        Args:
            state: With that calibration.
            least: Fewer poses give None.
            least_s: So do poses over less than this, s.
        """
        seen = [s for s in self._seen if s is not None]
        if len(seen) < least:
            return None
        cameras = [_camera(state, s.frame) for s in seen]
        t_s = np.array([s.t_cam_s + c.timeshift_s for s, c in zip(seen, cameras, strict=True)])
        R = np.array([s.R_target_cam @ c.R_imu_cam.T for s, c in zip(seen, cameras, strict=True)])
        arms = np.array([c.p_imu_cam for c in cameras])
        p = np.array([s.p_target_cam for s in seen]) - np.einsum("nij,nj->ni", R, arms)
        return Poses(t_s, R, p, seen[0]) if t_s[-1] - t_s[0] >= least_s else None

    def _elapsed_s(self, frame: PointsFrame, by_imu_s: float) -> float:
        """Time since the motion was lost: the less of what both clocks say, for either may have been set."""
        before_ns = self._before_ns.get(frame.camera)
        by_camera_s = np.inf if before_ns is None else 1e-9 * (frame.t_cam_ns - before_ns)
        return max(min(by_imu_s, by_camera_s), 0.0)


def _turned(t_s: float, R: FloatArray, f: CalibrationFilter, buffer: ImuBuffer) -> FloatArray | None:
    """How the attitude `R` by an image at `t_s` differs from that by the imu since the motion was lost."""
    there = ahead(f, buffer, t_s)
    return None if there is None else np.asarray(R @ there.state.R_world_imu.T)


def ahead(f: CalibrationFilter, buffer: ImuBuffer, t_s: float) -> CalibrationFilter | None:
    """A copy of a filter at a later instant, s, by the readings alone; None where these do not reach."""
    segment = buffer.segment(f.state.t_s, t_s)
    if segment is None:
        return None
    out = f.copy()
    out.predict(segment)
    return out


def sigmas_of_motion(seen: TargetPose, f: CalibrationFilter, span_s: float) -> FloatArray:
    """Sigmas of the motion, shape (9,): many times what the images give where these show a whole board.

    They will be used once more to correct the motion.
    """
    where, sigmas = f.layout.cameras[seen.frame.camera], f.sigmas()
    turn = float(sigmas[where.rotation].max()) if where.rotation is not None else 0.0
    arm = float(sigmas[where.position].max()) if where.position is not None else 0.0
    seen_rad, seen_m = _sigmas_seen(seen, f)
    out = np.empty(9)
    out[ATTITUDE] = max(_WIDE, AGAIN_SIGMAS * turn, seen_rad)
    out[POSITION] = max(_WIDE * _distance_m(seen.p_target_cam), AGAIN_SIGMAS * arm, seen_m)
    out[VELOCITY] = max(_WIDE_MPS, AGAIN_SIGMAS * arm / span_s, seen_m / span_s)
    return out


def _sigmas_seen(seen: TargetPose, f: CalibrationFilter) -> tuple[float, float]:
    """Sigmas of a pose by one image, rad and m, with what is known of errors that its corners share."""
    consistency = f.consistency[seen.frame.camera]
    wider = math.sqrt(consistency.scale * consistency.factor)
    return wider * seen.sigma_rad, wider * seen.sigma_m


def motion_is_lost(
    f: CalibrationFilter, buffer: ImuBuffer, t_cam_s: float, frame: PointsFrame, target: FloatArray
) -> bool:
    """Whether the motion at an image cannot be had from the one before: readings miss, or it drifted far.

    Far is where images are not near to linear, and the pose from the image itself would be as good.

    Args:
        f: The filter, after an image before.
        buffer: Inertial readings.
        t_cam_s: Stamp of the image, s.
        frame: The image.
        target: Points of the target, m, shape (n, 3).
    """
    camera = _camera(f.state, frame)
    t_s = t_cam_s + camera.timeshift_s
    if buffer.gap_within(f.state.t_s, t_s):
        return True
    if t_s < f.state.t_s + IMAGE_GAP_S:
        return False
    there = ahead(f, buffer, t_s)
    if there is None:
        return False
    sigmas = there.sigmas()
    turn, away = float(sigmas[ATTITUDE].max()), float(sigmas[POSITION].max())
    if _near(turn, away, _distance_m(there.state.p_world_imu)):
        return False
    seen = pose_of(frame, t_cam_s, camera, target)
    if seen is None:
        return True
    seen_rad, seen_m = _sigmas_seen(seen, f)
    return turn > seen_rad or away > seen_m


def _near(turn_rad: float, away_m: float, distance_m: float) -> bool:
    """Whether images are near to linear about a pose, by its sigmas and the distance to the target."""
    return turn_rad <= _WIDE and away_m <= _WIDE * distance_m


def _distance_m(p_target_cam: FloatArray) -> float:
    """Distance of a camera to the origin of the target, m."""
    return float(np.sqrt(p_target_cam @ p_target_cam))


def _camera(state: State, frame: PointsFrame) -> CameraState:
    return state.cameras[frame.camera]


class RecordingStart(MotionRestart):
    """Collects the first images of another recording until its motion can start from them.

    Gravity and the biases are unknown, too: the board may stand elsewhere, the imu was switched off. With the
    calibration known, all are linear in poses of the target over a second or two; the gyro's bias is by what
    its turns differ from those seen.

    Args:
        target: Points of the target, m, shape (n, 3).
        before_ns: See `MotionRestart`.
        seeking: A time shift is to be found first, see `shift`; images are kept for longer.
    """

    def __init__(self, target: FloatArray, before_ns: Mapping[str, int], *, seeking: bool = False) -> None:
        super().__init__(target, before_ns)
        self._longest_s = LONG_S if seeking else _MOST_S
        self._attempts: dict[str, Attempts] = {}  # by camera

    def take(self, frame: PointsFrame, t_cam_s: float, state: State, buffer: ImuBuffer) -> None:
        """See `MotionRestart.take`; images of long ago are left out."""
        super().take(frame, t_cam_s, state, buffer)
        self.drop_before(t_cam_s - self._longest_s)

    def motion(self, f: CalibrationFilter, buffer: ImuBuffer) -> MotionStart | None:
        """See `MotionRestart.motion`; the time between the recordings is not known, and taken as none."""
        state = f.state
        poses = self._enough_poses(state, MIN_PAIRS, _RECORDING_S)
        if poses is None:
            return None
        gyro_bias = _gyro_bias(buffer, poses.t_s, poses.R)
        if gyro_bias is None:
            return None
        found = LinearMotion.between(buffer, poses.t_s, poses.R, gyro_bias)
        if found is None:
            return None
        start = _linear(found, poses.p, state)
        wide = sigmas_of_motion(poses.first, f, float(found.T[-1]))
        biases = BiasStart(gyro_bias, start.accel_bias, start.gravity)
        return MotionStart(
            float(poses.t_s[0]), poses.R[0], start.p_world_cam, start.v_world_imu, wide, 0.0, biases
        )

    def shift(self, state: State, buffer: ImuBuffer, camera: str) -> tuple[ShiftFit | None, bool]:
        """Time shift of a camera whose clock may be off by seconds, by its turns and the gyro's.

        The bias is not known either, and a wrong time shift gives a wrong bias: both are found together.

        Args:
            state: With the calibration as it is known.
            buffer: Inertial readings.
            camera: Its name.

        Returns:
            The fit, or None; and whether more images may show it.
        """
        poses = [s for s in self._seen if s is not None and s.frame.camera == camera]
        span_s = poses[-1].t_cam_s - poses[0].t_cam_s if poses else 0.0
        attempts = self._attempts.setdefault(camera, Attempts(first_s=0.5))
        if len(poses) < MIN_ORIENTATIONS or span_s < _WAIT_S or not attempts.due(poses[-1].t_cam_s):
            return None, True
        attempts.tried(poses[-1].t_cam_s)
        rows = buffer.rows
        t_s, R = np.array([p.t_cam_s for p in poses]), np.array([p.R_target_cam for p in poses])
        found = td_icp(rows[:, 0], rows[:, 1:4], t_s, R, attitude_sigmas(poses, state.cameras[camera]))
        if found.still:
            self.drop_before(float(t_s[-1]))
            return None, True
        if found.status == "ok":
            return ShiftFit(found.timeshift_cam_imu_s, found.timeshift_sigma_s, stepped=True), True
        return None, span_s < self._longest_s - _WAIT_S


def _gyro_bias(buffer: ImuBuffer, t_s: FloatArray, R_world_imu: FloatArray) -> FloatArray | None:
    """Bias of the gyro by the attitudes seen, rad/s, shape (3,); None where readings are missing.

    log(dR_gyro' dR_seen) = -integral of dR(t)' b dt, with dR from t to the end of each interval.
    """
    if t_s[0] < buffer.oldest_s or t_s[-1] > buffer.newest_s:
        return None
    curve = GyroCurve.integrate(buffer.rows[:, 0], buffer.rows[:, 1:4], np.zeros(3))
    R, _, integral = curve.at(t_s)
    back, turned = np.swapaxes(R[1:], 1, 2) @ R[0], R[0].T @ (integral[1:] - integral[0])
    misses = so3.log(back @ R_world_imu[0].T @ R_world_imu[1:])
    rows = np.concatenate([back @ turned, back], axis=2)  # the error of the first attitude is unknown, too
    x, *_ = np.linalg.lstsq(rows.reshape(-1, 6), -misses.ravel(), rcond=None)
    return np.asarray(x[:3])


def _linear(motion: LinearMotion, p_world_imu: FloatArray, state: State) -> LinearStart:
    """Motion at the first pose, gravity of its known length, and the accelerometer's bias."""
    sigma, known = np.full(len(p_world_imu), _POSITION_SIGMA_M), np.zeros(12)
    known[BIAS] = state.accel_bias
    found = linear_start(motion, p_world_imu, sigma, unknown=[SPEED, GRAVITY, BIAS], known=known)
    known[GRAVITY] = found.gravity * (np.linalg.norm(state.gravity) / np.linalg.norm(found.gravity))
    return linear_start(motion, p_world_imu, sigma, unknown=[SPEED, BIAS], known=known)
