"""A plain EKF of the same model with the same start: the comparator, in benchmarks only.

What a textbook would do: error state with local attitude error, inertial propagation sample by sample with a
first-order transition, one linearisation per image, per-corner gates with the stated corner noise, no
iteration, no sigma points, no measured noise. It starts from the product's own start (its answer after
the images of the start, with its sigmas), so that the comparison is about the filter and not about who finds
the mounting.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2
from vical_mocks.cramer_rao.projection import View, jacobians
from vical_mocks.harness.feed import CAMERA, Record, Snapshot, error_against_truth
from vical_mocks.lens import Lens
from vical_mocks.points import SimulatedRun
from vical_mocks.rotations import exp_so3, skew

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.next_term import reported_camera

FloatArray = npt.NDArray[np.float64]
# attitude, position, velocity, gyro bias, accelerometer bias, gravity; lever arm, mounting, shift, lens
THETA, P, V, BG, BA, G = (slice(3 * i, 3 * i + 3) for i in range(6))
LEVER, MOUNT, SHIFT = slice(18, 21), slice(21, 24), slice(24, 25)
INTRINSICS, DISTORTION = slice(25, 29), slice(29, 33)
SIZE = 33
_GATE = float(chi2.isf(0.01, 2))


@dataclass
class Nominal:
    """Values about which the errors are small; rotation errors are local (right)."""

    t_s: float
    R: FloatArray
    p: FloatArray
    v: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray
    gravity: FloatArray
    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    timeshift_s: float
    lens: Lens


class PlainEkf:
    """The filter itself."""

    def __init__(
        self, start: Nominal, sigmas: FloatArray, noise: ImuNoise, corner_sigma_px: float, estimate_lens: bool
    ) -> None:
        self.x, self.noise, self.corner_sigma_px = start, noise, corner_sigma_px
        self.estimate_lens = estimate_lens
        self.covariance = np.diag(sigmas**2)
        self.omega = np.zeros(3)

    def propagate(self, rows: FloatArray) -> None:
        """Integrate inertial readings (columns t_s, gyro, force) that start at the state's time."""
        for a, b in pairwise(rows):
            self._step(b[0] - a[0], (a[1:4] + b[1:4]) / 2, (a[4:7] + b[4:7]) / 2)
        self.omega = rows[-1, 1:4] - self.x.gyro_bias

    def _step(self, dt: float, gyro: FloatArray, force: FloatArray) -> None:
        x = self.x
        omega, f = gyro - x.gyro_bias, force - x.accel_bias
        turned = x.R @ exp_so3(omega * dt / 2)
        acceleration = turned @ f + x.gravity
        F = np.eye(SIZE)
        F[THETA, THETA] = exp_so3(-omega * dt)
        F[THETA, BG] = -np.eye(3) * dt
        F[V, THETA] = -turned @ skew(f) * dt
        F[V, BA], F[V, G] = -turned * dt, np.eye(3) * dt
        F[P, V] = np.eye(3) * dt
        F[P, THETA], F[P, BA], F[P, G] = F[V, THETA] * dt / 2, F[V, BA] * dt / 2, F[V, G] * dt / 2
        Q = np.zeros(SIZE)
        Q[THETA], Q[V] = self.noise.gyro_density**2 * dt, self.noise.accel_density**2 * dt
        Q[BG], Q[BA] = self.noise.gyro_walk**2 * dt, self.noise.accel_walk**2 * dt
        self.covariance = F @ self.covariance @ F.T + np.diag(Q)
        x.p = x.p + x.v * dt + acceleration * dt**2 / 2
        x.v = x.v + acceleration * dt
        x.R = x.R @ exp_so3(omega * dt)
        x.t_s += dt

    def update(self, uv_px: FloatArray, points_m: FloatArray) -> None:
        """One linearised update with all corners that pass their gates."""
        x = self.x
        view = View(x.R, x.p, x.v, self.omega, x.R_imu_cam, x.p_imu_cam, x.lens)
        expected, visible = x.lens.project(view.points_in_cam(points_m))
        by = jacobians(view, points_m)
        H = np.zeros((2 * len(points_m), SIZE))
        H[:, THETA], H[:, P], H[:, LEVER], H[:, MOUNT] = (
            by["attitude"],
            by["position"],
            by["p_imu_cam"],
            by["r_imu_cam"],
        )
        H[:, SHIFT] = by["timeshift"]
        if self.estimate_lens:
            H[:, INTRINSICS], H[:, DISTORTION] = by["intrinsics"], by["distortion"]
        r = (uv_px - expected).ravel()
        keep = np.repeat(self._gate(H, r) & visible, 2)
        if keep.sum() < 8:
            return
        H, r = H[keep], r[keep]
        PH = self.covariance @ H.T
        S = H @ PH + self.corner_sigma_px**2 * np.eye(len(r))
        K = np.linalg.solve(S, PH.T).T
        rest = np.eye(SIZE) - K @ H
        self.covariance = rest @ self.covariance @ rest.T + self.corner_sigma_px**2 * K @ K.T
        self._apply(K @ r)

    def _gate(self, H: FloatArray, r: FloatArray) -> npt.NDArray[np.bool_]:
        pairs, residuals = H.reshape(-1, 2, SIZE), r.reshape(-1, 2)
        S = pairs @ self.covariance @ np.swapaxes(pairs, 1, 2) + self.corner_sigma_px**2 * np.eye(2)
        distance = np.einsum("ni,ni->n", residuals, np.linalg.solve(S, residuals[..., None])[..., 0])
        return np.asarray(distance < _GATE)

    def _apply(self, dx: FloatArray) -> None:
        x = self.x
        x.R, x.R_imu_cam = x.R @ exp_so3(dx[THETA]), x.R_imu_cam @ exp_so3(dx[MOUNT])
        x.p, x.v, x.gravity = x.p + dx[P], x.v + dx[V], x.gravity + dx[G]
        x.gyro_bias, x.accel_bias = x.gyro_bias + dx[BG], x.accel_bias + dx[BA]
        x.p_imu_cam, x.timeshift_s = x.p_imu_cam + dx[LEVER], x.timeshift_s + float(dx[SHIFT][0])
        f, k = np.array(x.lens.intrinsics) + dx[INTRINSICS], np.array(x.lens.distortion) + dx[DISTORTION]
        x.lens = replace(x.lens, intrinsics=tuple(f.tolist()), distortion=tuple(k.tolist()))


class _Starter(Calibrator):
    """The product up to its start: the filter that it would now run has taken the images of the start."""

    def _follow(self, *, flush: bool) -> list[FrameReport]:  # noqa: ARG002
        return []


class EkfSubject:
    """`PlainEkf` behind the same buffering as the product."""

    def __init__(self, options: CalibrationOptions, prior: CameraPrior, points_m: FloatArray) -> None:
        self.options, self.points_m = options, points_m
        self.initializer: _Starter | None = _Starter(options, {CAMERA: prior}, points_m)
        self.filter: PlainEkf | None = None
        self._rows: list[FloatArray] = []
        self._frames: list[PointsFrame] = []
        self._base_ns = 0

    def add_imu(self, t_ns: int, gyro: FloatArray, force: FloatArray) -> None:
        """See `vical_mocks.harness.feed.Subject`."""
        if not self._rows:
            self._base_ns = t_ns
        self._rows.append(np.concatenate([[(t_ns - self._base_ns) * 1e-9], gyro, force]))
        if self.initializer is not None:
            self.initializer.add_imu(t_ns, gyro, force)
        self._follow()

    def add_points(self, frame: PointsFrame) -> None:
        """See `vical_mocks.harness.feed.Subject`."""
        self._frames.append(frame)
        if self.initializer is None:
            return
        self.initializer.add_points(frame)
        self.initializer.process()
        if self.initializer.filter is not None:
            self._start(self.initializer.filter)
            self.initializer = None

    def finish(self) -> None:
        """See `vical_mocks.harness.feed.Subject`."""

    def _start(self, product: CalibrationFilter) -> None:
        state, sigmas = product.state, product.sigmas()
        # without the term that the product's lens has beyond radtan
        camera, where = reported_camera(state.cameras[CAMERA], np.eye(8, 9)), product.layout.cameras[CAMERA]
        s = np.zeros(SIZE)
        s[THETA], s[P], s[V], s[BG], s[BA] = (sigmas[3 * i : 3 * i + 3] for i in range(5))
        s[G] = 0.1 * self.options.gravity_mps2
        assert where.timeshift is not None
        s[LEVER], s[MOUNT], s[SHIFT] = sigmas[where.position], sigmas[where.rotation], sigmas[where.timeshift]
        if where.intrinsics is not None and where.distortion is not None:
            s[INTRINSICS], s[DISTORTION] = sigmas[where.intrinsics], sigmas[where.distortion][:4]
        lens = Lens(
            tuple(camera.intrinsics.tolist()),
            tuple(camera.distortion.tolist()),
            camera.resolution,
            camera.distortion_model,
        )
        start = Nominal(
            state.t_s,
            state.R_world_imu,
            state.p_world_imu,
            state.v_world_imu,
            state.gyro_bias,
            state.accel_bias,
            state.gravity,
            camera.R_imu_cam,
            camera.p_imu_cam,
            camera.timeshift_s,
            lens,
        )
        self.filter = PlainEkf(
            start, s, self.options.imu_noise, self.options.corner_sigma_px, where.intrinsics is not None
        )

    def _follow(self) -> None:
        while self.filter is not None and self._frames:
            frame = self._frames[0]
            t_s = (frame.t_cam_ns - self._base_ns) * 1e-9 + self.filter.x.timeshift_s
            if t_s > self._rows[-1][0]:
                return
            self._frames.pop(0)
            if t_s <= self.filter.x.t_s:
                continue
            self.filter.propagate(self._segment(self.filter.x.t_s, t_s))
            self.filter.update(frame.uv_px, self.points_m[frame.ids])

    def _segment(self, from_s: float, to_s: float) -> FloatArray:
        """Readings between two instants with interpolated ends; older ones are forgotten."""
        rows = np.array(self._rows)
        ends = np.array([[np.interp(t, rows[:, 0], rows[:, k]) for k in range(7)] for t in (from_s, to_s)])
        inner = rows[(rows[:, 0] > from_s) & (rows[:, 0] < to_s)]
        self._rows = [row for row in self._rows if row[0] > from_s - 0.1]
        return np.vstack([ends[:1], inner, ends[1:]])

    def look(self, run: SimulatedRun, t_s: float, record: Record) -> Snapshot | None:  # noqa: ARG002
        """See `vical_mocks.harness.feed.Subject`."""
        if self.filter is None:
            return None
        x = self.filter.x
        error = error_against_truth(
            run, t_s, x.p_imu_cam, x.R_imu_cam, x.timeshift_s, x.lens.intrinsics, x.lens.distortion
        )
        return Snapshot(t_s, "running", error, self.filter.covariance[LEVER.start :, LEVER.start :])
