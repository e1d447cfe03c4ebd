"""Why `vical calibrate` found nothing: the usual mistakes in the input are tried out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vical_daemon.estimation.init.accelerometer_check import explain_accelerometer
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_result import REFUSED
from vical_daemon.offline.calibration_job import Job
from vical_daemon.offline.errors import InputError
from vical_daemon.offline.td_icp.sources import board_poses, lens_of, seconds


def diagnose_input(job: Job) -> str:
    """Name a mistake that explains why there is no calibration, in one line; empty where none does.

    Rotations first (a mirrored gyro, stamps at different rates), then the accelerometer's signs and axes.
    """
    if job.config.target is None:
        return ""
    from vical_daemon.vision.target import AprilGrid, load_target

    target = load_target(Path(job.config.target))
    imu = job.recording.imu_arrays(job.imu.name)
    t_imu_s = seconds(imu.t_ns, int(imu.t_ns[0]))
    for name, stream in job.cameras.items():
        prior = job.priors[name]
        try:
            lens = lens_of(stream, prior)
            poses, _ = board_poses(job.recording, stream, lens, job.config.target)
        except InputError as error:
            return str(error)
        t_cam_s = seconds(poses.t_cam_ns, int(imu.t_ns[0]))
        found = td_icp(t_imu_s, imu.gyro_rps, t_cam_s, poses.R_world_cam, poses.covariance)
        if found.status == REFUSED:
            return f"{name}: {found.reason}"
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
