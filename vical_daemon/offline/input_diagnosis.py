"""Why `vical calibrate` found nothing: the usual mistakes in the input are tried out."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.init.accelerometer_check import explain_accelerometer
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_result import REFUSED, TdIcpResult
from vical_daemon.logs import Stream
from vical_daemon.offline.calibrate import run_job
from vical_daemon.offline.calibration_job import Job
from vical_daemon.offline.errors import InputError
from vical_daemon.offline.td_icp.gyro_unit import with_unit_named
from vical_daemon.offline.td_icp.sources import board_poses, lens_of, seconds

_LOOKS = 40  # images that are looked at for another board; each takes 0.1 to 0.2 s
_CERTAIN = 5.0  # sigmas
_MOUNTED_RAD, _SHIFTED_S = 0.03, 2e-3
"""What a start corrects or tolerates beside them: about 2 deg, 2 ms."""
_NEGATED = (
    "the accelerometer reports gravity instead of specific force (with its opposite sign there is a "
    "calibration): negate all three of its axes"
)
_TRIED_S = 30.0  # of a recording, with the opposite sign; a start needs some ten seconds
_LEAST_HZ = 5.0
"""Images a second without a target, as TD-ICP needs them; with a moving hand 4 started, 3 did not."""


def diagnose_input(job: Job) -> str:
    """Name a mistake that explains why there is no calibration, in one line; empty where none does.

    Rotations first (a mirrored gyro, stamps at different rates), then the accelerometer's signs and axes.
    """
    if job.config.target is None:
        return _too_few_images(job) or _negated(job)
    from vical_daemon.vision.target import AprilGrid, load_target

    target = load_target(Path(job.config.target))
    imu = job.recording.imu_arrays(job.imu.name)
    t_imu_s = seconds(imu.t_ns, int(imu.t_ns[0]))
    for name, stream in job.cameras.items():
        prior = job.priors[name]
        if board := _another_board(job, name, stream):
            return board
        try:
            lens = lens_of(stream, prior)
            poses, _ = board_poses(job.recording, stream, lens, job.config.target)
        except InputError as error:
            return str(error)
        t_cam_s = seconds(poses.t_cam_ns, int(imu.t_ns[0]))
        found = td_icp(t_imu_s, imu.gyro_rps, t_cam_s, poses.R_world_cam, poses.covariance)
        found = with_unit_named(found, imu, t_cam_s, poses.R_world_cam)
        if found.status == REFUSED:
            return f"{name}: {found.reason}"
        if held := _wrong_held_value(job, prior, found):
            return f"{name}: {held}"
        mistake = explain_accelerometer(
            t_imu_s,
            imu.specific_force_mps2,
            np.asarray(t_cam_s + found.timeshift_cam_imu_s),
            poses.R_world_cam,
            poses.p_world_cam,
            found.R_imu_cam,
            front_is_up=True if isinstance(target, AprilGrid) else None,
        )
        if mistake:
            return f"{name}: {mistake}"
    return ""


def _too_few_images(job: Job) -> str:
    """Name a camera that is too slow for a calibration without a target."""
    for name, stream in job.cameras.items():
        if stream.rate_hz < _LEAST_HZ:
            return (
                f"{name}: its images come at {stream.rate_hz:.3g} Hz, too slowly to follow features from one "
                f"to the next: without a target {_LEAST_HZ:g} Hz are needed, better 10; record faster, or "
                "show a target and give --target"
            )
    return ""


def _negated(job: Job) -> str:
    """Say that only the negated accelerometer gives a calibration; a part of the data shows it."""
    part_s = min(job.duration_s, _TRIED_S)
    tried = replace(job, seconds=part_s, others=[], negate_force=True)
    estimate = run_job(tried, lambda *_: None, enough=lambda found: bool(found.cameras)).estimate
    return f"{job.imu.name}: {_NEGATED}" if estimate.cameras else ""


def _another_board(job: Job, name: str, stream: Stream) -> str:
    """Name the board that images show if it is not that of the target file."""
    from vical_daemon.offline.td_icp.sources import image_of
    from vical_daemon.vision.detection import as_gray
    from vical_daemon.vision.target import load_target
    from vical_daemon.vision.target_check import contradiction

    if stream.kind not in ("image", "compressed"):
        return ""
    target, every = load_target(Path(str(job.config.target))), max(stream.count // _LOOKS, 1)
    seen: Counter[str] = Counter()
    for number, (_, payload) in enumerate(job.recording.messages([stream])):
        if number % every:
            continue
        try:
            _, image = image_of(payload, stream.kind)
            text = contradiction(as_gray(image), target, number // every)
        except ValueError:  # damaged
            continue
        seen.update([text] if text is not None else [])
        if seen[""]:
            return ""
    often = [text for text, count in seen.most_common(1) if count > 1]
    return f"{name}: {often[0]}" if often else ""


def _wrong_held_value(job: Job, prior: CameraPrior, found: TdIcpResult) -> str:
    """Say that a value held by --fix is far from what the rotations show."""
    fix = job.config.calibration.fix
    if "extrinsics" in fix and prior.T_imu_cam is not None:
        given = prior.T_imu_cam[0]
        limit = _CERTAIN * float(found.rotation_sigma_rad.max()) + _MOUNTED_RAD
        turn = Rotation.from_matrix(given.T @ found.R_imu_cam)
        if turn.magnitude() > limit:
            if Rotation.from_matrix(given @ found.R_imu_cam).magnitude() < limit:
                hint = "; its inverse fits: T_cam_imu maps from the imu to the camera"
            else:
                x, y, z = np.abs(turn.as_rotvec(degrees=True))
                hint = f" (by {x:.0f}, {y:.0f}, {z:.0f} deg about the camera's x, y, z)"
            angle = np.rad2deg(turn.magnitude())
            return (
                f"the mounting held by --fix extrinsics is {angle:.0f} deg from what rotations show{hint}; "
                "correct it, or let vical estimate it"
            )
    shift_s, sigma_s = found.timeshift_cam_imu_s, found.timeshift_sigma_s
    given_s = prior.timeshift_cam_imu_s
    if (
        "timeshift" in fix
        and given_s is not None
        and abs(given_s - shift_s) > _CERTAIN * sigma_s + _SHIFTED_S
    ):
        other = " (is its sign reversed?)" if abs(given_s + shift_s) < _CERTAIN * sigma_s + _SHIFTED_S else ""
        return (
            f"the time shift held by --fix timeshift is {1e3 * given_s:.1f} ms, rotations show "
            f"{1e3 * shift_s:.1f} ± {1e3 * sigma_s:.1f} ms{other}; correct it, or let vical estimate it"
        )
    return ""
