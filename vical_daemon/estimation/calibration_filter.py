"""The filter: square-root sigma-point propagation with the IMU and update with the points of one image.

Equations and derivation: docs/math/filter.md. Nothing here decides *whether* to believe a result; that is
`judge`. The filter never raises on data: each update returns a verdict.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.stats import chi2

from vical_daemon.estimation import unscented
from vical_daemon.estimation.consistency import Consistency, normalised
from vical_daemon.estimation.corner_noise import CornerNoise
from vical_daemon.estimation.imu_model import ImuSegment, Motion, compose, process_noise, strapdown
from vical_daemon.estimation.measurements import BoolArray, FloatArray, ImuNoise, IntArray, PointsFrame
from vical_daemon.estimation.retract import camera_points, motion_points, orthonormal, pose_points, retract
from vical_daemon.estimation.state import (
    ATTITUDE,
    MOTION,
    POSITION,
    VELOCITY,
    Layout,
    State,
    grp_from_rotation,
    rotation_from_grp,
)
from vical_daemon.estimation.target_view import Rates, view

_ITERATIONS = 5
_CURVED = 0.1  # iterate while the second-order part exceeds this share of the corner noise
_CORNER_GATE = float(chi2.isf(1e-4, 2))
_RESIDUAL_GATE = float(chi2.isf(2e-5, 2))
_FRAME_GATE_P = 1e-9
_MAX_ARM_M, _MAX_SPEED_MPS, _MAX_SHIFT_S = 3.0, 30.0, 60.0


@lru_cache(maxsize=256)
def _frame_limit(dof: int) -> float:
    """Chi-square limit of a whole frame (scipy takes half a millisecond for it)."""
    return float(chi2.isf(_FRAME_GATE_P, dof))


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
        predicted_px: Where the points were expected before the update, shape (n, 2); not-a-number where
            they could not be.
    """

    t_ns: int
    camera: str
    ids: IntArray
    uv_px: FloatArray
    residual_px: FloatArray
    accepted: BoolArray
    used: bool
    nis: float = 0.0
    dof: int = 0
    sigma_px: float = 0.0
    reason: str = ""
    predicted_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, slots=True)
class Image:
    """One image as the update sees it.

    Attributes:
        camera: Camera name.
        t_ns: Stamp for the report, camera clock, ns.
        t_cam_s: The same, s since the base.
        ids: Point ids, shape (n,).
        points: Their places in the world, m, shape (n, 3).
        uv: Measured pixels, shape (n, 2).
        sigma_px: White noise of each corner per axis, px, shape (n,).
    """

    camera: str
    t_ns: int
    t_cam_s: float
    ids: IntArray
    points: FloatArray
    uv: FloatArray
    sigma_px: FloatArray


@dataclass(slots=True)
class _Linear:
    """A statistical linearisation of one image: z + H S e + curved + common, in pixels."""

    z: FloatArray
    linear: FloatArray
    curved: FloatArray
    common: FloatArray | None
    valid: BoolArray


@dataclass(slots=True)
class _Fit:
    """Outcome: new root and state step, NIS, who took part, what nothing explains, whitened residuals."""

    S: FloatArray
    dx: FloatArray
    nis: float
    dof: int
    keep: BoolArray
    rest: float
    dof_rest: int
    left: FloatArray


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
        consistency: Measured consistency, by camera.
        stamp_jitter_s: Random error of image stamps, common to all corners of an image, s, by camera.
        rates: Rates at the state's instant.
        nis_level: Recent level of NIS per degree of freedom; starts tolerant, scales the gate of images.
    """

    state: State
    layout: Layout
    S: FloatArray
    imu_noise: ImuNoise
    corner_noise: dict[str, CornerNoise]
    walk: FloatArray
    consistency: dict[str, Consistency] = field(default_factory=dict)
    stamp_jitter_s: dict[str, float] = field(default_factory=dict)
    rates: Rates = field(default_factory=lambda: Rates(np.zeros(3), np.zeros(3)))
    nis_level: float = 4.0

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
        state.R_world_imu = orthonormal(end.R[0] @ rotation_from_grp(m.shift[ATTITUDE]))
        state.p_world_imu = end.p[0] + m.shift[POSITION]
        state.v_world_imu = end.v[0] + m.shift[VELOCITY]
        state.t_s = float(segment.t_s[-1])
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
        for name, where in self.layout.cameras.items():
            if where.timeshift is not None and where.skew is not None:
                A[where.timeshift, :n] += dt * self.S[where.skew]
                self.state.cameras[name].timeshift_s += float(dt) * self.state.cameras[name].skew
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
    def update(self, image: Image) -> FrameReport:
        """Correct the state with the points of one image; the verdict says what became of it."""
        noise = self.corner_noise[image.camera]
        lin = self._linearise(image, np.zeros(self.layout.size), self.S)
        innovation = image.uv - lin.z
        predicted = np.where(lin.valid[:, None], lin.z, np.nan)
        keep = lin.valid & self._corner_gate(image, innovation, lin)
        if keep.sum() < 4:
            return self._refused(image, innovation, predicted, "too few corners pass the gate")
        first = lin
        fit = self._solve(image, lin, keep)
        level = fit.nis / max(fit.dof, 1)
        if fit.nis > _frame_limit(fit.dof) * max(1.0, self.nis_level):
            self.nis_level += 0.02 * (min(level, 4.0 * self.nis_level) - self.nis_level)
            return self._refused(
                image,
                innovation,
                predicted,
                f"innovation of the image is {level:.1f} times what it should be",
            )
        self.nis_level += 0.05 * (level - self.nis_level)
        self._accept(fit.S, fit.dx)
        noise.learn(fit.rest * self.consistency[image.camera].scale, fit.dof_rest)
        keep = fit.keep
        residual = fit.left * image.sigma_px[:, None]
        rows = np.repeat(keep, 2)
        self.consistency[image.camera].learn(
            first.z[keep], innovation[keep], first.linear[rows], image.sigma_px[keep]
        )
        return FrameReport(
            image.t_ns,
            image.camera,
            image.ids,
            image.uv,
            residual,
            keep,
            True,
            fit.nis,
            fit.dof,
            noise.sigma_px,
            predicted_px=predicted,
        )

    def image(self, frame: PointsFrame, t_cam_s: float, points: FloatArray) -> Image:
        """Put a measurement together with the noise it has at present."""
        sigma = self.corner_noise[frame.camera].sigmas(frame.sigma_px, len(frame.ids))
        sigma = sigma * np.sqrt(self.consistency[frame.camera].scale)
        return Image(frame.camera, frame.t_cam_ns, t_cam_s, frame.ids, points, frame.uv_px, sigma)

    @staticmethod
    def _refused(image: Image, residual: FloatArray, predicted: FloatArray, why: str) -> FrameReport:
        none = np.zeros(len(image.ids), dtype=bool)
        return FrameReport(
            image.t_ns, image.camera, image.ids, image.uv, residual, none, False, 0.0, 0, 0.0, why, predicted
        )

    def surprise(self, image: Image) -> float | None:
        """Mean squared innovation of an image in the smooth modes, over its prediction."""
        lin = self._linearise(image, np.zeros(self.layout.size), self.S)
        keep = lin.valid & self._corner_gate(image, image.uv - lin.z, lin)
        if keep.sum() < len(keep) // 2:
            return 36.0
        rows = np.repeat(keep, 2)
        normal = normalised(lin.z[keep], (image.uv - lin.z)[keep], lin.linear[rows], image.sigma_px[keep])
        return None if normal is None else float(normal @ normal) / len(normal)

    def predict_pixels(self, camera: str, t_cam_s: float, points: FloatArray) -> FloatArray:
        """Where points should appear with the nominal state, px, shape (n, 2)."""
        uv: FloatArray = self._project(camera, t_cam_s, points, None, np.zeros((1, self.layout.size)))[0]
        return uv

    def _project(
        self, camera: str, t_cam_s: float, points: FloatArray, uv: FloatArray | None, errors: FloatArray
    ) -> FloatArray:
        state, where = self.state, self.layout.cameras[camera]
        known = state.cameras[camera]
        motion = pose_points(state, errors)
        cam = camera_points(known, self.layout, camera, errors)
        world: FloatArray = points * state.target_scale
        if self.layout.target_scale is not None:
            world = points * (state.target_scale + errors[:, self.layout.target_scale])[:, None, None]
        ahead = t_cam_s - state.t_s
        rows = None
        if where.readout is not None or known.readout_s != 0.0:
            if uv is None:  # the row at which a global shutter would see the point
                uv = view(world, motion, cam, self.rates, ahead, known.distortion_model)[0]
            rows = uv[:, 1] / known.resolution[1] - 0.5
        return view(world, motion, cam, self.rates, ahead, known.distortion_model, rows)

    def _linearise(self, image: Image, dx: FloatArray, S: FloatArray) -> _Linear:
        """Statistical linearisation about `dx` with spread S (all in the chart of the prior)."""
        errors = dx + unscented.offsets(S)
        pixels = self._project(image.camera, image.t_cam_s, image.points, image.uv, errors)
        valid: BoolArray = np.asarray(np.isfinite(pixels).all(axis=(0, 2)))
        flat = np.where(valid[None, :, None], pixels, 0.0).reshape(len(pixels), -1)
        m = unscented.moments(flat[1:] - flat[0])
        z = (flat[0] + m.shift).reshape(-1, 2)
        common = None
        jitter = self.stamp_jitter_s.get(image.camera, 0.0)
        if jitter > 0.0:
            h = 1e-4
            later = self._project(image.camera, image.t_cam_s + h, image.points, image.uv, dx[None])[0]
            common = ((later.ravel() - flat[0]) * (jitter / h))[:, None]
        return _Linear(z, m.linear, m.curved, common, valid)

    @staticmethod
    def _corner_gate(image: Image, innovation: FloatArray, lin: _Linear) -> BoolArray:
        """Chi-square gate of each corner with its predicted variance (per axis, both axes together)."""
        var = (lin.linear**2).sum(axis=1) + (lin.curved**2).sum(axis=1)
        if lin.common is not None:
            var = var + (lin.common**2).sum(axis=1)
        var = var.reshape(-1, 2) + image.sigma_px[:, None] ** 2
        passed: BoolArray = (innovation**2 / var).sum(axis=1) < _CORNER_GATE
        return passed

    def _solve(self, image: Image, lin: _Linear, keep: BoolArray) -> _Fit:
        """Iterated posterior linearisation (once is enough when the prior is tight).

        [Garcia-Fernandez et al., "Posterior linearization filter", 2015]
        """
        prior = self.S
        S, dx = prior, np.zeros(self.layout.size)
        M, offset = lin.linear, np.zeros(2 * len(image.ids))
        weight = 1.0 / np.repeat(image.sigma_px, 2)
        for step in range(_ITERATIONS):
            if step:
                lin = self._linearise(image, dx, S)
                keep = keep & lin.valid
                # H S_prior = (H S) S^-1 S_prior, and the innovation refers to the prior mean
                H = unscented.solve_lower(S, lin.linear.T, transposed=True).T
                M, offset = H @ prior, H @ dx
            r = ((image.uv - lin.z).ravel() + offset) * weight
            fit = self._correct(prior, M * weight[:, None], r, lin, weight, keep)
            step_size = unscented.solve_lower(fit.S, fit.dx - dx)
            S, dx, keep = fit.S, fit.dx, fit.keep
            curved = (lin.curved * weight[:, None])[np.repeat(keep, 2)]
            straight = float((curved**2).sum(axis=1).max(initial=0.0)) < _CURVED**2
            if straight or (step and float(np.linalg.norm(step_size)) < 0.05):
                break
        return fit

    @staticmethod
    def _correct(
        prior: FloatArray, M: FloatArray, r: FloatArray, lin: _Linear, weight: FloatArray, keep: BoolArray
    ) -> _Fit:
        """One linear correction; corners whose residual stays impossible are dropped and it is done again."""
        n = prior.shape[0]
        columns = [M]
        if lin.common is not None:
            columns.append(lin.common * weight[:, None])
        curved = lin.curved * weight[:, None]
        if float((curved**2).sum(axis=1).max(initial=0.0)) > 1e-4:
            columns.append(curved)
        full = np.concatenate(columns, axis=1)
        for _ in range(3):
            rows = np.repeat(keep, 2)
            small, r_small, rest, dof_rest = unscented.compress(full[rows], r[rows])
            c = unscented.correct(prior, small[:, :n], r_small, small[:, n:])
            left = (r - full @ c.solution).reshape(-1, 2)
            bad = keep & ((left**2).sum(axis=1) > _RESIDUAL_GATE * max(1.0, rest / max(dof_rest, 1)))
            if not bad.any() or (keep & ~bad).sum() < 4:
                break
            keep = keep & ~bad
        return _Fit(c.S, c.dx, c.nis, len(r_small), keep, rest, dof_rest, left)

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

    def plausible(self) -> bool:
        """Whether the state is one that a rig can have: finite, arm below 3 m, speed below 30 m/s."""
        state = self.state
        if not (np.isfinite(self.S).all() and float(np.abs(state.v_world_imu).max()) < _MAX_SPEED_MPS):
            return False
        return all(
            float(np.abs(c.p_imu_cam).max()) < _MAX_ARM_M
            and 0.2 < float(c.intrinsics[0]) / c.resolution[0] < 10.0
            and abs(c.timeshift_s) < _MAX_SHIFT_S
            for c in state.cameras.values()
        )

    def reopen(self, index: int, sigma: float) -> None:
        """Add independent uncertainty to one error: what was known about it is in doubt."""
        column = np.zeros((self.layout.size, 1))
        column[index] = sigma
        self.S = unscented.lower_root(np.concatenate([self.S, column], axis=1))

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
