"""Temporal calibration from tracks of unknown points: the epipolar constraint with the gyro's rotation.

Rotations strung together from pairs of images are only good for a start; from there mounting, delay and gyro
bias are fitted to the tracks themselves (`epipolar_fit`), in windows of the recording. Their covariances know
errors that persist along tracks (`epipolar_errors`) and the gyro's noise; what they do not know shows in how
stretches of five seconds scatter (`stretch_agreement`).
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import IMAGE_GAP_S, FloatArray, Frames
from vical_daemon.estimation.significance import STRETCH_S
from vical_daemon.estimation.temporal.epipolar_fit import EpipolarFit, epipolar_fit
from vical_daemon.estimation.temporal.stretch_agreement import STRETCHES, scatter_factors
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions, clean_gyro
from vical_daemon.estimation.temporal.td_icp_refusals import lost_in_words
from vical_daemon.estimation.temporal.td_icp_result import DEGENERATE, OK, REFUSED, TdIcpResult
from vical_daemon.estimation.temporal.track_orientations import track_orientations

Lens = tuple[FloatArray, FloatArray, str]

_WINDOW_S = 20.0  # of a fit: a gyro's bias is constant over it
_WANTED = [0, 1, 2, 6]  # mounting and delay among the unknowns of a result
_INLIERS = 0.5  # share of the feature pairs that must fit


def track_registration(
    t_imu_s: FloatArray, gyro_rps: FloatArray, frames: Frames, lens: Lens, options: TdIcpOptions | None = None
) -> TdIcpResult:
    """Find delay, mounting and gyro bias from a gyro and tracks.

    Args:
        t_imu_s: Stamps of the gyro, s, shape (m,).
        gyro_rps: Rates in the imu frame, rad/s, shape (m, 3).
        frames: (stamp in the camera's clock in s, tracks), in order of time; an id names the same point.
        lens: fx fy cx cy, distortion, model.
        options: As for `td_icp`.

    Returns:
        As `td_icp`; `pairs` counts images. Never raises on data.
    """
    imu = clean_gyro(t_imu_s, gyro_rps)
    if isinstance(imu, str):
        return TdIcpResult(REFUSED, imu, rejected=len(frames))
    windows = _windows(frames)
    if not windows:
        reason = f"the tracks cover less than {STRETCH_S:g} s without a hole"
        return TdIcpResult(REFUSED, reason, rejected=len(frames))
    options = options or TdIcpOptions()
    start = _start(imu, windows, lens, options)
    if start.status == REFUSED:
        return start
    fits: list[tuple[int, EpipolarFit]] = []
    for window in windows:
        t, gyro = _near(imu, window, start.timeshift_cam_imu_s)
        fit = None
        if len(t) > 100:
            fit = epipolar_fit(
                t, gyro, window, lens, start.R_imu_cam, start.timeshift_cam_imu_s,
                fit_lens=True, gyro_density=options.gyro_density,
            )  # fmt: skip
        if fit is not None and fit.inliers > _INLIERS and np.isfinite(fit.timeshift_sigma_s):
            fits.append((len(window), fit))
    if not fits:
        reason = "too few features are followed from image to image, or they do not fit the gyro's rotation"
        return TdIcpResult(REFUSED, reason, rejected=len(frames))
    return _together(fits, len(frames), start.iterations)


def _windows(frames: Frames) -> list[Frames]:
    """Stretches without a hole, cut into windows; at most six, evenly chosen."""
    stretches: list[Frames] = []
    for frame in frames:
        if (
            not stretches
            or frame[0] - stretches[-1][-1][0] > IMAGE_GAP_S
            or frame[0] - stretches[-1][0][0] > _WINDOW_S
        ):
            stretches.append([])
        stretches[-1].append(frame)
    long = [s for s in stretches if s[-1][0] - s[0][0] >= STRETCH_S]
    if len(long) > STRETCHES:
        long = [long[i] for i in np.linspace(0, len(long) - 1, STRETCHES).round().astype(int)]
    return long


def _near(
    imu: tuple[FloatArray, FloatArray], window: Frames, shift_s: float, margin_s: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """The gyro's samples that a window needs."""
    t, gyro = imu
    inside = (t > window[0][0] + shift_s - margin_s) & (t < window[-1][0] + shift_s + margin_s)
    return t[inside], gyro[inside]


def _start(
    imu: tuple[FloatArray, FloatArray], windows: list[Frames], lens: Lens, options: TdIcpOptions
) -> TdIcpResult:
    """Register strung-together rotations of one window; the next one where that does not work."""
    result = TdIcpResult(REFUSED, "too few features carry over from image to image")
    for window in windows:
        chains = track_orientations((frame for _, frame in window), *lens)
        if not chains:
            continue
        chain = max(chains, key=lambda c: len(c.t_cam_ns))
        base_s, base_ns = window[0][0], window[0][1].t_cam_ns
        t_cam = base_s + np.asarray((chain.t_cam_ns - base_ns) * 1e-9, dtype=np.float64)
        t, gyro = _near(imu, window, options.timeshift_guess_s, options.search_s + 0.5)
        result = td_icp(t, gyro, t_cam, chain.R_world_cam, chain.covariance, options)
        if result.status != REFUSED:
            break
    return result


def _together(fits: list[tuple[int, EpipolarFit]], n_frames: int, rounds: int) -> TdIcpResult:
    """Weighted mean of the windows; sigmas widened where stretches of the recording disagree."""
    best = min((f for _, f in fits), key=lambda f: f.timeshift_sigma_s)
    offsets = np.array(
        [[*so3.log(best.R_imu_cam.T @ f.R_imu_cam), f.timeshift_s - best.timeshift_s] for _, f in fits]
    )
    information = np.linalg.inv(np.stack([f.covariance for _, f in fits]))
    P = np.linalg.inv(information.sum(axis=0))
    mean = P @ np.einsum("kij,kj->i", information, offsets)
    stretches = [(o + x, C) for o, (_, f) in zip(offsets, fits, strict=True) for x, C in f.stretches]
    widened = scatter_factors(stretches)
    P = P * np.outer(np.repeat(widened, (3, 1)), np.repeat(widened, (3, 1)))
    R = best.R_imu_cam @ so3.exp(mean[:3])
    covariance = np.zeros((7, 7))
    covariance[np.ix_(_WANTED, _WANTED)] = P
    bias = np.mean([f.gyro_bias for _, f in fits], axis=0)
    covariance[[3, 4, 5], [3, 4, 5]] = np.var([f.gyro_bias for _, f in fits], axis=0) + 1e-8
    reasons = lost_in_words(covariance, R)
    pairs = sum(n for n, _ in fits)
    return TdIcpResult(
        status=DEGENERATE if reasons else OK,
        reason="; ".join(reasons),
        timeshift_cam_imu_s=best.timeshift_s + float(mean[3]),
        timeshift_sigma_s=float(np.sqrt(P[3, 3])),
        R_imu_cam=R,
        rotation_sigma_rad=np.sqrt(np.diagonal(P)[:3]),
        covariance=covariance,
        gyro_bias_rps=bias,
        pairs=pairs,
        rejected=n_frames - pairs,
        iterations=rounds,
        camera_noise_rad=float(np.median([f.error for _, f in fits])),
        widened=max(widened),
    )
