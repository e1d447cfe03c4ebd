"""The motion of a recording: attitude from the gyro, position from the board, or from tracks without one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from vical_daemon.config.priors import Initial
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.temporal.camera_orientations import Orientations
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions
from vical_daemon.estimation.temporal.td_icp_result import REFUSED, TdIcpResult
from vical_daemon.estimation.tools.observability import Motion, Setup
from vical_daemon.logs import ImuArrays, Recording, meant, open_recording
from vical_daemon.logs.checks import check_imu
from vical_daemon.offline.errors import InputError, OptionError, Warn, ignore
from vical_daemon.offline.observability_tracks import MAX_FRAMES, MAX_SECONDS, motion_without_board
from vical_daemon.offline.td_icp.gyro_unit import with_unit_named
from vical_daemon.offline.td_icp.own_clock import placed
from vical_daemon.offline.td_icp.request import choose_gyro, prior_of
from vical_daemon.offline.td_icp.sources import board_poses, lens_of, seconds

FloatArray = npt.NDArray[np.float64]

_HOLE_S = 0.35


def motion_of(
    path: str,
    blocks: frozenset[str],
    *,
    target: str | None,
    initial: Initial,
    camera: str | None = None,
    imu: str | None = None,
    warn: Warn = ignore,
) -> tuple[Motion, Setup, npt.NDArray[np.intp]]:
    """Rebuild the motion of the longest stretch (at most 30 s) in which the board, or tracks, stay in view.

    Args:
        path: Recording.
        blocks: Further unknowns, see `Setup`.
        target: Target file; None: the points are unknown, see `motion_without_board`.
        initial: What is known of the lens and the mounting.
        camera: Which, where there are several.
        imu: Which, where there are several.
        warn: Takes what is unusual.

    Raises:
        InputError: No imu, no motion to work with, or no calibration without a board.
    """
    recording = open_recording(path, cameras=[camera] if camera else (), check=False)
    for warning in recording.warnings:
        warn(warning)
    cameras = recording.cameras
    name = meant(cameras, camera) if camera else next(iter(cameras), None)
    if name is None or name not in cameras or (camera is None and len(cameras) > 1):
        raise OptionError(
            f"choose one camera of {recording.path} with --camera: {', '.join(cameras) or 'there is none'}"
        )
    stream, prior = cameras[name], prior_of(initial, name)
    readings = _readings(recording, imu)
    if target is None and stream.kind != "points":
        return motion_without_board(recording, initial, name, imu, blocks)
    if stream.kind == "tracks":
        raise InputError(f"{name} holds tracks of unknown points: leave out --target")
    lens = lens_of(stream, prior)
    stream = placed(recording, choose_gyro(recording, imu)[0], stream, prior, target, warn)
    poses, fit = board_poses(recording, stream, lens, target, warn)
    gyro, force = readings.gyro_rps, readings.specific_force_mps2
    base = int(readings.t_ns[0])
    t_imu, t_cam = seconds(readings.t_ns, base), seconds(poses.t_cam_ns, base)
    fresh = np.concatenate(([True], np.diff(t_imu) > 1e-6))
    t_imu, gyro, force = t_imu[fresh], gyro[fresh], force[fresh]
    result = td_icp(t_imu, gyro, t_cam, poses.R_world_cam, poses.covariance, TdIcpOptions())
    if result.status == REFUSED:
        result = with_unit_named(result, readings, t_cam, poses.R_world_cam)
        result = _without_motion(poses, result)
    p_imu_cam = np.zeros(3)
    if prior is not None and prior.T_imu_cam is not None:
        p_imu_cam = prior.T_imu_cam[1]
    motion, frames = _rebuild(
        t_imu, gyro, force, t_cam + result.timeshift_cam_imu_s, poses, result, p_imu_cam
    )
    assert target is not None  # or there were no poses
    corner_px = 0.5 if fit is None else fit.corner_sigma_px
    return motion, _setup(lens, corner_px, result, p_imu_cam, blocks, target), frames


def _readings(recording: Recording, imu: str | None) -> ImuArrays:
    """Return the readings of the imu that is meant, whose units and rate are plausible."""
    name, _, _ = choose_gyro(recording, imu)
    readings = recording.imu_arrays(name)
    check_imu(name, readings, recording.set_back.get(name))
    return readings


def _without_motion(poses: Orientations, result: TdIcpResult) -> TdIcpResult:
    """A rig that stands still has an observability too (a poor one); anything else is an error."""
    if not result.still or len(poses.t_cam_ns) < 12:
        raise InputError(f"the recording cannot be judged: {result.reason}")
    used = np.ones(len(poses.t_cam_ns), dtype=np.bool_)
    return TdIcpResult(
        "degenerate",
        result.reason,
        0.0,
        0.0,
        np.eye(3),
        gyro_bias_rps=np.zeros(3),
        pairs=len(used),
        used=used,
    )


def _rebuild(
    t_imu: FloatArray,
    gyro: FloatArray,
    force: FloatArray,
    t_frame: FloatArray,
    poses: Orientations,
    result: TdIcpResult,
    p_imu_cam: FloatArray,
) -> tuple[Motion, npt.NDArray[np.intp]]:
    inside = np.flatnonzero(result.used & (t_frame > t_imu[0]) & (t_frame < t_imu[-1]))
    stretch = _longest(t_frame[inside])
    index = inside[stretch]
    if len(index) < 12:
        raise InputError("the board is never in view for long enough")
    t = t_frame[index]
    use = (t_imu >= t[0]) & (t_imu <= t[-1])
    curve = GyroCurve.integrate(t_imu, gyro, result.gyro_bias_rps)
    middle = len(index) // 2
    R_ref_imu = curve.at(t)[0]
    R_world_ref = poses.R_world_cam[index[middle]] @ (R_ref_imu[middle] @ result.R_imu_cam).T
    p_world_imu = poses.p_world_cam[index] - (R_world_ref @ R_ref_imu) @ p_imu_cam
    path = CubicSpline(t, p_world_imu)
    times = t_imu[use]
    motion = Motion(
        times,
        np.asarray(R_world_ref @ curve.at(times)[0], dtype=np.float64),
        np.asarray(path(times), dtype=np.float64),
        np.asarray(path(times, 1), dtype=np.float64),
        gyro[use] - result.gyro_bias_rps,
        force[use],
    )
    frames = np.unique(np.clip(np.searchsorted(times, t), 1, len(times) - 2))
    if len(frames) > MAX_FRAMES:
        frames = frames[np.linspace(0, len(frames) - 1, MAX_FRAMES).round().astype(int)]
    return motion, frames


def _longest(t: FloatArray) -> slice:
    """The longest run without a hole, cut to 30 s around its middle."""
    breaks = np.flatnonzero(np.diff(t) > _HOLE_S) + 1
    edges = np.concatenate(([0], breaks, [len(t)]))
    if not len(t):
        return slice(0, 0)
    longest = int(np.argmax([t[b - 1] - t[a] for a, b in pairwise(edges)]))
    a, b = int(edges[longest]), int(edges[longest + 1])
    centre = 0.5 * (t[a] + t[b - 1])
    inside = np.flatnonzero(np.abs(t[a:b] - centre) <= MAX_SECONDS / 2)
    return slice(a + int(inside[0]), a + int(inside[-1]) + 1)


def _setup(
    lens: CameraState,
    corner_sigma_px: float,
    result: TdIcpResult,
    p_imu_cam: FloatArray,
    blocks: frozenset[str],
    target: str,
) -> Setup:
    from pathlib import Path

    from vical_daemon.vision.target import load_target

    return Setup(
        result.R_imu_cam,
        p_imu_cam,
        lens.intrinsics,
        lens.distortion,
        load_target(Path(target)).points_m,
        model=lens.distortion_model,
        resolution=lens.resolution,
        estimate=blocks,
        corner_sigma_px=max(corner_sigma_px, 0.05),
    )
