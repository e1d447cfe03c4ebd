"""The filter: square-root sigma-point propagation with the IMU and update with the points of one image.

Equations and derivation: docs/math/filter.md. Nothing here decides *whether* to believe a result; that is
`judge`. The filter never raises on data: each update returns a verdict.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from vical_daemon.estimation import unscented
from vical_daemon.estimation.corner_noise import CornerNoise
from vical_daemon.estimation.imu_model import ImuSegment, Motion, compose, process_noise, strapdown
from vical_daemon.estimation.measurements import FloatArray, ImuNoise, IntArray
from vical_daemon.estimation.retract import camera_points, motion_points, retract
from vical_daemon.estimation.state import ATTITUDE, MOTION, Layout, State, grp_from_rotation
from vical_daemon.estimation.target_view import Rates, view

_ITERATIONS = 5
_CURVED = 0.1  # iterate while the second-order part exceeds this share of the corner noise
_CORNER_GATE = float(chi2.isf(1e-4, 2))
_RESIDUAL_GATE = float(chi2.isf(2e-5, 2))
_FRAME_GATE_P = 1e-9


@dataclass(frozen=True, slots=True)
class FrameReport:
    """What one image did.

    Attributes:
        t_ns: Image stamp, camera clock, ns.
        camera: Camera name.
        ids: Point ids, shape (n,).
        uv_px: Measured pixels, shape (n, 2).
        residual_px: Measured minus predicted after the update, shape (n, 2); not-a-number if not predicted.
        accepted: Which points entered, shape (n,).
        used: Whether the frame entered at all.
        nis: Normalised innovation squared of what the state can explain.
        dof: Its degrees of freedom.
        sigma_px: Corner noise used, px.
        reason: Why a frame was refused; empty otherwise.
    """

    t_ns: int
    camera: str
    ids: IntArray
    uv_px: FloatArray
    residual_px: FloatArray
    accepted: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    used: bool
    nis: float = 0.0
    dof: int = 0
    sigma_px: float = 0.0
    reason: str = ""


@dataclass(slots=True)
class _Linear:
    """A statistical linearisation of one image: z = z_bar + H S e + curvature, in pixels."""

    z: FloatArray
    linear: FloatArray
    curved: FloatArray
    at_time: FloatArray
    valid: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


@dataclass(slots=True)
class CalibrationFilter:
    """State and covariance with the two steps of the filter.

    Attributes:
        state: Nominal state at `state.t_s`.
        layout: Where the errors live.
        S: Lower-triangular square root of the covariance, shape (n, n).
        imu_noise: Densities.
        corner_noise: Measured corner noise by camera.
        walk: Variance per second added to each error outside the motion model (drift of the time shift,
            slow change of the mounting), shape (n,).
        stamp_jitter_s: Random error of image stamps, common to all corners of an image, s, by camera.
        rates: Rates at the state's instant.
    """

    state: State
    layout: Layout
    S: FloatArray
    imu_noise: ImuNoise
    corner_noise: dict[str, CornerNoise]
    walk: FloatArray
    stamp_jitter_s: dict[str, float] = field(default_factory=dict)
    rates: Rates = field(default_factory=lambda: Rates(np.zeros(3), np.zeros(3)))

    # ------------------------------------------------------------------ propagation
    def predict(self, segment: ImuSegment) -> None:
        """Propagate to the end of a segment that starts at the state's instant."""
        d = self.layout.dynamic
        if len(segment.t_s) < 2 or segment.t_s[-1] <= segment.t_s[0]:
            self._set_rates(segment)
            return
        errors = unscented.offsets(self.S[:d, :d])
        points = motion_points(self.state, self.layout, errors)
        relative = strapdown(
            segment, points.gyro_bias, points.accel_bias, points.gyro_matrix, points.accel_matrix
        )
        end = compose(Motion(points.R, points.p, points.v), relative, points.gravity)
        values = np.concatenate(
            [
                grp_from_rotation(end.R[0].T @ end.R[1:]),
                end.p[1:] - end.p[0],
                end.v[1:] - end.v[0],
            ],
            axis=1,
        )
        m = unscented.moments(values)
        noise = process_noise(self.state.R_world_imu, relative, self.imu_noise)
        self._grow(m, noise.covariance, noise.gyro_bias_var, noise.accel_bias_var, relative.t_s[-1])
        state = self.state
        shift = np.zeros(self.layout.size)
        shift[MOTION] = m.shift
        state.R_world_imu, state.p_world_imu, state.v_world_imu = end.R[0], end.p[0], end.v[0]
        state.t_s = float(segment.t_s[-1])
        self.state = retract(state, self.layout, shift)
        self._set_rates(segment)

    def _grow(
        self, m: unscented.Moments, Q: FloatArray, gyro_var: float, accel_var: float, dt: float
    ) -> None:
        """Assemble the columns of the new square root and make it triangular."""
        n, d = self.layout.size, self.layout.dynamic
        drift = np.flatnonzero(self.walk)
        A = np.zeros((n, n + d + 9 + 6 + len(drift)))
        A[:, :n] = self.S
        A[:9, :d] = m.linear
        A[:9, n : n + d] = m.curved
        A[:9, n + d : n + d + 9] = np.linalg.cholesky(Q + 1e-30 * np.eye(9))
        at = n + d + 9
        A[9:12, at : at + 3] = np.sqrt(gyro_var) * np.eye(3)
        A[12:15, at + 3 : at + 6] = np.sqrt(accel_var) * np.eye(3)
        A[drift, at + 6 + np.arange(len(drift))] = np.sqrt(self.walk[drift] * dt)
        self.S = unscented.lower_root(A)

    def _set_rates(self, segment: ImuSegment) -> None:
        state = self.state
        omega = state.gyro_matrix @ (segment.gyro[-1] - state.gyro_bias)
        force = state.accel_matrix @ (segment.accel[-1] - state.accel_bias)
        self.rates = Rates(omega, state.R_world_imu @ force + state.gravity)

    # ------------------------------------------------------------------ update
    def update(
        self,
        camera: str,
        t_ns: int,
        t_cam_s: float,
        ids: IntArray,
        points: FloatArray,
        uv: FloatArray,
        sigma_px: FloatArray | None = None,
    ) -> FrameReport:
        """Correct the state with the points of one image.

        Args:
            camera: Camera name.
            t_ns: Image stamp for the report, ns.
            t_cam_s: The same, s since the base (camera clock).
            ids: Point ids, shape (n,).
            points: Their places in the world, m, shape (n, 3).
            uv: Measured pixels, shape (n, 2).
            sigma_px: Relative weights from the detector, px, shape (n,), or None.

        Returns:
            The verdict.
        """
        noise = self.corner_noise[camera]
        sigma = noise.sigmas(sigma_px, len(ids))
        lin = self._linearise(camera, t_cam_s, points, uv, np.zeros(self.layout.size), self.S)
        innovation = (uv - lin.z) / sigma[:, None]
        keep = lin.valid & self._corner_gate(innovation, lin, sigma)
        if keep.sum() < 4:
            return self._refused(
                t_ns, camera, ids, uv, innovation * sigma[:, None], "too few corners pass the gate"
            )
        S, dx, nis, dof, keep, rest = self._solve(camera, t_cam_s, points, uv, sigma, lin, keep)
        limit = chi2.isf(_FRAME_GATE_P, dof)
        if nis > limit:
            why = f"innovation of the frame is {nis / dof:.1f} times what it should be"
            return self._refused(t_ns, camera, ids, uv, innovation * sigma[:, None], why)
        self._accept(S, dx)
        noise.learn(rest[0], rest[1])
        residual = uv - self.predict_pixels(camera, t_cam_s, points)
        return FrameReport(t_ns, camera, ids, uv, residual, keep, True, nis, dof, noise.sigma_px)

    def _refused(
        self, t_ns: int, camera: str, ids: IntArray, uv: FloatArray, residual: FloatArray, why: str
    ) -> FrameReport:
        none = np.zeros(len(ids), dtype=bool)
        return FrameReport(t_ns, camera, ids, uv, residual, none, False, 0.0, 0, 0.0, why)

    def predict_pixels(self, camera: str, t_cam_s: float, points: FloatArray) -> FloatArray:
        """Where points should appear with the nominal state, px, shape (n, 2)."""
        return self._project(camera, t_cam_s, points, None, np.zeros((1, self.layout.size)))[0]

    def _project(
        self, camera: str, t_cam_s: float, points: FloatArray, uv: FloatArray | None, errors: FloatArray
    ) -> FloatArray:
        state, where = self.state, self.layout.cameras[camera]
        known = state.cameras[camera]
        motion = motion_points(state, self.layout, errors)
        cam = camera_points(known, self.layout, camera, errors)
        world: FloatArray = points * state.target_scale
        if self.layout.target_scale is not None:
            world = points * (state.target_scale + errors[:, self.layout.target_scale])[:, None, None]
        rows = None
        if where.readout is not None or known.readout_s != 0.0:
            v = self._rows_guess(camera, t_cam_s, points, motion, uv)
            rows = v / known.resolution[1] - 0.5
        return view(world, motion, cam, self.rates, t_cam_s - state.t_s, known.distortion_model, rows)

    def _rows_guess(
        self, camera: str, t_cam_s: float, points: FloatArray, motion: object, uv: FloatArray | None
    ) -> FloatArray:
        """Image row of each point: the measured one, or the one predicted as for a global shutter."""
        if uv is not None:
            return uv[:, 1]
        one = np.zeros((1, self.layout.size))
        known = self.state.cameras[camera]
        flat = view(
            points * self.state.target_scale,
            motion_points(self.state, self.layout, one),
            camera_points(known, self.layout, camera, one),
            self.rates,
            t_cam_s - self.state.t_s,
            known.distortion_model,
        )
        return flat[0, :, 1]

    def _linearise(
        self, camera: str, t_cam_s: float, points: FloatArray, uv: FloatArray, dx: FloatArray, S: FloatArray
    ) -> _Linear:
        """Statistical linearisation about `dx` with spread S (all in the chart of the prior)."""
        errors = dx + unscented.offsets(S)
        pixels = self._project(camera, t_cam_s, points, uv, errors)
        valid = np.isfinite(pixels).all(axis=(0, 2))
        flat = np.where(valid[None, :, None], pixels, 0.0).reshape(len(pixels), -1)
        m = unscented.moments(flat[1:] - flat[0])
        z = (flat[0] + m.shift).reshape(-1, 2)
        at_time = np.zeros_like(z)
        jitter = self.stamp_jitter_s.get(camera, 0.0)
        if jitter > 0.0:
            h = 1e-4
            base = flat[0].reshape(-1, 2)
            at_time = (self._project(camera, t_cam_s + h, points, uv, dx[None])[0] - base) * (jitter / h)
        return _Linear(z, m.linear, m.curved, at_time, valid)

    def _corner_gate(
        self, innovation: FloatArray, lin: _Linear, sigma: FloatArray
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Chi-square gate of each corner with its predicted variance (per axis, both axes together)."""
        var = (lin.linear**2).sum(axis=1) + (lin.curved**2).sum(axis=1)
        var = var.reshape(-1, 2) / sigma[:, None] ** 2 + (lin.at_time / sigma[:, None]) ** 2 + 1.0
        passed: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = (innovation**2 / var).sum(
            axis=1
        ) < _CORNER_GATE
        return passed

    def _solve(
        self,
        camera: str,
        t_cam_s: float,
        points: FloatArray,
        uv: FloatArray,
        sigma: FloatArray,
        lin: _Linear,
        keep: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    ) -> tuple[
        FloatArray, FloatArray, float, int, np.ndarray[tuple[int, ...], np.dtype[np.bool_]], tuple[float, int]
    ]:
        """Iterated posterior linearisation; drops corners whose residual stays impossible."""
        prior = self.S
        S, dx = prior, np.zeros(self.layout.size)
        M, offset = lin.linear, np.zeros(2 * len(points))
        for step in range(_ITERATIONS):
            if step:
                lin = self._linearise(camera, t_cam_s, points, uv, dx, S)
                keep = keep & lin.valid
                # H S_prior = (H S) S^-1 S_prior, and the innovation refers to the prior mean
                H = np.linalg.solve(S.T, lin.linear.T).T
                M, offset = H @ prior, H @ dx
            weight = 1.0 / np.repeat(sigma, 2)
            r = ((uv - lin.z).ravel() + offset) * weight
            S, dx_new, nis, dof, keep, rest = self._correct(prior, M * weight[:, None], r, lin, weight, keep)
            moved = np.linalg.norm(np.linalg.solve(S, dx_new - dx)) if step else np.inf
            dx = dx_new
            curved = (lin.curved * weight[:, None])[np.repeat(keep, 2)]
            if float((curved**2).sum(axis=1).max(initial=0.0)) < _CURVED**2 or moved < 0.05:
                break
        return S, dx, nis, dof, keep, rest

    def _correct(
        self,
        prior: FloatArray,
        M: FloatArray,
        r: FloatArray,
        lin: _Linear,
        weight: FloatArray,
        keep: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    ) -> tuple[
        FloatArray, FloatArray, float, int, np.ndarray[tuple[int, ...], np.dtype[np.bool_]], tuple[float, int]
    ]:
        n = prior.shape[0]
        common = self._common_noise(lin, weight)
        full = M if common is None else np.concatenate([M, common], axis=1)
        for _ in range(3):
            rows = np.repeat(keep, 2)
            small, r_small, rest, dof_rest = unscented.compress(full[rows], r[rows])
            c = unscented.correct(prior, small[:, :n], r_small, None if common is None else small[:, n:])
            left = (r - full @ c.solution).reshape(-1, 2)
            bad = keep & ((left**2).sum(axis=1) > _RESIDUAL_GATE * max(1.0, rest / max(dof_rest, 1)))
            if not bad.any() or (keep & ~bad).sum() < 4:
                break
            keep = keep & ~bad
        return c.S, c.dx, c.nis, len(r_small), keep, (rest, dof_rest)

    @staticmethod
    def _common_noise(lin: _Linear, weight: FloatArray) -> FloatArray | None:
        """Whitened noise shared by the corners of a frame: stamp jitter, and curvature while it matters."""
        columns = []
        if lin.at_time.any():
            columns.append((lin.at_time.ravel() * weight)[:, None])
        curved = lin.curved * weight[:, None]
        if float((curved**2).sum(axis=1).max(initial=0.0)) > 1e-4:
            columns.append(curved)
        return np.concatenate(columns, axis=1) if columns else None

    def _accept(self, S: FloatArray, dx: FloatArray) -> None:
        """Move the nominal state and carry the covariance into the new chart (reset Jacobian of the GRP)."""
        self.S = S
        turned = [ATTITUDE] + [c.rotation for c in self.layout.cameras.values() if c.rotation is not None]
        if max(float(np.abs(dx[s]).max()) for s in turned) > 1e-4:
            for s in turned:
                half = 0.5 * dx[s]
                J = np.eye(3) + np.array(
                    [[0, half[2], -half[1]], [-half[2], 0, half[0]], [half[1], -half[0], 0]]
                )
                self.S[s] = J @ self.S[s]
            self.S = unscented.lower_root(self.S)
        self.state = retract(self.state, self.layout, dx)

    def reset_motion(self, R_world_imu: FloatArray, p_world_imu: FloatArray) -> None:
        """Forget where the rig is and keep the calibration: motion anew, with no tie to the rest."""
        self.state.R_world_imu, self.state.p_world_imu = R_world_imu, p_world_imu
        self.state.v_world_imu = np.zeros(3)
        A = np.zeros((self.layout.size, self.layout.size + 9))
        A[:, :-9] = self.S
        A[MOTION] = 0.0
        A[MOTION, -9:] = np.diag([0.1] * 3 + [0.1] * 3 + [1.0] * 3)
        self.S = unscented.lower_root(A)

    def sigmas(self) -> FloatArray:
        """Standard deviation of every error, shape (n,)."""
        return np.asarray(np.sqrt((self.S**2).sum(axis=1)))

    def covariance(self, rows: list[int]) -> FloatArray:
        """Covariance of chosen errors, shape (k, k)."""
        part = self.S[rows]
        return np.asarray(part @ part.T)
