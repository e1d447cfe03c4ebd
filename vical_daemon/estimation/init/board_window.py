"""One window of inertial bundle adjustment over the first seconds, with the target's points known.

Unknowns are the motion at some of the images, and the filter's own constant errors with its own prior and
its own model of an image; links are those of the calibration without a target. Everything is relinearised
until nothing changes, so the lever arm and mounting of the closed form no longer matter.
[docs/math/filter.md, eq. (20)]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.linearise import (
    Image,
    by_small_steps,
    is_rolling,
    rows_by_noise,
    view_derivatives,
)
from vical_daemon.estimation.filter.linearised_filter import Instant, LinearisedFilter, Reference
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.linear_start import LEAST_IMAGES
from vical_daemon.estimation.init.target_poses import TargetPose
from vical_daemon.estimation.measurements import (
    LEAST_POINTS,
    BoolArray,
    FloatArray,
    Frames,
    ImuNoise,
    IntArray,
    PointsFrame,
)
from vical_daemon.estimation.model.imu_scale import APART, numbers_of
from vical_daemon.estimation.model.inertial_links import DONE, RELINK_S, PreintegratedLinks, make_links
from vical_daemon.estimation.model.priors import AGAIN_SIGMAS, SHIFT_SIGMA_S
from vical_daemon.estimation.model.rates import Rates, rates_at
from vical_daemon.estimation.model.retract import difference, orthonormal, retract
from vical_daemon.estimation.model.state import BIASES, GRAVITY, MOTION, State
from vical_daemon.estimation.noise.corner_noise import (
    LEAST_PX,
    MOST_PX,
    POSE_DOF,
    median_noise,
    noise_of_image,
    relative_noise,
)
from vical_daemon.estimation.noise.shared_errors import shared_ways
from vical_daemon.estimation.robust import MOST_STEPS, geman_mcclure_weight
from vical_daemon.estimation.significance import SURE_SIGMAS

_IMAGES = 50  # of each camera: they say where all is linearised, not what is reported
LATE_S = 2e-3  # images less apart share the motion of one instant: a pose is moved there
_EDGE_S = (
    AGAIN_SIGMAS * 2.0 * SHIFT_SIGMA_S
)  # by which the time shift may still move: five sigmas of the least a start is made with


@dataclass(slots=True)
class Node:
    """One instant with the images taken then, and the motion there."""

    frames: Frames
    at: Instant
    rates: Rates


class View(NamedTuple):
    """One image about the present values.

    Attributes:
        node: Index of its instant.
        camera: Its name.
        residual: Measured minus predicted, px, shape (n, 2).
        relative: Noise of each corner over that of the camera, shape (n,).
        seen: Corners that can be predicted, shape (n,).
        ways: See `Linear`, shape (2n, k).
        by_error: See `Linear`, shape (k, size).
        by_shared: The ways by one unit of each of the errors that corners share, see `shared_ways`, (k, 3).
        by_rows: See `rows_by_noise`, shape (2n, r).
    """

    node: int
    camera: str
    residual: FloatArray
    relative: FloatArray
    seen: BoolArray
    ways: FloatArray
    by_error: FloatArray
    by_shared: FloatArray
    by_rows: FloatArray


class Whitened(NamedTuple):
    """One image over its noise.

    Attributes:
        ways: Of `View`, shape (2n, k).
        alike: Likewise by what corners share, each of unit variance, shape (2n, 3); (2n, 0): nothing.
        residual: Shape (2n,).
        left: Residuals without what corners share, px, shape (n, 2).
        square: Sum of squares of the residuals without what corners share, and of that; of corners that do
            not belong only a part (Geman and McClure).
    """

    ways: FloatArray
    alike: FloatArray
    residual: FloatArray
    left: FloatArray
    square: float


class Present(NamedTuple):
    """All of a window about the present values.

    Attributes:
        views: Its images.
        missed: Whitened errors of the links, shape (F - 1, 9).
        by_link: Their derivatives by the motion at both ends and the constants, shape (F - 1, 9, 18 + c).
    """

    views: list[View]
    missed: FloatArray
    by_link: FloatArray


class BoardWindow:
    """Present values of a window. Order of the unknowns: motion of each instant (9), constants.

    Attributes:
        state: Its constants count; the motion is that of the nodes.
        nodes: Instants, in order.
        layout: Of the filter's errors; the constants are all but the motion.
        offset: Of the constants from the mean of the prior, shape (c,).
        sigma_px: Usual corner noise by camera.
        noise: Corner noise of each image over the usual one; empty: not known yet.
        shared: Standard deviations of what the corners of an image share, see `shared_errors`, shape (3,), of
            the cameras for which they are known.
    """

    def __init__(
        self,
        state: State,
        nodes: list[Node],
        links: PreintegratedLinks,
        prior: CalibrationFilter,
        buffer: ImuBuffer,
        target: FloatArray,
    ) -> None:
        self.state, self.nodes, self._buffer, self._target = state, nodes, buffer, target
        self._links = links
        self.layout, self._noise, self._S = prior.layout, prior.imu_noise, prior.S
        root = np.linalg.inv(prior.S[MOTION.stop :, MOTION.stop :])
        self._information = root.T @ root
        self.offset = difference(state, prior.state, prior.layout)[MOTION.stop :]
        self.sigma_px = {name: noise.sigma_px for name, noise in prior.corner_noise.items()}
        self.noise: list[float] = []
        self.shared: dict[str, FloatArray] = {}
        self._measured: list[tuple[FloatArray, FloatArray, FloatArray | None]] = []  # by node, see `rates_at`

    @classmethod
    def begin(
        cls,
        state: State,
        poses: Sequence[TargetPose],
        frames: Frames,
        prior: CalibrationFilter,
        buffer: ImuBuffer,
        target: FloatArray,
    ) -> BoardWindow | None:
        """Choose images, and put the rig at each where the pose of the camera has it."""
        nodes = _nodes(state, poses, frames, buffer)
        if len(nodes) < LEAST_IMAGES:
            return None
        links = _integrated(nodes, state, prior.imu_noise, buffer)
        if links is None:
            return None
        g = state.gravity
        for (a, b), T, dp in zip(pairwise(nodes), links.dt, links.dp, strict=True):
            a.at = a.at._replace(v=(b.at.p - a.at.p - a.at.R @ dp) / T - 0.5 * T * g)
        last = nodes[-2].at
        nodes[-1].at = nodes[-1].at._replace(v=last.v + links.dt[-1] * g + last.R @ links.dv[-1])
        out = cls(replace(state), nodes, links, prior, buffer, target)
        out._read()
        out._find_rates()
        return out

    # ------------------------------------------------------------------ the loop
    def solve(self, now: Present) -> tuple[Present, list[Whitened]] | None:
        """Levenberg-Marquardt until nothing changes.

        Args:
            now: All about the present values.

        Returns:
            All about those before the last step, and its images over their noise; None: that is not reached.
        """
        images, damping = self.whitened(now), 0.0
        for _ in range(MOST_STEPS):
            self._learn_noise(now.views, images)
            images = self.whitened(now)
            H, g = self.normal(now, images)
            H[np.diag_indices_from(H)] *= 1.0 + damping
            try:
                root = cholesky(H, lower=True, overwrite_a=True, check_finite=False)
            except np.linalg.LinAlgError:
                damping = max(10.0 * damping, 1e-9)
                continue
            dx = cho_solve((root, True), g, check_finite=False)
            if float(g @ dx) < DONE and not damping:
                self._move(dx)
                self._follow_shifts()
                return now, images
            cost = self._cost(now, images)
            before = self.state, self.offset, [n.at for n in self.nodes], self._links, self._measured
            self._move(dx)
            if self._stale() and not self._relink():
                return None
            trial = self.present()
            beyond = [] if trial is None else self.whitened(trial)
            if trial is None or not self._cost(trial, beyond) < cost + DONE:
                self.state, self.offset, motion, self._links, self._measured = before
                for node, at in zip(self.nodes, motion, strict=True):
                    node.at = at
                self._find_rates()
                damping = max(10.0 * damping, 1e-9)
                continue
            now, images, damping = trial, beyond, 0.1 * damping if damping > 1e-9 else 0.0
        return None

    def filter(self, prior: CalibrationFilter, reference: Reference | None = None) -> LinearisedFilter:
        """A filter that knows what `prior` knows, linearised about the window; `prior` is used up.

        The reference's own motion is the mean of the prior of the motion, which is wide enough for that.

        Args:
            prior: See above.
            reference: About which it is linearised; None: motion and calibration of the window.
        """
        if reference is None:
            reference = Reference(self.state, [n.at for n in self.nodes])
        t_s, R, p, v = reference.instants[0]
        prior.state = replace(prior.state, t_s=t_s, R_world_imu=R, p_world_imu=p, v_world_imu=v)
        for name, noise in prior.corner_noise.items():
            noise.sigma_px = noise.guess_px = self.sigma_px[name]
        return LinearisedFilter.about(reference, prior)

    # ------------------------------------------------------------------ values
    def at(self, node: Node, camera: str) -> State:
        """The state at an instant; the time shift has drifted until then."""
        known = self.state.cameras[camera]
        known = replace(known, timeshift_s=self._shift_s(camera, node.at.t_s))
        t_s, R, p, v = node.at
        return replace(
            self.state, t_s=t_s, R_world_imu=R, p_world_imu=p, v_world_imu=v, cameras={camera: known}
        )

    def _shift_s(self, camera: str, t_s: float) -> float:
        known = self.state.cameras[camera]
        return known.timeshift_s + known.skew * (t_s - self.nodes[0].at.t_s)

    def _read(self) -> None:
        """Take what the imu measures at the instants from the readings."""
        t_s = np.array([n.at.t_s for n in self.nodes])
        found = self._buffer.intervals(t_s)
        assert found is not None  # links have been made over the same
        segment, begin = found
        at = np.append(begin, len(segment.t_s) - 1)
        trends = [self._buffer.trend(t) for t in t_s.tolist()]
        self._measured = list(zip(segment.gyro[at], segment.accel[at], trends, strict=True))

    def _find_rates(self) -> None:
        for node, measured in zip(self.nodes, self._measured, strict=True):
            node.rates = rates_at(self.state, node.at.R, *measured, node.rates)

    def _stale(self) -> bool:
        """Whether time shifts have left the instants for which links hold."""
        return any(abs(self._late_s(n)) > RELINK_S for n in self.nodes)

    def _late_s(self, node: Node) -> float:
        t_cam_s, frame = node.frames[0]
        return t_cam_s + self._shift_s(frame.camera, node.at.t_s) - node.at.t_s

    def _follow_shifts(self) -> None:
        """Move the instants to where time shifts have them."""
        for node, d in zip(self.nodes, [self._late_s(n) for n in self.nodes], strict=True):
            t_s, R, p, v = node.at
            R = orthonormal(R @ so3.exp_one(d * node.rates.omega))
            p = p + d * (v + 0.5 * d * node.rates.accel)
            node.at = Instant(t_s + d, R, p, v + d * node.rates.accel)

    def _relink(self) -> bool:
        """Move the instants, and integrate between them; False where readings do not reach."""
        self._follow_shifts()
        links = _integrated(self.nodes, self.state, self._noise, self._buffer)
        if links is None:
            return False
        self._links = links
        self._read()
        self._find_rates()
        return True

    def _move(self, dx: FloatArray) -> None:
        motion, constants = dx[: -len(self.offset)].reshape(-1, 9), dx[-len(self.offset) :]
        full = np.concatenate([np.zeros(MOTION.stop), constants])
        before = self.state.cameras
        self.state, self.offset = retract(self.state, self.layout, full), self.offset + constants
        for node, d in zip(self.nodes, motion, strict=True):
            t_s, R, p, v = node.at
            turned, camera = orthonormal(R @ so3.exp_one(d[:3])), node.frames[0][1].camera
            arm, now = before[camera].p_imu_cam, self.state.cameras[camera].p_imu_cam
            # The camera goes where the linear step has it: the product of both changes would displace it.
            seen = p + d[3:6] + R @ (now + so3.hat(d[:3]) @ arm)
            node.at = Instant(t_s, turned, seen - turned @ now, v + d[6:])
        self._find_rates()

    # ------------------------------------------------------------------ one linearisation
    def present(self) -> Present | None:
        """Everything about the present values; None where an image shows too few corners."""
        views = [self._view(k, t, frame) for k, node in enumerate(self.nodes) for t, frame in node.frames]
        good = [v for v in views if v is not None]
        return Present(good, *self._linked()) if len(good) == len(views) else None

    def _view(self, k: int, t_cam_s: float, frame: PointsFrame) -> View | None:
        node, name = self.nodes[k], frame.camera
        relative = relative_noise(frame.sigma_px, len(frame.ids))
        image = Image(
            name, frame.t_cam_ns, t_cam_s, frame.ids, self._target[frame.ids], frame.uv_px, relative
        )
        state, where = self.at(node, name), self.layout.cameras[name]
        if is_rolling(state, self.layout, name):
            lin = by_small_steps(state, self.layout, node.rates, image, self._S)
            uv, ways, by_error = np.where(lin.valid[:, None], lin.z, np.nan), lin.ways, lin.by_error
        else:
            uv, ways, by_error = view_derivatives(state, self.layout, node.rates, image)
        if where.timeshift is not None and where.skew is not None:
            since_s = node.at.t_s - self.nodes[0].at.t_s
            by_error[:, where.skew] = since_s * by_error[:, where.timeshift]
        seen: BoolArray = np.asarray(np.isfinite(uv).all(axis=1))
        if seen.sum() < LEAST_POINTS:
            return None
        residual = np.where(seen[:, None], frame.uv_px - np.where(seen[:, None], uv, 0.0), 0.0)
        ways = np.where(np.repeat(seen, 2)[:, None], ways, 0.0)
        by_shared = by_error @ shared_ways(state, self.layout, name)
        by_rows = rows_by_noise(state, self.layout, node.rates, image, self._noise.gyro_density)
        return View(k, name, residual, relative, seen, ways, by_error, by_shared, by_rows)

    def _linked(self) -> tuple[FloatArray, FloatArray]:
        """See `Present`: missed, by_link."""
        s, layout, links = self.state, self.layout, self._links
        R, p, v = (np.array([getattr(n.at, name) for n in self.nodes]) for name in "Rpv")
        numbers = _numbers(s)
        e, J = links.errors(R, p, v, np.broadcast_to(numbers, (len(R) - 1, len(numbers))), s.gravity)
        T = links.dt[:, None, None]
        Rt = np.swapaxes(R[:-1], 1, 2)
        by_gravity = np.concatenate([np.zeros_like(Rt), -T * Rt, -0.5 * T * T * Rt], axis=1)
        full = np.zeros((len(e), 9, layout.size))
        full[:, :, GRAVITY] = links.root @ by_gravity
        full[:, :, BIASES] = J[:, :, 18:24]
        if layout.gyro_matrix is not None and layout.accel_matrix is not None:
            full[:, :, layout.gyro_matrix.start : layout.accel_matrix.stop] = J[:, :, 24:39]
        if layout.accel_positions is not None:
            full[:, :, layout.accel_positions] = J[:, :, 24:][:, :, APART]
        if layout.accel_lag is not None:
            full[:, :, layout.accel_lag] = J[:, :, -1]
        return e, np.concatenate([J[:, :, :18], full[:, :, MOTION.stop :]], axis=2)

    def normal(
        self, now: Present, images: list[Whitened], *, together: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and right side of the step.

        Args:
            now: Where to linearise.
            images: Its images over their noise.
            together: With the errors that corners share; False: as if corners were independent.
        """
        F = 9 * len(self.nodes)
        n = F + len(self.offset)
        H, g = np.zeros((n, n)), np.zeros(n)

        def add(A: FloatArray, b: FloatArray, first: int) -> None:
            k = len(A) - n + F
            own = slice(first, first + k)
            H[own, own] += A[:k, :k]
            H[own, F:] += A[:k, k:]
            H[F:, F:] += A[k:, k:]
            g[own] += b[:k]
            g[F:] += b[k:]

        for view, (W, A, r, *_) in zip(now.views, images, strict=True):
            information, right = W.T @ W, W.T @ r
            if together:
                across = A.T @ W
                known = np.linalg.solve(np.eye(A.shape[1]) + A.T @ A, np.column_stack([across, A.T @ r]))
                information, right = information - across.T @ known[:, :-1], right - across.T @ known[:, -1]
            add(view.by_error.T @ information @ view.by_error, view.by_error.T @ right, 9 * view.node)
        for k, (e, J) in enumerate(zip(now.missed, now.by_link, strict=True)):
            add(J.T @ J, -J.T @ e, 9 * k)
        H[F:, :F] = H[:F, F:].T
        H[F:, F:] += self._information
        g[F:] -= self._information @ self.offset
        return H, g

    def places(self, node: int) -> IntArray:
        """Where the motion of an instant and the constants are among the unknowns, shape (9 + c,)."""
        first = 9 * len(self.nodes)
        return np.concatenate([np.arange(9 * node, 9 * node + 9), np.arange(first, first + len(self.offset))])

    def whitened(self, now: Present) -> list[Whitened]:
        """All images over the noise; corners that do not belong hardly count (Geman and McClure)."""
        noise = self.noise or [1.0] * len(now.views)
        return [self._whitened(*pair) for pair in zip(now.views, noise, strict=True)]

    def _whitened(self, view: View, noise: float) -> Whitened:
        sigma, sigmas = self.sigma_px[view.camera] * noise * view.relative, self.shared.get(view.camera)
        unit = view.by_rows
        if sigmas is not None:
            unit = np.concatenate([view.ways @ (view.by_shared * sigmas), unit], axis=1)
        left = view.residual
        for _ in range(2 if unit.size else 1):
            far = np.vecdot(left, left) / sigma**2
            weight = np.where(view.seen, np.sqrt(geman_mcclure_weight(far / SURE_SIGMAS**2)), 0.0) / sigma
            twice = np.repeat(weight, 2)
            W, r = view.ways * twice[:, None], view.residual.ravel() * twice
            A = unit * twice[:, None]
            shared = np.linalg.solve(np.eye(A.shape[1]) + A.T @ A, A.T @ r)
            left = view.residual - (unit @ shared).reshape(-1, 2)
        far = np.vecdot(left, left) / sigma**2
        # what is lost from sight costs as much as a gross outlier
        cost = np.where(view.seen, far / (1.0 + far / SURE_SIGMAS**2), SURE_SIGMAS**2)
        return Whitened(W, A, r, left, float(cost.sum() + shared @ shared))

    def _cost(self, now: Present, images: list[Whitened]) -> float:
        """Sum of squares."""
        cost = float((now.missed**2).sum() + self.offset @ self._information @ self.offset)
        return cost + sum(image.square for image in images)

    def _learn_noise(self, views: list[View], images: list[Whitened]) -> None:
        """Corner noise from the median of the residuals, as far as poses have not taken them up."""
        lengths = [
            np.linalg.norm(w.left[v.seen], axis=1) / v.relative[v.seen]
            for v, w in zip(views, images, strict=True)
        ]
        for name in self.sigma_px:
            own = [size for v, size in zip(views, lengths, strict=True) if v.camera == name]
            if own:
                sigma = median_noise(np.concatenate(own), len(own))
                self.sigma_px[name] = float(np.clip(sigma, LEAST_PX, MOST_PX))
        self.noise = []
        for view, size in zip(views, lengths, strict=True):
            dof, ratio = max(2 * len(size) - POSE_DOF, 0), median_noise(size) / self.sigma_px[view.camera]
            self.noise.append(noise_of_image(dof * ratio * ratio, dof))


def _nodes(state: State, poses: Sequence[TargetPose], frames: Frames, buffer: ImuBuffer) -> list[Node]:
    """Evenly chosen images with poses, by instant; velocities are still to be found."""
    originals = {(f.camera, f.t_cam_ns): (t, f) for t, f in frames}  # poses are of rows put right
    chosen: list[tuple[float, TargetPose]] = []
    for name, camera in state.cameras.items():
        own = [p for p in poses if p.frame.camera == name]
        chosen += [(p.t_cam_s + camera.timeshift_s, p) for p in own[:: max(1, -(-len(own) // _IMAGES))]]
    nodes: list[Node] = []
    for t_s, seen in sorted(chosen, key=lambda item: item[0]):
        item = originals.get((seen.frame.camera, seen.frame.t_cam_ns))
        if item is None or not buffer.oldest_s + _EDGE_S < t_s < buffer.newest_s - _EDGE_S:
            continue
        if nodes and t_s - nodes[-1].at.t_s < LATE_S:
            nodes[-1].frames.append(item)
            continue
        camera = state.cameras[seen.frame.camera]
        R = seen.R_target_cam @ camera.R_imu_cam.T
        p = seen.p_target_cam - R @ camera.p_imu_cam
        nodes.append(Node([item], Instant(t_s, R, p, np.zeros(3)), Rates(np.zeros(3), np.zeros(3))))
    return nodes


def _numbers(s: State) -> FloatArray:
    """[biases, entries of the imu's matrices, lag] as links take them, shape (28,)."""
    return np.concatenate([s.gyro_bias, s.accel_bias, numbers_of(s)])


def _integrated(
    nodes: list[Node], state: State, noise: ImuNoise, buffer: ImuBuffer
) -> PreintegratedLinks | None:
    """Links between the instants; None where these are not in order or readings do not reach."""
    t_s = np.array([n.at.t_s for n in nodes])
    if (np.diff(t_s) < 0.5 * LATE_S).any():
        return None
    numbers = _numbers(state)
    return make_links(buffer, t_s, np.broadcast_to(numbers, (len(nodes) - 1, len(numbers))), noise)
