"""The moving half of a start: lever arms, velocity, gravity and biases, once mounting and delay are known."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.so3 import nearest_rotation
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_model import over_intervals, products, strapdown
from vical_daemon.estimation.init.accelerometer_check import mistaken_axes
from vical_daemon.estimation.init.linear_start import LinearMotion, LinearStart, linear_start, still_axes
from vical_daemon.estimation.init.target_poses import TargetPose, attitude_sigmas
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray
from vical_daemon.estimation.model.state import CameraState, State
from vical_daemon.estimation.significance import SURE_SIGMAS

_GRAVITY = (
    "gravity comes out as {:.2f} m/s^2 instead of {:.2f}: "
    "check the target's size in its YAML and the unit of the accelerometer"
)
_STRETCH_S = 10.0  # of the latest poses: biases are constant over it
_LEAST_POSES = 15  # in it
_NEAR_S = 0.5  # the gyro carries an attitude so far: 1 % of scale is 0.3 deg at 1 rad/s


@dataclass(slots=True)
class StartResult:
    """What one attempt gave: a state, or the reason why there is none yet.

    Attributes:
        state: Where the filter can start.
        reason: Why it cannot, or what the motion does not show, in words.
        motion_missing: It is motion that is missing, not time.
        still_axes: Of a partial start: axes of the imu along which lever arms are guessed, shape (k, 3);
            None: everything is known.
        turn_axis_cam: Of a rig that turned about it at one rate all the time, camera frame, shape (3,): the
            delay and the mounting about this axis are guessed, too; None: not so.
        poses: Of all images used, by camera and in order.
        size: True size of the target over the stated one, where it seems to be by far another; to be tried
            where a window does not fit with the stated one. None: it may be as in its file.
        rolling: A camera that has a rolling shutter of which nothing was said, and what it reads one after
            the other (`ROWS`, `COLUMNS`); None: there is none.
        ratio: Columns of the target seem to be so many times as far apart, compared with its rows, as stated;
            1: as stated.
        half_turned: A camera by which the target is upside down against what it is by another; empty: none.
    """

    state: State | None
    reason: str
    motion_missing: bool = False
    still_axes: FloatArray | None = None
    turn_axis_cam: FloatArray | None = None
    poses: list[TargetPose] = field(default_factory=list)
    size: float | None = None
    rolling: tuple[str, str] | None = None
    ratio: float = 1.0
    half_turned: str = ""


@dataclass(frozen=True, slots=True)
class RotationsKnown:
    """One camera before its lever arm is known.

    Attributes:
        camera: Mounting and time shift are used, the lever arm will be set.
        poses: In order.
        gyro_bias_rps: As found with this camera, shape (3,).
    """

    camera: CameraState
    poses: list[TargetPose]
    gyro_bias_rps: FloatArray


def motion_start(
    buffer: ImuBuffer,
    known: dict[str, RotationsKnown],
    options: CalibrationOptions,
    partial: bool = False,
    turn_axis_cam: FloatArray | None = None,
    *,
    may_resize: bool = True,
) -> StartResult:
    """Lever arms, velocity and gravity; the state stands at the first pose of the first camera.

    Args:
        buffer: Inertial readings.
        known: By camera.
        options: Switches.
        partial: The motion need not show the lever arms; what it does not show is taken as zero.
        turn_axis_cam: Of a partial start of a rig that turns at one rate, see `StartResult`: it shows none.
        may_resize: Another size of the target may be suggested; not from a partial start.

    Returns:
        The state, or the reason why not.
    """
    state: State | None = None
    size, still = 0.0, None
    other: float | None = None
    used: list[TargetPose] = []
    cameras = {name: x.camera for name, x in known.items()}
    for name, x in known.items():
        camera, poses, gyro_bias = x.camera, x.poses, x.gyro_bias_rps
        # Only the latest stretch: the double integral drifts, and what was long ago costs more than it gives.
        since = max(buffer.oldest_s, poses[-1].t_cam_s + camera.timeshift_s - _STRETCH_S)
        inside = [p for p in poses if since < p.t_cam_s + camera.timeshift_s < buffer.newest_s]
        used += inside
        if len(inside) < _LEAST_POSES:
            seen = f"{len(inside)} images of the board in the latest {_STRETCH_S:.0f} s"
            return StartResult(None, f"{name}: {seen}, a start needs {_LEAST_POSES}")
        R, p, sigma, t = _poses_of_imu(inside, camera)
        R = by_neighbours(buffer, t, R, gyro_bias)
        axes: FloatArray | None = None
        if partial:
            axes = still_axes(R.mean(axis=0)) if turn_axis_cam is None else np.eye(3)
        motion = LinearMotion.between(buffer, t, R, gyro_bias)
        if motion is None:
            return StartResult(None, f"{name}: inertial data do not cover its images", size=other)
        tilt_mps2 = options.gravity_mps2 * _attitude_sigma(inside, camera)
        solve = functools.partial(linear_start, motion, p, sigma, force_sigma=tilt_mps2)
        if may_resize and not partial:
            other = other or _other_size(solve(free_size=True), options.gravity_mps2)
        linear = solve(held_axes=axes)
        if "extrinsics" not in options.fix:
            camera.p_imu_cam = linear.p_imu_cam
        if state is None:
            size, still = float(np.linalg.norm(linear.gravity)), axes
            state = _state_at(inside[0], camera, linear, gyro_bias, cameras, options)
    if not 0.7 * options.gravity_mps2 < size < 1.3 * options.gravity_mps2:
        why = "" if other else mistaken_axes(next(iter(known.values())).poses, cameras, buffer)
        return StartResult(None, why or _GRAVITY.format(size, options.gravity_mps2), size=other)
    return StartResult(state, "", still_axes=still, turn_axis_cam=turn_axis_cam, poses=used, size=other)


def _other_size(found: LinearStart, gravity_mps2: float) -> float | None:
    """Size of the target over the stated one, where positions and accelerations suggest another one.

    Gravity must come out right with it: an accelerometer in g, too, makes the world look another size.
    """
    if found.size <= 0.0 or abs(found.size - 1.0) < SURE_SIGMAS * found.sigma_size:
        return None
    gravity = float(np.linalg.norm(found.gravity)) / gravity_mps2
    return found.size if 0.9 < gravity < 1.1 else None


def by_neighbours(buffer: ImuBuffer, t_s: FloatArray, R: FloatArray, gyro_bias: FloatArray) -> FloatArray:
    """Attitudes by the images of a second and the gyro between them, shape (n, 3, 3).

    An image that shows the camera turned by an error shows it displaced by as much times the distance of the
    target. Taken as it is, the error of the attitude would look like a lever arm that reaches to the target.

    Args:
        buffer: Inertial readings.
        t_s: Instants, imu clock, s, shape (n,).
        R: Attitudes by single images, shape (n, 3, 3).
        gyro_bias: rad/s.
    """
    found = buffer.intervals(t_s)
    if found is None:
        return R
    segment, begin = found
    steps = over_intervals(strapdown(segment, gyro_bias[None], np.zeros((1, 3))), begin).dR
    turned = products(steps[None])[0]
    first = R @ np.swapaxes(turned, 1, 2)  # the attitude at the first instant, by each image
    mean = nearest_rotation(first.mean(axis=0))
    off = so3.log(first @ mean.T)
    near = np.abs(t_s[:, None] - t_s) <= _NEAR_S
    off = (near @ off) / near.sum(axis=1)[:, None]
    return np.asarray(so3.exp(off) @ mean @ turned)


def _poses_of_imu(
    poses: list[TargetPose], camera: CameraState
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Attitudes of the imu (n, 3, 3), positions of the camera (n, 3), their sigmas (n,), instants (n,)."""
    R = np.array([p.R_target_cam for p in poses]) @ camera.R_imu_cam.T
    p = np.array([p.p_target_cam for p in poses])
    sigma = np.maximum([s.sigma_m for s in poses], 5e-4)
    return R, p, sigma, np.array([s.t_cam_s for s in poses]) + camera.timeshift_s


def _attitude_sigma(poses: list[TargetPose], camera: CameraState) -> float:
    """Error to be expected of one attitude, rad."""
    return float(np.sqrt(np.mean(attitude_sigmas(poses, camera) ** 2)))


def _state_at(
    seen: TargetPose,
    camera: CameraState,
    linear: LinearStart,
    gyro_bias: FloatArray,
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
        gyro_bias.copy(),
        linear.accel_bias.copy(),
        gravity,
        cameras,
    )
