"""Says how far to trust the filter: status, reasons in words, progress, trace, withheld directions."""

from __future__ import annotations

from collections import deque

import numpy as np

from vical_daemon.estimation import so3
from vical_daemon.estimation.calibration_filter import CalibrationFilter, FrameReport
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    ImuEstimate,
    PoseEstimate,
    Status,
    TracePoint,
)
from vical_daemon.estimation.state import ACCEL_BIAS, GYRO_BIAS, CameraSlices, Layout


class Judge:
    """Watches what goes in and out of the filter.

    Args:
        options: Switches.
        layout: Where the errors live.
    """

    def __init__(self, options: CalibrationOptions, layout: Layout) -> None:
        self.options = options
        self.layout = layout
        self.imu_samples = 0
        self.imu_refused = 0
        self.frames = 0
        self.frames_ignored = 0
        self.frames_refused = 0
        self.reason = "no inertial data yet"
        self.events: list[str] = []
        self._first_ns = 0
        self._newest_ns = 0
        self._points = [0, 0]
        self._nis: deque[tuple[float, int]] = deque(maxlen=600)
        self._square: dict[str, deque[tuple[float, int]]] = {}
        self._trace: dict[str, list[TracePoint]] = {}

    # ------------------------------------------------------------------ what happens
    def saw_imu(self, t_ns: int, gyro: FloatArray, accel: FloatArray) -> None:
        """Count one inertial reading."""
        if not self.imu_samples:
            self._first_ns = t_ns
        self.imu_samples += 1
        self._newest_ns = t_ns

    def waiting(self, why: str) -> None:
        """The start is not possible yet."""
        self.reason = why

    def started(self, t_s: float) -> None:
        """The filter runs from `t_s` on."""
        self.reason = ""

    def pose_lost(self) -> None:
        """The pose was taken anew."""
        self.events.append("pose lost and found again")

    def saw_frame(self, report: FrameReport, f: CalibrationFilter) -> None:
        """Take the verdict of one frame."""
        self._points[0] += int((~report.accepted).sum())
        self._points[1] += len(report.accepted)
        if not report.used:
            self.frames_refused += 1
            return
        self.frames += 1
        self._nis.append((report.nis, report.dof))
        square = self._square.setdefault(report.camera, deque(maxlen=400))
        good = report.residual_px[report.accepted]
        square.append((float((good**2).sum()), 2 * len(good)))
        self._maybe_trace(report.camera, f)

    def _maybe_trace(self, camera: str, f: CalibrationFilter) -> None:
        trace = self._trace.setdefault(camera, [])
        t = f.state.t_s
        if trace and t - trace[-1].t_s < 1.0:
            return
        e = self._camera(camera, f)
        cov = np.diag(np.array(e.T_imu_cam.covariance))
        sigma = np.sqrt(cov)
        trace.append(
            TracePoint(
                t,
                e.T_imu_cam.p_m,
                sigma[:3].tolist(),
                e.T_imu_cam.q_wxyz,
                sigma[3:].tolist(),
                e.timeshift_cam_imu_s,
                e.timeshift_sigma_s,
                self.nis_per_dof(),
            )
        )
        if len(trace) > 7200:
            del trace[1:3600:2]

    # ------------------------------------------------------------------ what is said
    def nis_per_dof(self) -> float:
        """Mean normalised innovation squared per degree of freedom over the last frames."""
        dof = sum(d for _, d in self._nis)
        return sum(n for n, _ in self._nis) / dof if dof else 0.0

    def trace(self, camera: str) -> list[TracePoint]:
        """The development of one camera."""
        return list(self._trace.get(camera, []))

    def estimate(self, f: CalibrationFilter | None) -> CalibrationEstimate:
        """Put everything together."""
        cameras, imu, gravity = {}, None, []
        status = Status.WAITING if not self.imu_samples else Status.INITIALISING
        if f is not None:
            cameras = {name: self._camera(name, f) for name in self.layout.cameras}
            sigma = f.sigmas()
            imu = ImuEstimate(
                f.state.gyro_bias.tolist(),
                f.state.accel_bias.tolist(),
                sigma[GYRO_BIAS].tolist(),
                sigma[ACCEL_BIAS].tolist(),
            )
            gravity = f.state.gravity.tolist()
            status = Status.CONVERGING
        events, self.events = self.events, []
        return CalibrationEstimate(
            self._newest_ns,
            status,
            self.reason,
            0.0,
            "",
            (self._newest_ns - self._first_ns) * 1e-9,
            self.frames,
            self.imu_samples,
            cameras,
            imu,
            gravity,
            self.nis_per_dof(),
            self._points[0] / max(self._points[1], 1),
            events,
        )

    def _camera(self, name: str, f: CalibrationFilter) -> CameraEstimate:
        camera, where = f.state.cameras[name], self.layout.cameras[name]
        # Errors that last over several images count less than the filter thinks: see `consistency`.
        spread = float(np.sqrt(f.consistency[name].factor))
        sigma = spread * f.sigmas()
        q = so3.quat_from_matrix(camera.R_imu_cam)
        square = self._square.get(name, ())
        count = sum(n for _, n in square)
        return CameraEstimate(
            PoseEstimate(camera.p_imu_cam.tolist(), q.tolist(), (spread**2 * pose_covariance(f, where)).tolist()),
            camera.timeshift_s,
            float(sigma[where.timeshift]) if where.timeshift is not None else 0.0,
            camera.intrinsics.tolist(),
            sigma[where.intrinsics].tolist() if where.intrinsics is not None else [0.0] * 4,
            camera.distortion_model,
            camera.distortion.tolist(),
            sigma[where.distortion].tolist() if where.distortion is not None else [0.0] * 4,
            float(np.sqrt(sum(s for s, _ in square) / count)) if count else 0.0,
            f.corner_noise[name].sigma_px,
            [],
            camera.readout_s,
            float(sigma[where.readout]) if where.readout is not None else 0.0,
        )


def pose_covariance(f: CalibrationFilter, where: CameraSlices) -> FloatArray:
    """Covariance of T_imu_cam, order [px py pz rx ry rz], shape (6, 6); zeros where held fixed."""
    if where.position is None or where.rotation is None:
        return np.zeros((6, 6))
    rows = list(range(where.position.start, where.position.stop)) + list(
        range(where.rotation.start, where.rotation.stop)
    )
    return f.covariance(rows)
