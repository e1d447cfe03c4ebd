"""The delay between an imu and a camera through a recording: window by window, with drift and jumps.

Each window is registered by itself. Delay and drift rate are tracked with a two-state Kalman filter whose
measurements carry TD-ICP's own sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import SHIFT_WALK, SKEW_SIGMA
from vical_daemon.estimation.significance import SURE_SIGMAS
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions
from vical_daemon.estimation.temporal.td_icp_result import REFUSED, TdIcpResult

_DRIFT_WALK = 1e-6
"""How much the drift rate may change, 1/sqrt(s): a drift of 20 ppm that begins is followed within sigma; with
the wander of a crystal (`SKEW_WALK`) it is 7 sigma off."""
_SEARCH_S = 0.2  # about the delay of the window before


@dataclass(frozen=True)
class DelayReport:
    """What is known after one window.

    Attributes:
        t_s: Middle of the window in the imu's clock, s.
        timeshift_s: Delay at t_s, s.
        timeshift_sigma_s: Its standard deviation, s.
        drift: Rate of change (1e-6: 1 microsecond a second, 1 ppm).
        drift_sigma: Its standard deviation.
        jumped: The window contradicts all before it; the tracking has started over from it.
        window: What the window alone gave.
    """

    t_s: float
    timeshift_s: float
    timeshift_sigma_s: float
    drift: float
    drift_sigma: float
    jumped: bool
    window: TdIcpResult


def delay_windows(
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    t_cam_s: FloatArray,
    R_world_cam: FloatArray,
    rotation_sigma: FloatArray | float,
    options: TdIcpOptions,
    window_s: float,
) -> list[DelayReport]:
    """Register overlapping windows of a recording, one every half window; those refused give no report.

    Args:
        t_imu_s: Stamps of the gyro in its clock, s, shape (m,).
        gyro_rps: rad/s, shape (m, 3).
        t_cam_s: Stamps of the orientations in the camera's clock, s, shape (n,).
        R_world_cam: Orientations, shape (n, 3, 3).
        rotation_sigma: As for `td_icp`.
        options: As for `td_icp`.
        window_s: Length of a window, s.
    """
    reports: list[DelayReport] = []
    state: _Delay | None = None
    sigma = np.asarray(rotation_sigma, dtype=np.float64)
    for end in np.arange(t_cam_s[0] + window_s, t_cam_s[-1], 0.5 * window_s):
        seen = (t_cam_s >= end - window_s) & (t_cam_s <= end)
        tries = [options]
        if state is not None:
            tries.insert(0, replace(options, timeshift_guess_s=float(state.x[0]), search_s=_SEARCH_S))
        for tried in tries:
            reach_s = abs(tried.timeshift_guess_s) + tried.search_s + 1.0
            read = (t_imu_s >= end - window_s - reach_s) & (t_imu_s <= end + reach_s)
            own = sigma[seen] if sigma.ndim else sigma
            result = td_icp(t_imu_s[read], gyro_rps[read], t_cam_s[seen], R_world_cam[seen], own, tried)
            if result.status != REFUSED:
                break
        else:
            continue
        state, jumped = _tracked(state, float(t_cam_s[seen].mean()) + result.timeshift_cam_imu_s, result)
        shift_s, drift = state.x.tolist()
        sigmas = np.sqrt(state.P.diagonal()).tolist()
        reports.append(DelayReport(state.t_s, shift_s, sigmas[0], drift, sigmas[1], jumped, result))
    return reports


@dataclass(frozen=True)
class _Delay:
    """Delay and drift rate x at t_s, with covariance P."""

    t_s: float
    x: FloatArray
    P: FloatArray


def _tracked(before: _Delay | None, t_s: float, result: TdIcpResult) -> tuple[_Delay, bool]:
    """Delay and drift after one more window, and whether it contradicts those before."""
    z, variance = (
        result.timeshift_cam_imu_s,
        2.0 * result.timeshift_sigma_s**2,
    )  # two windows share each datum
    anew = _Delay(t_s, np.array([z, 0.0]), np.diag([variance, SKEW_SIGMA**2]))
    if before is None:
        return anew, False
    x, P = _predicted(before, t_s)
    S, innovation = float(P[0, 0] + variance), z - float(x[0])
    if innovation**2 > SURE_SIGMAS**2 * S:
        return anew, True
    K = P[:, 0] / S
    P = P - np.outer(K, P[0])
    return _Delay(t_s, x + K * innovation, 0.5 * (P + P.T)), False


def _predicted(before: _Delay, t_s: float) -> tuple[FloatArray, FloatArray]:
    """Delay and drift rate at a later time: the rate wanders slowly, the delay a little of its own."""
    dt = max(t_s - before.t_s, 0.0)
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = _DRIFT_WALK**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    Q[0, 0] += SHIFT_WALK**2 * dt
    return F @ before.x, F @ before.P @ F.T + Q
