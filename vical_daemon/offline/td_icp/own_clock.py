"""Where the zero of a video lies in the IMU's stamps: the rotations of both show it.

A video counts from its own zero, and an IMU from 1970, from its start, or from that of a computer. So every
delay at which both overlap is looked at, not just some seconds.
"""

from __future__ import annotations

from dataclasses import replace

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CameraPrior, FloatArray, PointsFrame
from vical_daemon.estimation.temporal.rotation_start import GyroReference
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions, clean_gyro
from vical_daemon.estimation.temporal.td_icp_result import REFUSED, TdIcpResult
from vical_daemon.estimation.temporal.track_registration import track_registration
from vical_daemon.logs import Recording, Stream, check_camera
from vical_daemon.offline.errors import InputError, Warn, ignore
from vical_daemon.offline.td_icp.gyro_unit import with_unit_named
from vical_daemon.offline.td_icp.sources import board_poses, image_of, lens_of, seconds

_EVERY_S = 0.1  # of the images: turns are compared over 0.2 s and more (`rotation_turns.BASELINES_S`)
_MARGIN_S = 5.0  # readings used about the video, s
_LOOKED_AT_S = 60.0  # of features, together: three windows of `track_registration`
_ROUNDED_NS = 1_000_000  # a figure that people can copy; the rest stays in the time shift


def placed(
    recording: Recording,
    imu: str,
    stream: Stream,
    prior: CameraPrior | None,
    target: str | None,
    warn: Warn = ignore,
) -> Stream:
    """Bring the stamps of a video to the clock of the IMU, to a few ms, and say so.

    Args:
        recording: Of the camera; its stamps are moved if it is in `Recording.unplaced`.
        imu: Name of the IMU.
        stream: The camera.
        prior: What is known about its lens; None: nothing.
        target: Target file; None: rotations are taken from features.
        warn: Takes what was found.

    Returns:
        The camera with its new stamps.

    Raises:
        InputError: The rotations show no place.
    """
    if stream.name not in recording.unplaced:
        return stream
    readings = recording.imu_arrays(imu)
    base_ns = int(readings.t_ns[0])
    t_imu_s = seconds(readings.t_ns, base_ns)
    begin_s, end_s = ((t - base_ns) * 1e-9 for t in (stream.begin_ns, stream.end_ns))
    low_s, high_s = -end_s, float(t_imu_s[-1]) - begin_s
    options = TdIcpOptions(
        search_s=0.5 * (high_s - low_s), timeshift_guess_s=0.5 * (low_s + high_s), gyro_log_sigma=0.7
    )
    if target is None:
        found = _by_features(recording, stream, prior, (t_imu_s, readings.gyro_rps), options, base_ns)
        found = with_unit_named(found, readings) if found.status == REFUSED else found
    else:
        poses, _ = board_poses(recording, stream, lens_of(stream, prior), target, every_s=_EVERY_S)
        t_cam_s, R = seconds(poses.t_cam_ns, base_ns), poses.R_world_cam
        found = _by_a_board((t_imu_s, readings.gyro_rps), (t_cam_s, R, poses.covariance), options)
        found = with_unit_named(found, readings, t_cam_s, R) if found.status == REFUSED else found
    if found.status == REFUSED:
        raise InputError(
            f"{stream.name}: when {stream.source} begins in the IMU's recording is not found: {found.reason}"
        )
    recording.place(stream.name, round(found.timeshift_cam_imu_s * 1e9 / _ROUNDED_NS) * _ROUNDED_NS)
    added_s = recording.added_ns[stream.name] * 1e-9
    moved = recording.cameras[stream.name]
    found_out = [
        f"{stream.name}: {stream.source} counts from its own zero; its rotations fit the gyro's if "
        f"{added_s:.3f} s is added to its stamps",
        *check_camera(moved, [recording.imus[imu]]),
    ]
    recording.warnings += found_out
    for text in found_out:
        warn(text)
    return moved


def _by_a_board(
    gyro: tuple[FloatArray, FloatArray],
    poses: tuple[FloatArray, FloatArray, FloatArray],
    options: TdIcpOptions,
) -> TdIcpResult:
    """Register poses with the readings about the place that fits best; the others say why if that fails.

    Of half an hour at 200 Hz all readings would take 310 MB and twice the time.
    """
    cleaned, (t_cam_s, R, _) = clean_gyro(*gyro), poses
    if isinstance(cleaned, str):
        return TdIcpResult(REFUSED, cleaned)
    t_s, rates = cleaned
    reach = (options.timeshift_guess_s - options.search_s, options.timeshift_guess_s + options.search_s)
    start, _ = GyroReference(t_s, rates).start(t_cam_s, so3.quat_from_matrix(R), reach)
    if start is not None:
        begin_s, end_s = (t + start.timeshift_s for t in (t_cam_s[0] - _MARGIN_S, t_cam_s[-1] + _MARGIN_S))
        near = (t_s >= begin_s) & (t_s <= end_s)
        about = replace(options, timeshift_guess_s=start.timeshift_s, search_s=0.2 * _MARGIN_S)
        found = td_icp(t_s[near], rates[near], *poses, about)
        if found.status != REFUSED:
            return found
    return td_icp(t_s, rates, *poses, options)


def _by_features(
    recording: Recording,
    stream: Stream,
    prior: CameraPrior | None,
    gyro: tuple[FloatArray, FloatArray],
    options: TdIcpOptions,
    base_ns: int,
) -> TdIcpResult:
    """Register features of the first minute in which the camera moves."""
    from vical_daemon.vision.tracks import FeatureTracker

    lens = lens_of(stream, prior)
    known = (lens.intrinsics, lens.distortion, lens.distortion_model)
    tracker, frames = FeatureTracker(), list[tuple[float, PointsFrame]]()
    for _, payload in recording.messages([stream]):
        stamp_ns, image = image_of(payload, stream.kind)
        seen = tracker.detect(image, stamp_ns)
        if seen is not None:
            frame = PointsFrame(stream.name, stamp_ns, seen.ids, seen.uv_px, seen.sigma_px)
            frames.append(((stamp_ns - base_ns) * 1e-9, frame))
        if frames and frames[-1][0] - frames[0][0] > _LOOKED_AT_S:
            found = track_registration(*gyro, frames, known, options)
            if found.status != REFUSED:
                return found
            frames = []
    return track_registration(*gyro, frames, known, options)
