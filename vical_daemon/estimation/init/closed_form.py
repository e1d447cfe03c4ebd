"""One attempt to start from what was seen so far: a state that the filter can begin with, or why not.

Mounting and delay come from rotations (TD-ICP); where the motion turns too little for that, and only then,
from accelerations (`accel_alignment`), as a *partial* start: some of it stays unknown, and sigmas say so.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.accel_alignment import (
    Alignment,
    CameraPath,
    align,
    align_at,
)
from vical_daemon.estimation.init.attempts import LONG_S
from vical_daemon.estimation.init.camera_start import camera_by_rotations, not_sure_yet, starting_camera
from vical_daemon.estimation.init.linear_start import still_axes
from vical_daemon.estimation.init.numbering import numbered_differently
from vical_daemon.estimation.init.readout_start import (
    at_middle_row,
    lens_fit,
    likely_axis,
    looks_rolling,
    readout,
)
from vical_daemon.estimation.init.spacing_ratio import spacing_ratio, stretched
from vical_daemon.estimation.init.target_poses import TargetPose, attitude_sigmas, poses_of, usable_poses
from vical_daemon.estimation.init.velocity_gravity_init import RotationsKnown, StartResult, motion_start
from vical_daemon.estimation.measurements import (
    CalibrationOptions,
    CameraPrior,
    FloatArray,
    Frames,
    PointsFrame,
)
from vical_daemon.estimation.model.priors import LONG_SHIFT_SIGMA_S, ROTATION_SIGMA_RAD, SHIFT_SIGMA_S
from vical_daemon.estimation.model.state import CameraState, Layout
from vical_daemon.estimation.significance import SURE_SIGMAS, chi_square_limit
from vical_daemon.estimation.temporal.td_icp import DOUBTFUL_RAD, td_icp
from vical_daemon.estimation.temporal.td_icp_input import MIN_ORIENTATIONS, TdIcpOptions
from vical_daemon.estimation.temporal.td_icp_refusals import is_constant_rotation
from vical_daemon.estimation.temporal.td_icp_result import TdIcpResult

PARTIAL_S = 6.0  # before, a second axis may come yet
_PARTIAL_SHIFTS_S = (-1.0, 1.0)  # time shifts searched about the one axis that the rig has turned about


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
        may_resize: Another size of the target may be suggested.
        look: For rolling shutters of which nothing was said.
    """

    buffer: ImuBuffer
    frames: dict[str, Frames]
    priors: dict[str, CameraPrior]
    options: CalibrationOptions
    layout: Layout
    target: FloatArray
    may_resize: bool = True
    look: bool = True


class Seen(NamedTuple):
    """What one camera has seen: its lens, as known or estimated, images without the readout, and poses."""

    lens: CameraState
    frames: Frames
    poses: list[TargetPose]


def attempt(data: StartData, *, may_be_partial: bool) -> StartResult:
    """Try to start with everything known; where motion is missing, with guesses if these are welcome.

    Returns:
        A state at the first usable frame, or the reason why not.
    """
    seen: dict[str, Seen] = {}
    for name in data.priors:
        found, axis, ratio = _seen(data, name)
        if axis or ratio != 1.0:
            return StartResult(None, "", rolling=(name, axis) if axis else None, ratio=ratio)
        seen[name] = found
    result = _complete(data, seen)
    if result.state is None and result.size is None and result.motion_missing and may_be_partial:
        return _partial(data, seen, result.reason)
    return result


def _complete(data: StartData, seen: dict[str, Seen]) -> StartResult:
    """A start with everything known, or the reason why not."""
    rough: dict[str, RotationsKnown] = {}
    for name, (lens, frames, poses) in seen.items():
        if len(poses) < MIN_ORIENTATIONS:
            return StartResult(None, f"{name}: {_too_few_poses(len(poses), len(frames))}")
        found, why = _timing(data.buffer, poses, lens)
        if why:
            held = not data.layout.lens_free(name)
            other = other_lens(frames, lens, data.target) if held else None
            if other is not None and _starts(data, frames, other):
                return StartResult(None, f"{name}: {blamed(lens, other)}")
            return StartResult(None, f"{name}: {why}{_poorly_seen(poses, lens)}", motion_missing=True)
        camera = camera_by_rotations(
            lens, data.priors[name], data.options.fix, found.R_imu_cam, found.timeshift_cam_imu_s
        )
        rough[name] = RotationsKnown(camera, poses, found.gyro_bias_rps)
    turned = numbered_differently(rough)
    if turned is not None:
        return StartResult(None, str(turned), half_turned=turned.other if turned.half else "")
    return motion_start(data.buffer, rough, data.options, may_resize=data.may_resize)


def _too_few_poses(poses: int, images: int) -> str:
    """Why so few of the images that show the target show its pose, and what to do."""
    if images < MIN_ORIENTATIONS:
        return f"the target is seen in {images} frames so far: show the whole board"
    return (
        f"only {poses} of {images} frames show how the target is turned: show the whole board, "
        "come closer, so that it fills the image, and avoid blur"
    )


def _poorly_seen(poses: list[TargetPose], lens: CameraState) -> str:
    """What makes a start by rotations hard besides the motion: a target far away, or blurred; or empty."""
    known_rad = float(np.median(attitude_sigmas(poses, lens)))
    if known_rad < DOUBTFUL_RAD:
        return ""
    return (
        f". Orientations of the target are known to {np.rad2deg(known_rad):.1f} deg: come closer, "
        "so that it fills the image, and avoid blur"
    )


def _partial(data: StartData, seen: dict[str, Seen], reason: str) -> StartResult:
    """Try to start where rotations alone do not show the mounting: accelerations may.

    Args:
        data: See `StartData`.
        seen: By camera.
        reason: Why there is no complete start; it stays true, whatever is found here.

    Returns:
        A state that is a guess where the motion shows nothing, or the reason again.
    """
    rough: dict[str, RotationsKnown] = {}
    turn_axis_cam: FloatArray | None = None
    refused = StartResult(None, reason, motion_missing=True)
    for name, (lens, _, known) in seen.items():
        since_s = data.frames[name][-1][0] - LONG_S
        poses = [p for p in known if p.t_cam_s > since_s]
        if not poses or poses[-1].t_cam_s - poses[0].t_cam_s < PARTIAL_S:
            return refused
        path = CameraPath(
            np.array([p.t_cam_s for p in poses]),
            np.array([p.R_target_cam for p in poses]),
            np.array([p.p_target_cam for p in poses]),
            np.maximum([p.sigma_m for p in poses], 2e-4),
            attitude_sigmas(poses, lens),
        )
        found = align(path, data.buffer.rows, _PARTIAL_SHIFTS_S)
        if found is not None and not found.trusted and len(data.priors) == 1:
            found, turn_axis_cam = _steady(data, name, path)
        if found is None or not found.trusted:
            return refused
        camera = camera_by_rotations(
            lens, data.priors[name], data.options.fix, found.R_imu_cam, found.timeshift_s
        )
        rough[name] = RotationsKnown(camera, poses, found.gyro_bias_rps)
    result = motion_start(data.buffer, rough, data.options, True, turn_axis_cam)
    return refused if result.state is None else replace(result, reason=reason)


def _steady(data: StartData, name: str, path: CameraPath) -> tuple[Alignment | None, FloatArray | None]:
    """For a rig that turns at one rate about one axis: a mounting with the delay as given; the axis, camera.

    Which way gravity points is not known either, so the angle about that axis is as unknown as the delay.
    """
    shift_s = data.priors[name].timeshift_cam_imu_s or 0.0
    rows = data.buffer.rows
    during = (rows[:, 0] > path.t_cam_s[0] + shift_s) & (rows[:, 0] < path.t_cam_s[-1] + shift_s)
    if np.count_nonzero(during) < 100 or not is_constant_rotation(rows[during, 0], rows[during, 1:4]):
        return None, None
    axes = still_axes(path.R_target_cam.mean(axis=0))
    return (align_at(path, rows, shift_s, axes[0]), axes[0]) if len(axes) == 1 else (None, None)


def _seen(data: StartData, name: str) -> tuple[Seen, str, float]:
    """What a camera has seen, and what was not said: which way its shutter rolls, the target's `ratio`.

    Empty: it does not roll. 1: columns and rows of the target are as stated.
    """
    prior, given, target = data.priors[name], data.frames[name], data.target
    lens, readout_s = starting_camera(prior), prior.readout_s
    estimated = data.layout.cameras[name].readout is not None
    if estimated:
        if not (lens.readout_axis or readout_s):
            lens.readout_axis = likely_axis(given, lens, target)
        readout_s = readout(given, lens, target, readout_s)
    free, look, axis = data.layout.lens_free(name), data.look and not (estimated or readout_s), ""
    ratio = 1.0
    fit = lens_fit(given, lens, target, readout_s) if free or data.look else None
    if data.look and (ratio := spacing_ratio(given, lens, target, fit, readout_s)) != 1.0:
        target = stretched(target, ratio)
        fit = lens_fit(given, lens, target, readout_s)
    if fit is not None and look:
        axis = looks_rolling(given, lens, target, fit)
    if fit is not None and free:
        fit.take_into(lens)
    lens.readout_s = readout_s
    frames = at_middle_row(given, readout_s, lens.resolution, lens.readout_axis)
    poses = [] if axis or ratio != 1.0 else usable_poses(frames, lens, target)
    return Seen(lens, frames, poses), axis, ratio


def _starts(data: StartData, frames: Frames, lens: CameraState) -> bool:
    """Whether rotations would be enough for a start if a camera had this lens."""
    poses = usable_poses(frames, lens, data.target)
    return len(poses) >= MIN_ORIENTATIONS and not _timing(data.buffer, poses, lens)[1]


def _timing(buffer: ImuBuffer, poses: list[TargetPose], lens: CameraState) -> tuple[TdIcpResult, str]:
    """What rotations show, and why that is not enough for a start, in words; empty: it is."""
    rows = buffer.rows
    found = td_icp(
        rows[:, 0],
        rows[:, 1:4],
        np.array([p.t_cam_s for p in poses]),
        np.array([p.R_target_cam for p in poses]),
        attitude_sigmas(poses, lens),
        TdIcpOptions(lost_s=np.inf),  # a start has its own limit
    )
    long = poses[-1].t_cam_s - poses[0].t_cam_s > LONG_S
    return found, found.reason or not_sure_yet(
        found.timeshift_sigma_s,
        float(np.max(found.rotation_sigma_rad)),
        LONG_SHIFT_SIGMA_S if long else SHIFT_SIGMA_S,
        ROTATION_SIGMA_RAD,
    )


def blamed(held: CameraState, other: CameraState) -> str:
    """Say that a fixed lens is why there is no start; `other`: the camera with a lens that fits."""
    return (
        f"the fixed lens (fx {held.intrinsics[0]:.0f} px) is not this camera's: with fx "
        f"{other.intrinsics[0]:.0f} px and its own distortion images and gyro agree; "
        "correct it, or let vical estimate it"
    )


def other_lens(frames: Frames, held: CameraState, target: FloatArray) -> CameraState | None:
    """Return a camera with a lens that fits images surely better than the fixed one; None: there is none.

    Args:
        frames: (stamp in s, points), in order, as a global shutter sees them.
        held: The camera with the lens that is fixed.
        target: Points of the target, m, shape (n, 3).
    """
    fit = lens_fit(frames, held, target)
    if fit is None:
        return None
    gain = _squares(fit.views, held, target) - fit.squares
    if not gain > chi_square_limit(len(fit.theta), SURE_SIGMAS) * fit.corner_sigma_px**2:
        return None
    camera = copy(held)
    fit.take_into(camera)
    return camera


def _squares(views: list[PointsFrame], lens: CameraState, target: FloatArray) -> float:
    """Sum of the squared distances of points from where a lens projects them with the best poses, px^2.

    A view that shows no pose with this lens does not count: the sum is rather too small.
    """
    total = 0.0
    for view, found in zip(views, poses_of([(0.0, v) for v in views], lens, target), strict=True):
        if found is not None:
            x = target[view.ids] @ found.pose.R_cam_target.T + found.pose.p_cam_target
            uv_px = project_jacobians(x, lens.intrinsics, lens.distortion, lens.distortion_model)[0]
            total += float(((view.uv_px - uv_px) ** 2).sum())
    return total
