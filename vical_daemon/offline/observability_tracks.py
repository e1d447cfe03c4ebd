"""The motion of a recording without a board: from the windows of the target-free calibration."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from vical_daemon.config.priors import Initial
from vical_daemon.estimation.inertial.units import ImuArrays
from vical_daemon.estimation.measurements import ROWS
from vical_daemon.estimation.smoother.bundle import Fit
from vical_daemon.estimation.smoother.window import Window
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.tools.observability import Motion, Setup
from vical_daemon.logs import Recording
from vical_daemon.offline.calibrate import run_job
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.errors import InputError
from vical_daemon.offline.td_icp.sources import seconds

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]

MAX_SECONDS = 30.0
MAX_FRAMES = 150


def motion_without_board(
    recording: Recording, initial: Initial, camera: str, imu: str | None, blocks: frozenset[str]
) -> tuple[Motion, Setup, IntArray]:
    """Calibrate without a target, and take motion and points of the longest stretch (at most 30 s).

    Args:
        recording: Tracks or images, and an imu.
        initial: What is known of the lens.
        camera: Which.
        imu: Which; None: the only one.
        blocks: Further unknowns, see `Setup`.

    Returns:
        Motion, setup, and the samples of the motion at which images are taken.

    Raises:
        InputError: Nothing starts; the message says what is missing.
    """
    job = make_job(recording, initial, target=None, camera=camera, imu=imu)
    windows: list[tuple[Window, Fit]] = []
    outcome = run_job(job, lambda *_: None, closed=lambda window, fit: windows.append((window, fit)))
    estimate = outcome.estimate
    if camera not in estimate.cameras or not windows:
        why = estimate.reason or estimate.guidance or "too little data"
        raise InputError(f"the recording cannot be judged without a board: {why}")
    shift_ns = round(1e9 * estimate.cameras[camera].timeshift_cam_imu_s)
    return _rebuilt(_longest(windows), recording.imu_arrays(job.imu.name), shift_ns, blocks)


def _longest(windows: list[tuple[Window, Fit]]) -> list[tuple[Window, Fit]]:
    """The longest run of windows of which each begins where the one before ends, at most 30 s."""
    runs: list[list[tuple[Window, Fit]]] = []
    for window, fit in windows:
        begins, last = window.frames[0][0], runs[-1][-1][0].frames[-1][0] if runs else -np.inf
        if begins == last and window.frames[-1][0] - runs[-1][0][0].frames[0][0] <= MAX_SECONDS:
            runs[-1].append((window, fit))
        else:
            runs.append([(window, fit)])
    return max(runs, key=lambda run: run[-1][0].frames[-1][0] - run[0][0].frames[0][0])


def _rebuilt(
    run: list[tuple[Window, Fit]], imu: ImuArrays, shift_ns: int, blocks: frozenset[str]
) -> tuple[Motion, Setup, IntArray]:
    """Motion at the imu's readings, points in one world, and who saw what."""
    base_ns = run[0][0].frames[0][1].t_cam_ns + shift_ns
    t: list[float] = []
    R: list[FloatArray] = []
    p: list[FloatArray] = []
    points: list[FloatArray] = []
    seen: list[IntArray] = []
    origin, row_of = np.zeros(3), dict[int, int]()
    for number, (window, _) in enumerate(run):
        marks = window.landmarks
        places = marks.anchor + marks.bearing / np.maximum(marks.inverse, 1e-3)[:, None]
        for name, place in zip(marks.ids.tolist(), places + origin, strict=True):
            if name not in row_of:
                row_of[name] = len(points)
                points.append(place)
        first = min(number, 1)  # the image at which a window begins is the last of the one before
        for k in range(first, len(window.frames)):
            frame = window.frames[k][1]
            names = [i for i in frame.ids.tolist() if i in row_of and (frame.t_cam_ns, i) not in window.bad]
            seen.append(np.array([row_of[i] for i in names], np.intp))
            t.append((frame.t_cam_ns + shift_ns - base_ns) * 1e-9)
        R.append(window.R[first:])
        p.append(window.p[first:] + origin)
        origin = origin + window.p[-1]
    last, fit = run[-1]
    instants, gyro_bias = np.array(t), last.bias[-1, :3]
    motion = _motion(instants, np.concatenate(R), np.concatenate(p), imu, base_ns, gyro_bias)
    camera = last.camera
    chosen = np.flatnonzero((instants > motion.t_s[0]) & (instants < motion.t_s[-1]))
    if len(chosen) > MAX_FRAMES:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MAX_FRAMES).round().astype(np.intp)]
    frames = np.clip(np.searchsorted(motion.t_s, instants[chosen]), 0, len(motion.t_s) - 1)
    setup = Setup(
        camera.R_imu_cam,
        camera.p_imu_cam,
        camera.intrinsics,
        camera.distortion,
        np.array(points),
        camera.distortion_model,
        camera.resolution,
        estimate=blocks,
        corner_sigma_px=max(fit.noise.sigma_px * fit.noise.spread, 0.05),
        seen=tuple(seen[k] for k in chosen),
        readout_axis=camera.readout_axis or ROWS,
    )
    return motion, setup, frames


def _motion(
    t: FloatArray, R: FloatArray, p: FloatArray, imu: ImuArrays, base_ns: int, gyro_bias: FloatArray
) -> Motion:
    """The motion between images: attitude by the gyro from the middle one, position by a spline."""
    t_imu = seconds(imu.t_ns, base_ns)
    fresh = np.concatenate(([True], np.diff(t_imu) > 1e-6))
    curve = GyroCurve.integrate(t_imu[fresh], imu.gyro_rps[fresh], gyro_bias)
    middle = len(t) // 2
    R_world_ref = R[middle] @ curve.at(t[middle : middle + 1])[0][0].T
    used = fresh & (t_imu >= t[0]) & (t_imu <= t[-1])
    times, path = t_imu[used], CubicSpline(t, p)
    return Motion(
        times,
        np.asarray(R_world_ref @ curve.at(times)[0], dtype=np.float64),
        np.asarray(path(times), dtype=np.float64),
        np.asarray(path(times, 1), dtype=np.float64),
        imu.gyro_rps[used] - gyro_bias,
        imu.specific_force_mps2[used],
    )
