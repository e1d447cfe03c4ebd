"""Watches the delay between an imu and a camera while they run, and says when it drifts or jumps.

Keeps the last seconds of both streams, registers them anew every so often, and tracks delay and drift rate
with a two-state Kalman filter whose measurements carry TD-ICP's own sigma. The delay of a healthy rig
wanders by microseconds; a clock that runs off or a driver that buffers one more frame shows at once.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.significance import JUMP_SIGMAS
from vical_daemon.estimation.temporal.td_icp import REFUSED, TdIcpOptions, TdIcpResult, td_icp

FloatArray = npt.NDArray[np.float64]

_DRIFT_WALK = 1e-6  # how much the drift rate may change, 1/sqrt(s)
_OFFSET_WALK_S = 2e-6  # wander of the delay itself, s/sqrt(s)


@dataclass(frozen=True)
class DelayReport:
    """What the monitor knows after one window.

    Attributes:
        t_s: End of the window in the imu's clock, s.
        timeshift_s: Delay at t_s, s.
        timeshift_sigma_s: Its standard deviation, s.
        drift: Rate of change (1e-6: 1 microsecond a second, 1 ppm).
        drift_sigma: Its standard deviation.
        jumped: The window contradicts all before it; the monitor has started over from it.
        window: What the window alone gave.
    """

    t_s: float
    timeshift_s: float
    timeshift_sigma_s: float
    drift: float
    drift_sigma: float
    jumped: bool
    window: TdIcpResult


class DelayTracker:
    """Delay and drift rate from one window after another: a Kalman filter with two states.

    Args:
        overlap: How many windows share each piece of data; 1 where windows do not overlap.
    """

    def __init__(self, overlap: float = 1.0) -> None:
        self._overlap = max(1.0, overlap)
        self._state: tuple[float, FloatArray, FloatArray] | None = None

    @property
    def timeshift_s(self) -> float | None:
        """The delay after the last window, s; None before the first."""
        return None if self._state is None else float(self._state[1][0])

    def track(self, t_s: float, result: TdIcpResult) -> DelayReport:
        """Take what a window gave; `t_s` is its middle (imu clock, s)."""
        z, variance = result.timeshift_cam_imu_s, result.timeshift_sigma_s**2 * self._overlap
        state, jumped = self._state, False
        if state is not None:
            x, P = _predict(state, t_s)
            S = float(P[0, 0] + variance)
            innovation = z - float(x[0])
            jumped = bool(innovation**2 > JUMP_SIGMAS**2 * S)
            K = P[:, 0] / S
            P = P - np.outer(K, P[0])
            state = (t_s, x + K * innovation, 0.5 * (P + P.T))
        if state is None or jumped:
            state = (t_s, np.array([z, 0.0]), np.diag([variance, (1e-4) ** 2]))
        self._state = state
        _, x, P = state
        return DelayReport(
            t_s, float(x[0]), float(np.sqrt(P[0, 0])), float(x[1]), float(np.sqrt(P[1, 1])), jumped, result
        )


def _predict(state: tuple[float, FloatArray, FloatArray], t_s: float) -> tuple[FloatArray, FloatArray]:
    """Delay and drift rate at a later time: the rate wanders slowly, the delay a little of its own."""
    t0, x, P = state
    dt = max(t_s - t0, 0.0)
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = _DRIFT_WALK**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    Q[0, 0] += _OFFSET_WALK_S**2 * dt
    return F @ x, F @ P @ F.T + Q


class DelayMonitor:
    """Feed it both streams; it answers when a window is full.

    Args:
        options: As for `td_icp`.
        window_s: Length of a window, s.
        every_s: A new registration after this much new data, s.
    """

    def __init__(
        self, options: TdIcpOptions | None = None, window_s: float = 10.0, every_s: float = 5.0
    ) -> None:
        self._options = options or TdIcpOptions()
        self._window_s, self._every_s = window_s, every_s
        self._imu: deque[tuple[float, FloatArray]] = deque()
        self._cam: deque[tuple[float, FloatArray, FloatArray]] = deque()
        self._next_s = float("-inf")
        self._tracker = DelayTracker(window_s / every_s)

    def add_gyro(self, t_imu_s: float, gyro_rps: FloatArray) -> None:
        """Take one gyro sample (imu clock, s; rad/s, shape (3,))."""
        self._imu.append((t_imu_s, np.asarray(gyro_rps, dtype=np.float64)))
        while self._imu[0][0] < t_imu_s - self._window_s - 2.0 * self._reach() - 1.0:
            self._imu.popleft()

    def add_orientation(
        self, t_cam_s: float, R_world_cam: FloatArray, covariance: FloatArray
    ) -> DelayReport | None:
        """Take one camera orientation; returns a report when a window is due and its imu data are there.

        Args:
            t_cam_s: Stamp in the camera's clock, s.
            R_world_cam: Orientation, shape (3, 3).
            covariance: Of its local error, rad^2, shape (3, 3).
        """
        self._cam.append((t_cam_s, R_world_cam, covariance))
        while self._cam[0][0] < t_cam_s - self._window_s:
            self._cam.popleft()
        if self._next_s == float("-inf"):
            self._next_s = t_cam_s + self._window_s
        if t_cam_s < self._next_s or not self._imu:
            return None
        self._next_s = t_cam_s + self._every_s
        return self._register()

    def _reach(self) -> float:
        return self._options.search_s if self._tracker.timeshift_s is None else 0.2

    def _register(self) -> DelayReport | None:
        options, known = self._options, self._tracker.timeshift_s
        if known is not None:
            options = replace(options, timeshift_guess_s=known, search_s=0.2)
        t_imu = np.array([t for t, _ in self._imu])
        gyro = np.stack([g for _, g in self._imu])
        t_cam = np.array([t for t, _, _ in self._cam])
        R, C = np.stack([r for _, r, _ in self._cam]), np.stack([c for _, _, c in self._cam])
        result = td_icp(t_imu, gyro, t_cam, R, C, options)
        if result.status == REFUSED and known is not None:
            wide = replace(self._options, timeshift_guess_s=known)
            result = td_icp(t_imu, gyro, t_cam, R, C, wide)
        if result.status == REFUSED:
            return None
        return self._tracker.track(float(t_cam.mean() + result.timeshift_cam_imu_s), result)
