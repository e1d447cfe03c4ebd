"""Temporal calibration beside the running filter: does its time shift agree with the rotations alone?

The filter assumes that its model is right; registering rotations knows nothing of positions, gravity or the
lever arm, and every window starts anew. So the two err differently, and a clock that slowly runs off, which a
filter may follow too late or put on another parameter's account, shows here. Costs one registration of ten
seconds in every thirty, and nothing while the rig stands still.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate
from vical_daemon.estimation.significance import DISAGREEMENT_SIGMAS
from vical_daemon.estimation.temporal.camera_orientations import target_orientations
from vical_daemon.estimation.temporal.td_icp import REFUSED, TdIcpOptions, TdIcpResult, td_icp
from vical_daemon.estimation.temporal.td_icp_monitor import DelayReport, DelayTracker

FloatArray = npt.NDArray[np.float64]

_FLOOR_S = 2e-4  # lens and board are not exact: below this the two may differ for good
_LASTING = 2  # windows in a row
_FRAME_S = 0.18  # of the images one in so many seconds is enough
_SEARCH_S = 0.25
_KEEP_S = 2.0  # gyro kept beyond the window
_MOVING_RPS = 0.1
_KNOWN_S = 1e-3  # the filter's shift counts as a value of its own below this sigma


@dataclass(frozen=True, slots=True)
class DelayVerdict:
    """What the watch knows about one camera.

    Attributes:
        report: Of the last window; None before the first.
        windows: Registered so far.
        refused: Windows that gave no delay.
        why_refused: Reason of the last one of these.
        filter_s: The filter's time shift when the last window was registered, s.
        filter_sigma_s: Its standard deviation, s.
        against: Windows in a row in which the two disagree.
    """

    report: DelayReport | None = None
    windows: int = 0
    refused: int = 0
    why_refused: str = ""
    filter_s: float = float("nan")
    filter_sigma_s: float = float("nan")
    against: int = 0

    @property
    def warning(self) -> str:
        """One line when the disagreement lasts; else empty."""
        if self.against < _LASTING or self.report is None:
            return ""
        own, sigma = 1e3 * self.report.timeshift_s, 1e3 * self.report.timeshift_sigma_s
        return (
            f"rotations alone give a time shift of {own:+.2f} ± {sigma:.2f} ms, the filter "
            f"{1e3 * self.filter_s:+.2f} ± {1e3 * self.filter_sigma_s:.2f} ms, in {self.against} windows: "
            "do the stamps of camera and imu drift or jump?"
        )

    def values(self) -> dict[str, str]:
        """Keys and values for a status."""
        out = {"windows": str(self.windows), "refused": str(self.refused), "against": str(self.against)}
        if self.why_refused:
            out["why_refused"] = self.why_refused
        if self.report is not None:
            out |= {
                "timeshift_s": f"{self.report.timeshift_s:.6f}",
                "timeshift_sigma_s": f"{self.report.timeshift_sigma_s:.6f}",
                "drift_ppm": f"{1e6 * self.report.drift:.2f}",
                "drift_sigma_ppm": f"{1e6 * self.report.drift_sigma:.2f}",
                "filter_timeshift_s": f"{self.filter_s:.6f}",
                "filter_timeshift_sigma_s": f"{self.filter_sigma_s:.6f}",
            }
        return out


@dataclass(slots=True)
class _Camera:
    """Images of the present window, and what is known."""

    known: CameraEstimate | None = None  # of the filter, in the middle of the window
    frames: list[PointsFrame] = field(default_factory=list)
    next_ns: int = 0
    tracker: DelayTracker = field(default_factory=DelayTracker)
    verdict: DelayVerdict = field(default_factory=DelayVerdict)


class DelayWatch:
    """Fed with what the filter is fed with; compares now and then.

    Args:
        points_m: Points of the target, m, shape (n, 3).
        cameras: Names.
        options: About the gyro.
        window_s: Length of a window, s.
        every_s: From the beginning of one window to that of the next, s.
    """

    def __init__(
        self,
        points_m: FloatArray,
        cameras: Sequence[str],
        options: TdIcpOptions | None = None,
        window_s: float = 10.0,
        every_s: float = 30.0,
    ) -> None:
        self._points_m = points_m
        self._options = replace(options or TdIcpOptions(), search_s=_SEARCH_S)
        self._window_ns, self._every_ns = round(window_s * 1e9), round(every_s * 1e9)
        self._imu: deque[tuple[int, Sequence[float]]] = deque()
        self._cameras = {name: _Camera() for name in cameras}

    @property
    def verdicts(self) -> dict[str, DelayVerdict]:
        """What is known about each camera."""
        return {name: camera.verdict for name, camera in self._cameras.items()}

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float]) -> None:
        """Take one reading (imu clock, ns; rad/s)."""
        if self._imu and t_imu_ns <= self._imu[-1][0]:
            if t_imu_ns > self._imu[-1][0] - self._every_ns:
                return
            self._set_back()
        self._imu.append((t_imu_ns, gyro_rps))
        while self._imu[0][0] < t_imu_ns - self._window_ns - round(_KEEP_S * 1e9):
            self._imu.popleft()

    def _set_back(self) -> None:
        """The clock has been set back: what was collected has no place on the new time axis."""
        self._imu.clear()
        for camera in self._cameras.values():
            camera.frames, camera.next_ns = [], 0

    def add_points(self, frame: PointsFrame) -> None:
        """Take the points of one image; most are left out, and all of them between windows."""
        camera = self._cameras.get(frame.camera)
        if camera is None or camera.known is None or frame.t_cam_ns < camera.next_ns or len(frame.ids) < 6:
            return
        if not camera.frames and not self._turning():
            camera.next_ns = frame.t_cam_ns + 1_000_000_000
            return
        camera.next_ns = frame.t_cam_ns + round(_FRAME_S * 1e9)
        camera.frames.append(frame)

    def _turning(self) -> bool:
        """Whether the rig turned during the last second."""
        if not self._imu:
            return False
        newest = self._imu[-1][0]
        recent = []
        for t, gyro in reversed(self._imu):
            if t < newest - 1_000_000_000:
                break
            recent.append(gyro)
        rates = np.asarray(recent, dtype=np.float64)
        return bool(np.linalg.norm(rates.std(axis=0)) > _MOVING_RPS)

    def look(self, estimate: CalibrationEstimate) -> None:
        """Register a window if one is complete; the estimate gives the lens and what to compare with."""
        for name, camera in self._cameras.items():
            now = estimate.cameras.get(name)
            if now is None or not self._imu:
                continue
            if not camera.frames:
                camera.known = now
                continue
            assert camera.known is not None
            begin = camera.frames[0].t_cam_ns
            passed = self._imu[-1][0] - begin - round(now.timeshift_cam_imu_s * 1e9)
            if 2 * passed <= self._window_ns:
                camera.known = now
            if passed < self._window_ns + round(_SEARCH_S * 1e9):
                continue
            result, middle_s = self._register(camera.frames, now)
            camera.verdict = _judged(camera, camera.known, result, middle_s)
            camera.frames, camera.next_ns = [], begin + self._every_ns

    def _register(self, frames: list[PointsFrame], known: CameraEstimate) -> tuple[TdIcpResult, float]:
        """Register one window; also the time of its middle in the imu's clock, s."""
        base = frames[0].t_cam_ns
        lens = np.array(known.intrinsics), np.array(known.distortion)
        poses = target_orientations(frames, self._points_m, *lens, known.distortion_model)
        t_imu = np.array([(t - base) * 1e-9 for t, _ in self._imu])
        gyro = np.array([g for _, g in self._imu], dtype=np.float64)
        t_cam = np.asarray((poses.t_cam_ns - base) * 1e-9, dtype=np.float64)
        options = replace(self._options, timeshift_guess_s=known.timeshift_cam_imu_s)
        result = td_icp(t_imu, gyro, t_cam, poses.R_world_cam, poses.covariance, options)
        middle_s = base * 1e-9 + (float(t_cam.mean()) if len(t_cam) else 0.0) + known.timeshift_cam_imu_s
        return result, middle_s


def _judged(camera: _Camera, known: CameraEstimate, result: TdIcpResult, t_s: float) -> DelayVerdict:
    """The verdict after one more window."""
    before = camera.verdict
    if result.status == REFUSED or result.timeshift_sigma_s > _KNOWN_S:
        why = result.reason or f"delay known to {1e3 * result.timeshift_sigma_s:.1f} ms only"
        return replace(before, refused=before.refused + 1, why_refused=why)
    report = camera.tracker.track(t_s, result)
    against = 0
    if known.timeshift_sigma_s < _KNOWN_S:
        joint = float(np.hypot(report.timeshift_sigma_s, known.timeshift_sigma_s))
        apart = abs(report.timeshift_s - known.timeshift_cam_imu_s)
        against = before.against + 1 if apart > max(DISAGREEMENT_SIGMAS * joint, _FLOOR_S) else 0
    return DelayVerdict(
        report,
        before.windows + 1,
        before.refused,
        before.why_refused,
        known.timeshift_cam_imu_s,
        known.timeshift_sigma_s,
        against,
    )
