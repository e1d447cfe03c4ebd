"""The filter: square-root sigma-point propagation with the IMU and update with the points of one image.

Equations and derivation: docs/math/filter.md. `StatusEvaluator` decides the status of a result. The
filter never raises on data: each update returns a verdict.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from vical_daemon.estimation.filter import noise_updates
from vical_daemon.estimation.filter.image_update import (
    ImageFit,
    blurred,
    corner_gate,
    curved_share,
    frame_limit,
    log_likelihood,
    rows_of,
    solve,
    whitened,
)
from vical_daemon.estimation.filter.jump_scores import JumpSizes
from vical_daemon.estimation.filter.lever_arm_score import (
    MOTION_ERRORS,
    UNCERTAIN,
    LeverArmScore,
    information,
)
from vical_daemon.estimation.filter.linearise import (
    Image,
    Linear,
    LinearityMonitor,
    bend_by_jitter,
    by_derivatives,
    by_sigma_points,
    is_rolling,
    move_rows_by_noise,
    view_derivatives,
)
from vical_daemon.estimation.filter.passed import Corrected, Moved
from vical_daemon.estimation.filter.propagate import Propagated, move_by_derivatives, move_by_sigma_points
from vical_daemon.estimation.filter.reset import move
from vical_daemon.estimation.filter.unobservable_directions import UnobservableDirections
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.measurements import LEAST_POINTS, BoolArray, FloatArray, ImuNoise, PointsFrame
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import ACCEL_BIAS_SIGMA_MPS2, GRAVITY_SIGMA_RAD, GYRO_BIAS_SIGMA_RPS
from vical_daemon.estimation.model.rates import Rates, rates_after
from vical_daemon.estimation.model.state import (
    ACCEL_BIAS,
    BIASES,
    GRAVITY,
    GYRO_BIAS,
    MOTION,
    Layout,
    MotionStart,
    State,
    gravity_root,
)
from vical_daemon.estimation.noise.consistency import Consistency, normalised
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.noise.lens_agreement import LensAgreement
from vical_daemon.estimation.noise.shared_errors import WAYS, SharedErrors, shared_ways
from vical_daemon.estimation.robust import median
from vical_daemon.estimation.significance import SURE_SIGMAS


@dataclass(slots=True)
class CalibrationFilter:
    """State and covariance with the two steps of the filter.

    Attributes:
        state: Nominal state at `state.t_s`.
        layout: Where the errors live.
        S: Upper-triangular square root of the covariance, shape (n, n).
        imu_noise: Densities.
        corner_noise: Measured corner noise by camera.
        walk: Variance per second added to each error outside the motion model (drift of the time shift,
            slow change of the mounting), shape (n,).
        consistency: Measured consistency, by camera.
        agreement: How far stretches of the data agree about the lens, by camera.
        shared: Measured errors that the corners of an image share, by camera.
        unobservable: After a partial start: axes along which lever arms are not known.
        absent: Cameras that have not seen the target: their errors have no meaning yet.
        drifting: Cameras whose clocks are known not to run as the imu's does (see `clock_drift`).
        wandered: When their drift was found to be another, s, and its values, s/s.
        off: What is known to be off, as in `CalibrationOptions.estimate` (see `model_selection`).
        rates: Rates at the state's instant.
        nis_level: Recent level of NIS per degree of freedom; starts tolerant, scales the gate of images.
        stamp_sigma_s: How well the imu's stamps are known as a whole, by its driver, s.
        began_s: When the data of this filter begin, s.
        arm_score: Bias of lever arms and size by noise; None: no image yet, or the motion was lost.
        arm_scores: What it has given so far, 1/m and 1, shape (3 cameras + 1,); 0: nothing yet.
        by_clipping: See `Influence`, of the latest segment.
        jumped: Of a copy that knows of a jump.
        passed: What was done since this was emptied last (see `RecentPast`).
    """

    state: State
    layout: Layout
    S: FloatArray
    imu_noise: ImuNoise
    corner_noise: dict[str, CornerNoise]
    walk: FloatArray
    consistency: dict[str, Consistency] = field(default_factory=dict)
    agreement: dict[str, LensAgreement] = field(default_factory=dict)
    shared: dict[str, SharedErrors] = field(default_factory=dict)
    unobservable: UnobservableDirections | None = None
    absent: frozenset[str] = frozenset()
    drifting: set[str] = field(default_factory=set)
    wandered: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    off: set[str] = field(default_factory=set)
    rates: Rates = field(default_factory=lambda: Rates(np.zeros(3), np.zeros(3)))
    nis_level: float = 4.0
    stamp_sigma_s: float = 0.0
    began_s: float = 0.0
    arm_score: LeverArmScore | None = None
    arm_scores: FloatArray | float = 0.0
    by_clipping: FloatArray | None = None
    jumped: JumpSizes | None = None
    passed: list[Moved | Corrected] = field(default_factory=list)
    _motion_straight: LinearityMonitor = field(default_factory=LinearityMonitor)
    _view_straight: dict[str, LinearityMonitor] = field(default_factory=dict)

    # ------------------------------------------------------------------ propagation
    def predict(self, segment: ImuSegment) -> None:
        """Propagate to the end of a segment that starts at the state's instant."""
        if len(segment.t_s) < 2 or segment.t_s[-1] <= segment.t_s[0]:
            self.rates = rates_after(self.state, segment, self.rates)
            return
        state = self.state
        moved, Q = self._moved(segment)
        self.by_clipping = moved.influence.by_clipping()
        if self.jumped is not None:
            self.jumped.predict(moved.linear, self.S)
            self._drift(self.jumped.D, self.jumped.D, moved.seconds)
        self._grow(moved, Q)
        self._predict_score(moved, Q)
        state.R_world_imu, state.p_world_imu, state.v_world_imu = moved.R, moved.p, moved.v
        state.t_s = float(segment.t_s[-1])
        self.rates = rates_after(state, segment, self.rates)

    def doubt_motion(self) -> None:
        """Before a gap in the images, inflate the motion's covariance for lasting image errors.

        The covariance assumes that image errors are independent. From image to image that hardly matters;
        over a gap of a second a wrong velocity moves all corners.
        """
        more = max((c.factor for c in self.consistency.values()), default=1.0) - 1.0
        if more > 0.0:
            columns = np.zeros_like(self.S)
            columns[MOTION] = np.sqrt(more) * self.S[MOTION]
            self.inflate_covariance(columns)

    def _predict_score(self, moved: Propagated, Q: FloatArray) -> None:
        if self.arm_score is not None:
            noise = self.imu_noise
            walk = moved.seconds * np.array([noise.gyro_walk**2] * 3 + [noise.accel_walk**2] * 3)
            self.arm_score.predict(moved.slopes, Q, walk)

    def _moved(self, segment: ImuSegment) -> tuple[Propagated, FloatArray]:
        """Motion at the end of a segment, and covariance of the process noise."""
        S = self.S[: self.layout.dynamic]
        sigmas = np.sqrt(np.vecdot(S, S))
        straight = self._motion_straight.holds(sigmas)
        if straight:
            moved = move_by_derivatives(self.state, self.layout, S, segment)
        else:
            moved = move_by_sigma_points(self.state, self.layout, S, segment)
        Q = moved.influence.noise(self.imu_noise)
        if not straight:
            share = np.sqrt(np.vecdot(moved.curved, moved.curved) / np.diag(Q)).max()
            self._motion_straight.measured(sigmas, float(share))
        return moved, Q

    def _grow(self, moved: Propagated, Q: FloatArray) -> None:
        """Move the motion's rows of the square root, and add the noise."""
        c, S = moved.curved.shape[1], self.S.copy()
        S[MOTION] = moved.linear
        noise = self._random_walk(moved.seconds, after=c + 9)
        noise[MOTION, :c] = moved.curved
        noise[MOTION, c : c + 9] = unscented.root(Q)
        self._propagate(S, noise, moved.linear, moved.seconds)

    def _propagate(self, S: FloatArray, noise: FloatArray, linear: FloatArray, seconds: float) -> None:
        """Let time shifts drift, in a new square root as well, and add noise to its first rows."""
        self._drift(S, self.S, seconds)
        for name, where in self.layout.cameras.items():
            if where.timeshift is not None and where.skew is not None:
                self.state.cameras[name].timeshift_s += seconds * self.state.cameras[name].skew
        unscented.grow(S, noise)
        self.passed.append(Moved(self.S, S, linear, seconds))
        self.S = S

    # ------------------------------------------------------------------ update
    def update(self, image: Image) -> FrameReport:
        """Correct the state with the points of one image; return the verdict."""
        noise = self.corner_noise[image.camera]
        lin = self._linearise(image)
        innovation = image.uv - lin.z
        predicted = lin.z if lin.valid.all() else np.where(lin.valid[:, None], lin.z, np.nan)
        keep, blur = lin.valid & self._belonging(image, innovation, lin), 1.0
        if 2 * np.count_nonzero(keep) < np.count_nonzero(lin.valid):
            blur = blurred(image, innovation, lin)
            image = replace(image, sigma_px=blur * image.sigma_px)
            keep = lin.valid & self._belonging(image, innovation, lin)
        if np.count_nonzero(keep) < LEAST_POINTS:
            return self._refused(image, innovation, predicted)
        fit = solve(image, self.S, lin, keep, partial(self._by_points, image))
        level = fit.nis / max(fit.dof, 1)
        if self._misses_gate(fit):
            self.nis_level += 0.02 * (min(level, 4.0 * self.nis_level) - self.nis_level)
            return self._refused(image, innovation, predicted)
        self.nis_level += 0.05 * (level - self.nis_level)
        noise_updates.learn(self, image, lin, fit)
        score = self._arm_score(image, lin, fit)
        self.arm_scores = self.arm_scores + score
        before = self.S
        after, carried = self._accept(fit.S, self._unbiased(fit.dx, score, fit.S), image.camera)
        rows = whitened(image, lin, fit) if lin.curved.size else (fit.ways, fit.r)
        self.passed.append(Corrected(before, after, carried, *rows, lin.moves))
        noise.learn(fit.rest * image.scale * blur**2, fit.dof_rest)
        keep = fit.keep
        residual = fit.left * image.sigma_px[:, None]
        if self.layout.held:
            residual += self._by_held(lin)
        self.consistency[image.camera].learn(
            image.t_cam_s,
            lin.z[keep],
            innovation[keep],
            lin.ways[rows_of(keep)],
            lin.moves,
            image.sigma_px[keep] * fit.noise,
            None if self.by_clipping is None else lin.by_error[:, :9] @ self.by_clipping,
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
            median(image.sigma_px) * fit.noise,
            predicted_px=predicted,
            log_likelihood=log_likelihood(fit, image),
        )

    def _by_held(self, lin: Linear) -> FloatArray:
        """Contribution of a fixed lens's errors to the residuals, px, shape (n, 2)."""
        lenses = self.layout.held.items()
        rows = np.concatenate([self.S[self.layout.lens(name)] for name, _ in lenses])
        cameras = self.mean.cameras
        off = [
            np.concatenate([cameras[name].intrinsics, cameras[name].distortion]) - lens.values
            for name, lens in lenses
        ]
        L = unscented.root(rows @ rows.T)
        weights = unscented.solve_lower(L, unscented.solve_lower(L, np.concatenate(off)), transposed=True)
        moved = lin.ways @ (lin.by_error @ (self.S @ (rows.T @ weights)))
        return np.asarray(moved.reshape(-1, 2))

    def _belonging(self, image: Image, innovation: FloatArray, lin: Linear) -> BoolArray:
        """Corners that pass their gate, shape (n,)."""
        return corner_gate(image, innovation, lin)

    def _misses_gate(self, fit: ImageFit) -> bool:
        """Whether a whole image misses its gate."""
        return fit.nis > frame_limit(fit.dof) * max(1.0, self.nis_level)

    def _with_shared(self, image: Image, lin: Linear) -> Linear:
        """The linearised image with the noise that its corners share."""
        shared = self.shared.get(image.camera)
        if shared is not None:
            lin.by_shared = lin.by_error @ shared_ways(self.state, self.layout, image.camera)
            if shared.jitter_s or shared.shift_px:
                lin.shared = lin.by_shared * shared.sigmas
            bend_by_jitter(lin, self.state, self.layout, self.rates, image, shared.jitter_s)
        if is_rolling(self.state, self.layout, image.camera):
            density = self.imu_noise.gyro_density
            move_rows_by_noise(lin, self.state, self.layout, self.rates, image, density)
        return lin

    def image(self, frame: PointsFrame, t_cam_s: float, points: FloatArray) -> Image:
        """Make a measurement with the present noise."""
        name, scale = frame.camera, self.consistency[frame.camera].scale
        sigma = self.corner_noise[name].sigmas(frame.sigma_px, len(frame.ids)) * math.sqrt(scale)
        return Image(name, frame.t_cam_ns, t_cam_s, frame.ids, points, frame.uv_px, sigma, scale)

    @staticmethod
    def _refused(image: Image, residual: FloatArray, predicted: FloatArray) -> FrameReport:
        none = np.zeros(len(image.ids), dtype=bool)
        return FrameReport(
            *(image.t_ns, image.camera, image.ids, image.uv, residual, none, False),
            predicted_px=predicted,
            log_likelihood=log_likelihood(None, image),
        )

    def prediction_nis(self, image: Image) -> float | None:
        """Mean squared innovation of an image in the smooth modes, over its prediction."""
        lin = self._linearise(image)
        keep = lin.valid & corner_gate(image, image.uv - lin.z, lin)
        if keep.sum() < len(keep) // 2:
            return SURE_SIGMAS**2
        shown = lin.z[keep], (image.uv - lin.z)[keep], lin.ways[rows_of(keep)], lin.moves
        normal = normalised(*shown, image.sigma_px[keep])
        return None if normal is None else float(normal @ normal) / len(normal)

    def _linearise(self, image: Image) -> Linear:
        """The image about the nominal state, with the spread of the prior."""
        rolling = is_rolling(self.state, self.layout, image.camera)
        straight, sigmas = self._view_straight.setdefault(image.camera, LinearityMonitor()), self.sigmas()
        if not rolling and straight.holds(sigmas):
            return self._with_shared(
                image, by_derivatives(self.state, self.layout, self.rates, image, self.S)
            )
        lin = self._by_points(image, np.zeros(self.layout.size), self.S)
        straight.measured(sigmas, curved_share(image, lin, lin.valid))
        return lin

    def _by_points(self, image: Image, dx: FloatArray, S: FloatArray) -> Linear:
        return self._with_shared(image, by_sigma_points(self.state, self.layout, self.rates, image, dx, S))

    def _accept(self, S: FloatArray, dx: FloatArray, camera: str) -> tuple[FloatArray, FloatArray]:
        """Take a correction by an image of a camera: square root of the covariance, and step of the state.

        Returns:
            The square root, and what its columns are as errors of the new state.
        """
        jumps = None if self.jumped is None else self.jumped.D
        moved = move(self.state, self.layout, S, dx, camera, jumps)
        self.state, self.S = moved.state, moved.S
        return moved.before, moved.carried

    def step(self, dx: FloatArray) -> None:
        """Move the nominal state by errors, shape (n,); what is known of them stays."""
        seen = next(name for name in self.layout.cameras if name not in self.absent)
        self._accept(self.S.copy(), dx, seen)

    def _arm_score(self, image: Image, lin: Linear, fit: ImageFit) -> FloatArray:
        """Bias that this image adds to the information vector, see `LeverArmScore.update`."""
        if self.arm_score is None:
            covariance = self.S[:MOTION_ERRORS] @ self.S[:MOTION_ERRORS].T
            self.arm_score = LeverArmScore.of(covariance, len(self.layout.cameras))
        ways, by_error, by_shared = fit.ways, lin.by_error, lin.by_shared
        if len(by_error) >= self.layout.size:  # by sigma points: the ways are not those of the camera
            ways, by_error = view_derivatives(self.state, self.layout, self.rates, image)[1:]
            ways = ways[rows_of(fit.keep)] / np.repeat(image.sigma_px[fit.keep] * fit.noise, 2)[:, None]
            by_shared = by_error @ shared_ways(self.state, self.layout, image.camera)
        information, shared = ways[:, :6].T @ ways[:, :6], self.shared.get(image.camera)
        if shared is not None:  # what corners share is noise, too
            alike = ways @ (by_shared * shared.sigmas)
            L = unscented.root(unscented.unit(WAYS) + alike.T @ alike)
            known = unscented.solve_lower(L, alike.T @ ways[:, :6])
            information -= known.T @ known
        at = list(self.layout.cameras).index(image.camera)
        to_cam = self.state.cameras[image.camera].R_imu_cam.T
        score = self.arm_score.update(information, by_error[:6, :MOTION_ERRORS], to_cam, at)
        if fit.again:  # its derivatives do not have the error of the prediction
            score[-1] = 0.0
        return score

    def _unbiased(self, dx: FloatArray, score: FloatArray, S: FloatArray) -> FloatArray:
        """A correction, shape (n,), without its bias by `_arm_score`."""
        return np.asarray(dx + self._step_by(score, S))

    def allowing_for_arm_bias(self) -> CalibrationFilter:
        """The filter with sigmas that include the uncertainty of the subtracted bias.

        Its `S` has one column more, the first: the last may be that of `model_mixture.joined`.
        """
        if not np.any(self.arm_scores):
            return self
        left = UNCERTAIN * self._step_by(np.asarray(self.arm_scores), self.S)
        return replace(self, S=np.concatenate([left[:, None], self.S], axis=1))

    def _step_by(self, score: FloatArray, S: FloatArray) -> FloatArray:
        """Step of the state by a score of all lever arms and the target's size, with the covariance S S'."""
        return np.asarray(S @ (S.T @ information(score, self.state, self.layout)))

    def finite(self) -> bool:
        """Whether state and covariance are finite."""
        values = [self.S, self.state.v_world_imu, *(c.p_imu_cam for c in self.state.cameras.values())]
        return math.isfinite(sum(float(x.sum()) for x in values))  # of infinite terms no sum is finite

    def forget(self, index: int, sigma: float) -> None:
        """Set one error's sigma to `sigma`, independent of the others."""
        self.S = self.S.copy()  # `passed` refers to it
        self.S[index] = 0.0
        self.reopen(index, sigma)

    def reopen(self, index: int, sigma: float) -> None:
        """Add independent uncertainty to one error."""
        self.inflate_covariance(sigma * unscented.unit(self.layout.size)[index])

    def inflate_covariance(self, columns: FloatArray) -> None:
        """Add the covariance `columns columns'`; directions of the errors, shape (n,) or (n, k)."""
        added = columns.reshape(self.layout.size, -1)
        self.S = unscented.upper_root(np.concatenate([self.S, added], axis=1))

    def restart_motion(self, motion: MotionStart) -> None:
        """Replace the motion and keep the calibration, with process noise up to that time.

        Args:
            motion: The new motion, independent of the filter's state; of another recording also its
                biases and gravity, which are known as well as at any start.
        """
        state, dt, root = self.state, motion.elapsed_s, np.diag(motion.sigmas)
        if motion.turned is not None:
            self._turn_gravity(motion.turned)
        size_rows = np.zeros((0, self.layout.size))  # gravity has the size that it had
        if motion.biases is not None:
            b = motion.biases
            sigmas = np.repeat([GYRO_BIAS_SIGMA_RPS, ACCEL_BIAS_SIGMA_MPS2], 3)
            root = block_diag(root, np.diag(sigmas), gravity_root(b.gravity, GRAVITY_SIGMA_RAD, 0.0))
            before, after = (g / np.linalg.norm(g) for g in (state.gravity, b.gravity))
            size_rows = np.outer(after, before @ self.S[GRAVITY])
            state.gyro_bias, state.accel_bias, state.gravity = b.gyro_bias, b.accel_bias, b.gravity
        new = len(root)  # motion, or all up to gravity
        S, noise = self.S.copy(), self._random_walk(dt, after=new, rows=new)
        S[:new] = noise[:new] = 0.0
        S[new - len(size_rows) : new] = size_rows
        noise[:new, :new] = root
        self._propagate(S, noise, S[MOTION].copy(), dt)
        self.arm_score = None
        state.t_s, state.R_world_imu = motion.t_s, motion.R_world_imu
        state.p_world_imu, state.v_world_imu = motion.p_world_imu, motion.v_world_imu
        for consistency in self.consistency.values():
            consistency.settle()

    def _turn_gravity(self, turned: FloatArray) -> None:
        """Turn gravity with the target, shape (3, 3); the IMU may have turned instead."""
        state, in_doubt = self.state, np.zeros((self.layout.size, 3))
        state.gravity = turned @ state.gravity
        in_doubt[GRAVITY] = gravity_root(state.gravity, float(np.linalg.norm(so3.log(turned))), 0.0)
        self.S = self.S.copy()  # `passed` refers to it
        self.S[GRAVITY] = turned @ self.S[GRAVITY]
        self.inflate_covariance(in_doubt)

    def _random_walk(self, dt: float, after: int, rows: int = BIASES.stop) -> FloatArray:
        """Columns that biases and what else wanders gain in `dt` seconds, after some of zeros, (m, k).

        Of the first errors, at least `rows`, up to the last that wanders.
        """
        drift = self.walk.nonzero()[0]
        columns = np.zeros((max([BIASES.stop, rows, *drift + 1]), after + 6 + len(drift)))
        noise, root_s = self.imu_noise, math.sqrt(dt)
        columns[GYRO_BIAS, after : after + 3] = (noise.gyro_walk * root_s) * so3.IDENTITY
        columns[ACCEL_BIAS, after + 3 : after + 6] = (noise.accel_walk * root_s) * so3.IDENTITY
        columns[drift, after + 6 + np.arange(len(drift))] = root_s * np.sqrt(self.walk[drift])
        return columns

    def _drift(self, A: FloatArray, S: FloatArray, dt: float) -> None:
        """Let errors of time shifts in `A` drift for `dt` seconds by those of the rates in `S`."""
        for shift, rate in self.layout.drifts:
            A[shift] += dt * S[rate]

    def copy(self, earlier: CalibrationFilter | None = None) -> CalibrationFilter:
        """A filter that can run ahead of this one; both share the measured noise.

        Args:
            earlier: A copy that was run as far ahead before: the same derivatives will do as long as its
                sigmas were as large.
        """
        return replace(
            self,
            state=deepcopy(self.state),
            S=self.S.copy(),
            arm_score=deepcopy(self.arm_score),
            passed=[],
            _motion_straight=LinearityMonitor() if earlier is None else earlier._motion_straight,
            _view_straight={} if earlier is None else earlier._view_straight,
        )

    @property
    def mean(self) -> State:
        """The most likely state; `state` is where the filter is linearised, which is the same here."""
        return self.state

    def sigmas(self) -> FloatArray:
        """Standard deviation of every error, shape (n,)."""
        return np.asarray(np.sqrt(np.vecdot(self.S, self.S)))

    def covariance(self, rows: list[int]) -> FloatArray:
        """Covariance of chosen errors, shape (k, k)."""
        part = self.S[rows]
        return np.asarray(part @ part.T)
