"""How an image depends on the state: by sigma points, or by derivatives where the spread is small.

Sigma points see the second-order part of the model. Once that part is far below the corner noise, they cost
fifty projections and say what one derivative says: then the derivative is taken. Which of the two holds is
*measured*, and measured again when a sigma has grown or some time has passed. [docs/math/filter.md, eq. (11)]
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation import so3, unscented
from vical_daemon.estimation.camera_model import project_jacobians
from vical_daemon.estimation.imu_model import cross
from vical_daemon.estimation.measurements import BoolArray, FloatArray, IntArray
from vical_daemon.estimation.retract import camera_points, pose_points
from vical_daemon.estimation.state import ATTITUDE, POSITION, VELOCITY, Layout, State
from vical_daemon.estimation.target_view import Rates, view

_FLAT = 0.02  # second-order part over corner noise below which the model is straight
_GROWN = 1.5  # a sigma this many times larger than when it was measured: measure again
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
        sigma_px: White noise of each corner per axis, px, shape (n,).
        common_px: Square root of the noise that all corners share (a late stamp moves them all), px,
            shape (2n, k).
    """

    camera: str
    t_ns: int
    t_cam_s: float
    ids: IntArray
    points: FloatArray
    uv: FloatArray
    sigma_px: FloatArray
    common_px: FloatArray


@dataclass(slots=True)
class Linear:
    """One image linearised: z + H S e + curved, e ~ N(0, I), in pixels.

    Attributes:
        z: Mean of the predicted pixels, shape (n, 2).
        H: Derivatives by the errors of the state, shape (2n, c).
        linear: H S, shape (2n, c).
        curved: Square root of the second-order covariance, shape (2n, k); k = 0 where it is negligible.
        valid: Points in front of the camera, shape (n,).
    """

    z: FloatArray
    H: FloatArray
    linear: FloatArray
    curved: FloatArray
    valid: BoolArray


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
        uv: Measured pixels (rows of a rolling shutter), shape (n, 2); None: as a global shutter sees them.
        errors: Shape (S, size).

    Returns:
        Pixels, shape (S, n, 2).
    """
    where, known = layout.cameras[camera], state.cameras[camera]
    motion = pose_points(state, errors)
    cam = camera_points(known, layout, camera, errors)
    world: FloatArray = points * state.target_scale
    if layout.target_scale is not None:
        world = points * (state.target_scale + errors[:, layout.target_scale])[:, None, None]
    ahead = t_cam_s - state.t_s
    rows = None
    if where.readout is not None or known.readout_s != 0.0:
        if uv is None:
            uv = view(world, motion, cam, rates, ahead, known.distortion_model)[0]
        rows = uv[:, 1] / known.resolution[1] - 0.5
    return view(world, motion, cam, rates, ahead, known.distortion_model, rows)


def by_sigma_points(
    state: State, layout: Layout, rates: Rates, image: Image, dx: FloatArray, S: FloatArray
) -> Linear:
    """Statistical linearisation about `dx` with spread S (all in the chart of the prior)."""
    errors = dx + unscented.offsets(S)
    pixels = project_errors(state, layout, rates, image.camera, image.t_cam_s, image.points, image.uv, errors)
    valid: BoolArray = np.asarray(np.isfinite(pixels).all(axis=(0, 2)))
    flat = np.where(valid[None, :, None], pixels, 0.0).reshape(len(pixels), -1)
    m = unscented.moments(flat[1:] - flat[0])
    H = unscented.solve_lower(S, m.linear.T, transposed=True).T
    return Linear((flat[0] + m.shift).reshape(-1, 2), H, m.linear, m.curved, valid)


def by_derivatives(state: State, layout: Layout, rates: Rates, image: Image, S: FloatArray) -> Linear:
    """The same to first order, about the nominal state; global shutter only."""
    uv, H = view_derivatives(state, layout, rates, image)
    valid: BoolArray = np.asarray(np.isfinite(uv).all(axis=1))
    if not valid.all():
        uv, H = np.where(valid[:, None], uv, 0.0), np.where(np.repeat(valid, 2)[:, None], H, 0.0)
    return Linear(uv, H, H @ S, np.zeros((len(H), 0)), valid)


def view_derivatives(
    state: State, layout: Layout, rates: Rates, image: Image
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) and their derivatives by the errors of the state, shape (2n, size).

    x_imu = R^T (s X - p) with R = R_world_imu Exp(omega d), d = t_cam + shift - t_state; global shutter.
    [docs/math/filter.md, eq. (7); derivatives tested against differences]
    """
    where, cam = layout.cameras[image.camera], state.cameras[image.camera]
    d = image.t_cam_s + cam.timeshift_s - state.t_s
    ahead = so3.exp_one(rates.omega * d)
    R = state.R_world_imu @ ahead
    p = state.p_world_imu + d * state.v_world_imu + 0.5 * d * d * rates.accel
    x_imu = (image.points * state.target_scale - p) @ R
    x_cam = (x_imu - cam.p_imu_cam) @ cam.R_imu_cam
    with np.errstate(all="ignore"):
        uv, J, J_lens = project_jacobians(x_cam, cam.intrinsics, cam.distortion, cam.distortion_model)
    # Two rows a point from here on: numpy multiplies one long matrix in the time of a few short ones.
    J = J.reshape(-1, 3)
    J_imu = J @ cam.R_imu_cam.T
    J_world = J_imu @ R.T
    by_turn = cross(J_imu, np.repeat(x_imu, 2, axis=0))  # j' hat(x) = (j x x)'
    H = np.zeros((len(J), layout.size))
    H[:, ATTITUDE] = by_turn @ ahead.T
    H[:, POSITION] = -J_world
    H[:, VELOCITY] = -d * J_world
    if where.position is not None and where.rotation is not None:
        H[:, where.position] = -J_imu
        H[:, where.rotation] = cross(J, np.repeat(x_cam, 2, axis=0))
    if where.timeshift is not None:
        # x_imu moves by -R'(v + d a) - omega x x_imu; j' (omega x x) = -(j x x)' omega
        speed = R.T @ (state.v_world_imu + d * rates.accel)
        H[:, where.timeshift] = by_turn @ rates.omega - J_imu @ speed
    if where.intrinsics is not None and where.distortion is not None:
        lens = J_lens.reshape(-1, 8)
        H[:, where.intrinsics], H[:, where.distortion] = lens[:, :4], lens[:, 4:]
    if layout.target_scale is not None:
        H[:, layout.target_scale] = np.einsum("ij,ij->i", J_world, np.repeat(image.points, 2, axis=0))
    return uv, H


@dataclass(slots=True)
class Straightness:
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
