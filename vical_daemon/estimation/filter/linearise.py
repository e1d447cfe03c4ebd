"""How an image depends on the state: by sigma points, or by derivatives where the spread is small.

Sigma points see the second-order part of the model. Once that part is far below the corner noise, they cost
fifty projections and say what one derivative says: then the derivative is taken. Which of the two holds is
*measured*, and measured again when a sigma has grown or some time has passed. [docs/math/filter.md, eq. (11)]

An image can move in few ways only: six with the pose of the camera, some with its lens. So the derivatives by
forty errors of the state are kept as a product, rows by ways times ways by errors, and whatever goes through
all rows of an image goes through fourteen columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from scipy.linalg import block_diag

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project, project_jacobians
from vical_daemon.estimation.inertial.imu_model import Motion
from vical_daemon.estimation.measurements import BoolArray, FloatArray, IntArray
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.model.camera_rays import read_share
from vical_daemon.estimation.model.rates import Rates
from vical_daemon.estimation.model.retract import CameraPoints, camera_points, pose_points
from vical_daemon.estimation.model.state import ATTITUDE, POSITION, VELOCITY, CameraState, Layout, State
from vical_daemon.estimation.model.target_modes import MODES
from vical_daemon.estimation.noise.shared_errors import ANNOUNCED_S
from vical_daemon.estimation.plausible import MOST_PX

_FLAT = 0.02  # second-order part over corner noise below which the model is straight
_GROWN = 1.5  # a sigma this many times larger than when it was measured: measure again
_STEP = 1e-3  # of a sigma: so small that differences are derivatives
_ROW_STEPS = 2  # to the row that shows a corner; each leaves a tenth of the error at most
_TRUST = 100  # images for which a measurement of the second-order part holds


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
        sigma_px: Usual white noise of each corner per axis, px, shape (n,).
        scale: By which `Consistency` has multiplied its square.
    """

    camera: str
    t_ns: int
    t_cam_s: float
    ids: IntArray
    points: FloatArray
    uv: FloatArray
    sigma_px: FloatArray
    scale: float = 1.0


@dataclass
class Linear:
    """One image linearised: z + ways (spread e + shared c) + curved u, in pixels; e, c, u ~ N(0, I).

    Attributes:
        z: Mean of the predicted pixels, shape (n, 2).
        ways: How pixels move in each of the k ways in which the image can move, shape (2n, k).
        by_error: The ways by the errors of the state: the derivatives are H = ways @ by_error; shape (k, c).
        spread: `by_error` S, shape (k, c).
        curved: Square root of the second-order covariance, shape (2n, q); q = 0 where it is negligible.
        valid: Points in front of the camera, shape (n,).
        shared: Square root of the noise that all corners share, in the same ways (a late stamp moves them
            all), shape (k, r).
        by_shared: The ways by one unit of each of these errors (see `shared_ways`), shape (k, 3); empty: they
            are not measured.
    """

    z: FloatArray
    ways: FloatArray
    by_error: FloatArray
    spread: FloatArray
    curved: FloatArray
    valid: BoolArray
    shared: FloatArray
    by_shared: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @cached_property
    def moves(self) -> FloatArray:
        """Square root of how far what corners share and states move the image, shape (k, r + c)."""
        return np.concatenate([self.shared, self.spread], axis=1) if self.shared.size else self.spread


def project_errors(
    state: State,
    layout: Layout,
    rates: Rates,
    camera: str,
    t_cam_s: float,
    points: FloatArray,
    uv: FloatArray | None,
    errors: FloatArray,
) -> FloatArray:
    """Pixels of target points for a batch of state errors.

    Args:
        state: Nominal state.
        layout: Where the errors live.
        rates: Rates at the state's instant.
        camera: Name.
        t_cam_s: Image stamp, s since the base.
        points: Points of the target, m, shape (n, 3).
        uv: Pixels that tell the rows of a rolling shutter, shape (n, 2); None: those predicted here.
        errors: Shape (S, size).

    Returns:
        Pixels, shape (S, n, 2).
    """
    known = state.cameras[camera]
    motion = pose_points(state, errors)
    cam = camera_points(known, layout, camera, errors)
    motion = motion._replace(p=motion.p + _kept_straight(state, known, motion.R, cam.p_imu_cam, errors))
    world: FloatArray = points * state.target_scale
    if layout.target_scale is not None:
        world = points * (state.target_scale + errors[:, layout.target_scale])[:, None, None]
    if layout.target_modes is not None and layout.target_shape is not None:
        shapes = state.target_shape + errors[:, layout.target_shape]
        world = world + np.einsum("npm,sm->snp", layout.target_modes.fields(points), shapes)
    ahead = t_cam_s - state.t_s
    project = partial(view, world, motion, cam, rates, ahead, known.distortion_model)
    if not is_rolling(state, layout, camera):
        return project()
    rows = None if uv is None else read_share(uv, known.resolution, known.readout_axis)
    for _ in range(_ROW_STEPS if uv is None else 0):
        rows = read_share(project(rows), known.resolution, known.readout_axis)
    return project(rows)


def _kept_straight(
    state: State, known: CameraState, R: FloatArray, p_imu_cam: FloatArray, errors: FloatArray
) -> FloatArray:
    """Added to the positions of sigma points: those of the camera are linear in the errors, see `reset`."""
    arm = known.p_imu_cam
    straight = p_imu_cam - np.cross(arm, errors[:, ATTITUDE])
    return np.asarray(straight @ state.R_world_imu.T - np.matvec(R, p_imu_cam))


def bend_by_jitter(
    lin: Linear, state: State, layout: Layout, rates: Rates, image: Image, jitter_s: float
) -> None:
    """Add to mean and covariance what stamps that jitter do to second order, in place; by their sigma points.

    A camera does not go on at one rate along a straight line, so an image early and one late do not cancel.
    """
    at = layout.cameras[image.camera].timeshift
    if at is None or jitter_s < ANNOUNCED_S:
        return
    errors = np.zeros((3, layout.size))
    errors[1:, at] = jitter_s, -jitter_s
    uv = project_errors(state, layout, rates, image.camera, image.t_cam_s, image.points, image.uv, errors)
    bent = 0.5 * (uv[1] + uv[2]) - uv[0]
    bent = np.where(lin.valid[:, None] & np.isfinite(bent), bent, 0.0)
    lin.z = lin.z + bent
    # the variance of a square is twice its squared mean
    _move_more(lin, math.sqrt(2.0) * bent.reshape(-1, 1))


def _move_more(lin: Linear, ways: FloatArray) -> None:
    """Ways more in which noise of unit variance moves the image, and no error of the state; shape (2n, r)."""
    r = ways.shape[1]
    lin.ways = np.concatenate([lin.ways, ways], axis=1)
    lin.by_error, lin.spread, lin.by_shared = (
        np.concatenate([x, np.zeros((r, x.shape[1]))]) for x in (lin.by_error, lin.spread, lin.by_shared)
    )
    lin.shared = block_diag(lin.shared, unscented.unit(r))


def move_rows_by_noise(
    lin: Linear, state: State, layout: Layout, rates: Rates, image: Image, gyro_density: float
) -> None:
    """Add to the covariance of an image what the gyro's noise turns its rows by, in place."""
    ways = rows_by_noise(state, layout, rates, image, gyro_density)
    if ways.size:
        _move_more(lin, np.where(np.repeat(lin.valid, 2)[:, None], ways, 0.0))


def rows_by_noise(
    state: State, layout: Layout, rates: Rates, image: Image, gyro_density: float
) -> FloatArray:
    """How the gyro's noise during the readout moves the pixels; of unit variance, shape (2n, 6).

    Rows are placed by the gyro. From the middle row to the last its noise adds up to a turn of `gyro_density`
    times the root of half the readout, about each axis, and independently from the middle one back to the
    first. Global shutters: shape (2n, 0).
    """
    known = state.cameras[image.camera]
    half_s = 0.5 * abs(known.readout_s)
    if half_s == 0.0:
        return np.zeros((2 * len(image.points), 0))
    by_turn = view_derivatives(state, layout, rates, image)[1][:, :3] @ known.R_imu_cam.T
    late_s = known.readout_s * read_share(image.uv, known.resolution, known.readout_axis)
    turned_rad = np.repeat(late_s, 2)[:, None] * (gyro_density / math.sqrt(half_s))
    moved = np.nan_to_num(by_turn * turned_rad, posinf=0.0, neginf=0.0)
    late = turned_rad > 0.0
    return np.concatenate([moved * late, moved * ~late], axis=1)


def is_rolling(state: State, layout: Layout, camera: str) -> bool:
    """Whether a camera has a rolling shutter, or may have one."""
    return layout.cameras[camera].readout is not None or state.cameras[camera].readout_s != 0.0


def by_sigma_points(
    state: State, layout: Layout, rates: Rates, image: Image, dx: FloatArray, S: FloatArray
) -> Linear:
    """Statistical linearisation about `dx` with spread S (all in the chart of the prior).

    Derivatives refer to the rows at which corners are expected: at the measured rows they would contain the
    noise of the corners, and pass for information. The mean refers to the measured rows.
    """
    L = unscented.lower_root(S)
    errors = dx + unscented.offsets(L)
    project = partial(project_errors, state, layout, rates, image.camera, image.t_cam_s, image.points)
    if is_rolling(state, layout, image.camera):
        pixels = project(project(None, errors[:1])[0], errors)
        pixels += project(image.uv, errors[:1]) - pixels[:1]
    else:
        pixels = project(None, errors)
    with np.errstate(invalid="ignore"):  # nan is behind the camera
        valid: BoolArray = np.asarray((np.abs(pixels) < MOST_PX).all(axis=(0, 2)))
    flat = np.where(valid[None, :, None], pixels, 0.0).reshape(len(pixels), -1)
    m = unscented.moments(flat[1:] - flat[0])
    # the columns of L are the ways
    by_error, none = unscented.solve_lower(L, unscented.unit(len(S))), np.zeros((len(S), 0))
    return Linear((flat[0] + m.shift).reshape(-1, 2), m.linear, by_error, by_error @ S, m.curved, valid, none)


def by_small_steps(state: State, layout: Layout, rates: Rates, image: Image, S: FloatArray) -> Linear:
    """The same to first order about the nominal state, by differences; for rolling shutters."""
    steps = np.diag(_STEP * np.sqrt(np.vecdot(S, S)))
    lin = by_sigma_points(state, layout, rates, image, np.zeros(len(S)), steps)
    return replace(lin, spread=lin.by_error @ S, curved=np.zeros((len(lin.ways), 0)))


def by_derivatives(state: State, layout: Layout, rates: Rates, image: Image, S: FloatArray) -> Linear:
    """The same to first order, about the nominal state; global shutter only."""
    uv, ways, by_error = view_derivatives(state, layout, rates, image)
    with np.errstate(invalid="ignore"):  # nan is behind the camera
        valid: BoolArray = np.asarray((np.abs(uv) < MOST_PX).all(axis=1))
    if not valid.all():
        uv, ways = np.where(valid[:, None], uv, 0.0), np.where(np.repeat(valid, 2)[:, None], ways, 0.0)
    k = len(by_error)
    return Linear(uv, ways, by_error, by_error @ S, np.zeros((len(ways), 0)), valid, np.zeros((k, 0)))


def view_derivatives(
    state: State, layout: Layout, rates: Rates, image: Image
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How the pixels move with the camera and its lens, and those with the errors of the state.

    The ways are: the camera turns by phi and moves by tau (in its own frame), d x_cam = x_cam x phi - tau;
    its lens; the size of the target and its shape. Global shutter.
    [docs/math/filter.md, eq. (7); derivatives tested against differences]

    Returns:
        Pixels (n, 2); their derivatives in the k ways, shape (2n, k); the ways by the errors of the state,
        shape (k, size).
    """
    where, cam = layout.cameras[image.camera], state.cameras[image.camera]
    ahead_s = image.t_cam_s + cam.timeshift_s - state.t_s
    turn = so3.exp_one(rates.omega * ahead_s)
    R = state.R_world_imu @ turn
    p = state.p_world_imu + ahead_s * (state.v_world_imu + (0.5 * ahead_s) * rates.accel)
    place = image.points * state.target_scale
    fields = None
    if layout.target_modes is not None and layout.target_shape is not None:
        fields = layout.target_modes.fields(image.points)
        place = place + fields @ state.target_shape
    arm = place - p
    x_cam = (arm @ R - cam.p_imu_cam) @ cam.R_imu_cam
    with np.errstate(all="ignore"):
        uv, J, J_lens = project_jacobians(x_cam, cam.intrinsics, cam.distortion, cam.distortion_model)
    by_error = _pose_by_error(state, layout, rates, image.camera, ahead_s, turn)
    ways = np.empty((2 * len(J), len(by_error)))
    ways[:, :3] = (J @ so3.hat(x_cam)).reshape(-1, 3)  # j' (x x phi)
    np.negative(J.reshape(-1, 3), out=ways[:, 3:6])
    if where.intrinsics is not None and where.distortion is not None:
        n = J_lens.shape[-1]
        ways[:, 6 : 6 + n] = J_lens.reshape(-1, n)
        by_error[6 : 6 + n, where.intrinsics.start : where.distortion.stop] = unscented.unit(n)
    at = len(by_error) - MODES * (layout.target_shape is not None)
    by_point = (J.reshape(-1, 3) @ (R @ cam.R_imu_cam).T).reshape(-1, 2, 3)  # moved in the world
    if layout.target_scale is not None:
        ways[:, at - 1] = np.matvec(by_point, image.points).ravel()
        by_error[at - 1, layout.target_scale] = 1.0
    if fields is not None:
        ways[:, at:] = np.matmul(by_point, fields).reshape(-1, MODES)
        by_error[at:, layout.target_shape] = unscented.unit(MODES)
    return uv, ways, by_error


def _pose_by_error(
    state: State, layout: Layout, rates: Rates, camera: str, ahead_s: float, turn: FloatArray
) -> FloatArray:
    """Turn and move of the camera (first six rows) by the errors of the state; rows of lens and scale are 0.

    A rig that turns by a (imu frame, at the image) turns its camera by phi = R_imu_cam' a and moves it by
    tau = R_imu_cam' (a x p_imu_cam).
    """
    where, cam = layout.cameras[camera], state.cameras[camera]
    lens = 4 + len(cam.distortion) if where.intrinsics is not None else 0
    rows = 6 + lens + (layout.target_scale is not None) + MODES * (layout.target_shape is not None)
    out = np.zeros((rows, layout.size))
    to_cam = cam.R_imu_cam.T
    arm = -to_cam @ so3.hat(cam.p_imu_cam)
    out[0:3, ATTITUDE], out[3:6, ATTITUDE] = to_cam @ turn.T, arm @ turn.T
    from_world = to_cam @ (state.R_world_imu @ turn).T
    out[3:6, POSITION], out[3:6, VELOCITY] = from_world, ahead_s * from_world
    if where.position is not None and where.rotation is not None:
        out[3:6, where.position] = to_cam
        out[0:3, where.rotation] = unscented.unit(3)
    if where.timeshift is not None:
        out[0:3, where.timeshift] = to_cam @ rates.omega
        speed = state.v_world_imu + ahead_s * rates.accel
        out[3:6, where.timeshift] = arm @ rates.omega + from_world @ speed
    return out


@dataclass(slots=True)
class LinearityMonitor:
    """Remembers down to which sigmas a model was seen to be straight.

    Attributes:
        limits: Sigmas up to which it is; empty: not known to be.
        left: Uses for which that holds.
    """

    limits: FloatArray = field(default_factory=lambda: np.zeros(0))
    left: int = 0

    def holds(self, sigmas: FloatArray) -> bool:
        """Whether derivatives will do for this spread; counts down."""
        self.left -= 1
        return self.left > 0 and len(self.limits) == len(sigmas) and bool((sigmas <= self.limits).all())

    def measured(self, sigmas: FloatArray, share: float) -> None:
        """Take a measurement: second-order part over noise at these sigmas."""
        self.limits = _GROWN * sigmas if share < _FLAT else np.zeros(0)
        self.left = _TRUST


def moved(motion: Motion, rates: Rates, delay_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Attitude R Exp(omega d) and position p + v d + a d^2 / 2, a delay d later, s, shape (S,) or (1,)."""
    d = delay_s[:, None]
    R = motion.R @ so3.exp(rates.omega * d + (0.5 * d * d) * rates.alpha)
    p = motion.p + motion.v * d + (0.5 * d * d) * rates.accel
    return R, p


def view(
    points: FloatArray,
    motion: Motion,
    camera: CameraPoints,
    rates: Rates,
    t_cam_minus_state_s: float,
    model: str,
    rows: FloatArray | None = None,
) -> FloatArray:
    """Project target points for a batch of states: the measurement model.

    uv = project( R_imu_cam^T ( R_world_imu(t + shift)^T (X - p_world_imu(t + shift)) - p_imu_cam ) ), with
    the motion `moved` from the state's instant by d = t_cam + shift - t_state. [docs/math/filter.md, eq. (7)]

    Args:
        points: Points in the world, m, shape (n, 3) or (S, n, 3).
        motion: Sigma points of the motion, batch S.
        camera: Sigma points of the camera, batch S or 1.
        rates: Rates at the state's instant.
        t_cam_minus_state_s: Image stamp (camera clock) minus the state's instant (imu clock), s.
        model: radtan or equidistant.
        rows: For a rolling shutter: (v / height - 1/2) of each point, shape (n,); None: global shutter.

    Returns:
        Pixels, shape (S, n, 2); not-a-number behind the camera.
    """
    R, p = moved(motion, rates, t_cam_minus_state_s + camera.timeshift_s)
    x_imu = np.matmul(points - p[:, None, :], R)
    if rows is not None:
        x_imu = x_imu + _rolling(x_imu, motion, R, rates, camera.readout_s, rows)
    x_cam = np.matmul(x_imu - camera.p_imu_cam[:, None, :], camera.R_imu_cam)
    return project(x_cam, camera.intrinsics[:, None, :], camera.distortion[:, None, :], model)


def _rolling(
    x_imu: FloatArray,
    motion: Motion,
    R: FloatArray,
    rates: Rates,
    readout_s: FloatArray,
    rows: FloatArray,
) -> FloatArray:
    """Displacement in the imu frame of points seen `rows * readout` after the middle row, to third order.

    A point X of the world lies at x = R' (X - p), so that x' = -omega x x - u with u = R' v, and likewise for
    the derivatives of both.
    """
    e = (readout_s[:, None] * rows)[..., None]
    w, alpha = rates.omega, rates.alpha
    u = np.matmul(motion.v[:, None, :], R)
    u1 = np.matmul(rates.accel, R)[:, None, :] - so3.cross(w, u)
    u2 = rates.jolt - so3.cross(alpha, u) - so3.cross(w, u1)
    x1 = -so3.cross(w, x_imu) - u
    x2 = -so3.cross(alpha, x_imu) - so3.cross(w, x1) - u1
    x3 = -so3.cross(rates.jerk, x_imu) - 2.0 * so3.cross(alpha, x1) - so3.cross(w, x2) - u2
    return np.asarray(e * (x1 + (0.5 * e) * (x2 + (e / 3.0) * x3)))
