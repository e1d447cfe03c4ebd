"""Mounting and delay from accelerations, for motion that turns too little to show them by rotation alone.

Second derivatives of the camera's path are compared with the specific force, over short windows:

    a_cam = M(d) vec(R_cam_imu) + g + L l_cam - N b_cam

M: specific force rotated by vision into the target frame and averaged with the kernel by which the window's
quadratic fit weighs accelerations; L, N: the same for a lever arm and a bias fixed in the camera. All but
R_cam_imu and the shift d enter linearly and are eliminated; turns of gyro and camera add their own evidence
(Wahba). What is left is a small quadratic form in R_cam_imu, minimised on SO(3) from a grid, for each d.
[docs/math/filter.md (14)]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    GYRO_BIAS_SIGMA_RPS,
    ROTATION_SIGMA_RAD,
    SHIFT_SIGMA_S,
    WINDOW_START,
)
from vical_daemon.estimation.temporal.rotation_curves import running_integral
from vical_daemon.estimation.temporal.rotation_turns import evenly, turns_apart
from vical_daemon.estimation.temporal.td_icp_input import MIN_ORIENTATIONS

_HALF_S = 0.2  # windows of 0.4 s: hand motion is straight enough, 2 mm of noise give 0.1 m/s^2
_STEP_S = _HALF_S / 20.0  # between windows
PRIORS = 9
"""Rows of what is known before: lever arm, accelerometer bias and gyro bias."""
_COARSE_S = 2.0 * _STEP_S  # grid of time shifts: what windows average changes slowly; a fifth about the best
_APART_S = 0.25  # another delay this far away must fit worse by the contrast
_MIN_CONTRAST = 4.0  # cost there over the least cost: twice the misfit
_DESCENTS = 12  # damped Gauss-Newton steps from each of the 24 aligned mountings
_ALIGNED = so3.signed_permutations()
_STARTS = _ALIGNED[np.linalg.det(_ALIGNED) > 0.0]


@dataclass(frozen=True)
class CameraPath:
    """Poses of a camera in the target frame.

    Attributes:
        t_cam_s: Stamps in the camera's clock, s, increasing, shape (n,).
        R_target_cam: Attitudes, shape (n, 3, 3).
        p_target_cam: Positions, m, shape (n, 3).
        sigma_m: Standard deviation of each position, m, shape (n,).
        sigma_rad: Of each attitude, rad, shape (n,).
    """

    t_cam_s: FloatArray
    R_target_cam: FloatArray
    p_target_cam: FloatArray
    sigma_m: FloatArray
    sigma_rad: FloatArray


@dataclass(frozen=True)
class Evidence:
    """What vision says: windows of accelerations and turns, with the maps that do not depend on the delay."""

    grid_s: FloatArray  # camera clock, shape (g,)
    R_target_cam: FloatArray  # on the grid, shape (g, 3, 3)
    kernels: FloatArray  # of each window on the grid, shape (w, g)
    accel_sigma: FloatArray  # m/s^2, shape (w,)
    turn_span_s: FloatArray  # begin and end of each turn, shape (2, k)
    turn_sigma: FloatArray  # rad, shape (k,)
    seen: FloatArray  # accelerations, turns and priors over their sigmas, shape (n,)
    others: FloatArray  # maps of gravity, lever arm, bias (camera frame) and gyro bias, shape (n, 12)
    basis: FloatArray  # orthonormal, of the columns of `others`

    @property
    def dof(self) -> int:
        """Degrees of freedom of the residuals."""
        return max(len(self.seen) - PRIORS - 16, 1)

    def project(self, x: FloatArray) -> FloatArray:
        """Take out what the eliminated unknowns explain."""
        out: FloatArray = x - self.basis @ (self.basis.T @ x)
        return out


def gather(path: CameraPath) -> Evidence | None:
    """Work out the evidence; None where there are too few poses in a row."""
    t, R = path.t_cam_s, path.R_target_cam
    half_s = max(_HALF_S, 2.2 * float(np.median(np.diff(t))))
    grid = np.arange(t[0], t[-1], _STEP_S)
    right = np.clip(np.searchsorted(t, grid, side="right"), 1, len(t) - 1)
    share = ((grid - t[right - 1]) / (t[right] - t[right - 1]))[:, None, None]
    # Straight between matrices: of two poses 3 deg apart that misses the rotation by 0.03 %.
    R_grid = (1.0 - share) * R[right - 1] + share * R[right]
    windows = [
        window
        for centre in np.arange(t[0] + half_s, t[-1] - half_s, half_s)
        if (window := _window(float(centre), half_s, t, grid)) is not None
    ]
    if len(windows) < MIN_ORIENTATIONS:  # 36 equations for a rotation and three vectors
        return None
    kernels = np.array([kernel for _, kernel in windows])
    weights = np.array([weight for weight, _ in windows])
    sigma = np.linalg.norm(weights * path.sigma_m, axis=1)
    turns = evenly(turns_apart(t, so3.quat_from_matrix(R)), len(t) // 2)
    first, second, turn = turns.first, turns.second, turns.rotvec_cam
    turn_sigma = np.hypot(path.sigma_rad[first], path.sigma_rad[second])
    others = _other_unknowns(weights, kernels, R, R_grid, sigma, (t[second] - t[first]) / turn_sigma)
    accelerations = weights @ path.p_target_cam / sigma[:, None]
    seen = np.concatenate([accelerations.ravel(), (turn / turn_sigma[:, None]).ravel()])
    return Evidence(
        grid,
        R_grid,
        kernels,
        sigma,
        np.array([t[first], t[second]]),
        turn_sigma,
        np.concatenate([seen, np.zeros(PRIORS)]),
        others,
        np.linalg.qr(others)[0],
    )


def _window(
    centre_s: float, half_s: float, t: FloatArray, grid_s: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Weights of the poses that give the acceleration about an instant, and how they weigh its course."""
    inside = np.flatnonzero(np.abs(t - centre_s) <= half_s)
    if len(inside) < 4 or np.ptp(t[inside]) < 1.5 * half_s:
        return None
    tau = t[inside] - centre_s
    quadratic = np.linalg.pinv(np.stack([np.ones_like(tau), tau, 0.5 * tau * tau], axis=1))[2]
    weights = np.zeros(len(t))
    weights[inside] = quadratic
    # The weights take no mean and no slope: integrating twice by parts, they see accelerations through this.
    kernel: FloatArray = quadratic @ np.clip(tau[:, None] - (grid_s - centre_s), 0.0, None)
    kernel = np.where(grid_s >= t[inside[0]], kernel, 0.0)
    scaled: FloatArray = kernel / kernel.sum()
    return weights, scaled


def _other_unknowns(
    weights: FloatArray,
    kernels: FloatArray,
    R: FloatArray,
    R_grid: FloatArray,
    accel_sigma: FloatArray,
    span_by_sigma: FloatArray,
) -> FloatArray:
    """Map gravity, lever arm, accelerometer bias (camera frame) and gyro bias to what is seen."""
    nw, nk = len(kernels), len(span_by_sigma)
    out = np.zeros((3 * (nw + nk) + PRIORS, 12))
    lever, bias = np.einsum("wk,kij->wij", weights, R), np.einsum("wg,gij->wij", kernels, R_grid)
    gravity = np.broadcast_to(np.eye(3), lever.shape)
    by_force = np.concatenate([gravity, lever, -bias], axis=2) / accel_sigma[:, None, None]
    out[: 3 * nw, :9] = by_force.reshape(-1, 9)
    out[3 * nw : -PRIORS, 9:] = -(span_by_sigma[:, None, None] * np.eye(3)).reshape(-1, 3)
    sigmas = np.repeat([WINDOW_START.lever_arm_m, ACCEL_BIAS_SIGMA_MPS2, GYRO_BIAS_SIGMA_RPS], 3)
    out[-PRIORS:, 3:] = np.diag(1.0 / sigmas)
    return out


@dataclass(frozen=True)
class Alignment:
    """The best mounting and delay by accelerations and turns together.

    Attributes:
        R_imu_cam: Mounting, shape (3, 3).
        timeshift_s: t_imu - t_cam, s.
        gyro_bias_rps: rad/s, shape (3,).
        rotation_sigma_rad: Of the least known direction, rad (by least squares, no curvature of windows).
        timeshift_sigma_s: Likewise, s.
        contrast: Cost of the best delay more than a quarter of a second away over the cost here.
    """

    R_imu_cam: FloatArray
    timeshift_s: float
    gyro_bias_rps: FloatArray
    rotation_sigma_rad: float
    timeshift_sigma_s: float
    contrast: float

    @property
    def trusted(self) -> bool:
        """Whether a filter may start from it."""
        return (
            self.contrast > _MIN_CONTRAST
            and self.rotation_sigma_rad < ROTATION_SIGMA_RAD
            and self.timeshift_sigma_s < 2.0 * SHIFT_SIGMA_S
        )


def align(path: CameraPath, imu_rows: FloatArray, shifts_s: tuple[float, float]) -> Alignment | None:
    """Find mounting and delay from a path of the camera and inertial readings.

    Args:
        path: Of the camera.
        imu_rows: Columns t_s, gyro xyz (rad/s), specific force xyz (m/s^2), shape (m, 7).
        shifts_s: Lowest and highest time shift to look at, s.

    Returns:
        The alignment, or None where there are too few poses in a row.
    """
    evidence = gather(path)
    if evidence is None:
        return None
    imu_rows = _with_angles(imu_rows)
    coarse = np.arange(shifts_s[0], shifts_s[1] + 1e-9, _COARSE_S)
    costs, _ = _costs(evidence, imu_rows, coarse)
    best = int(np.argmin(costs))
    apart = np.abs(coarse - coarse[best]) > _APART_S
    contrast = float(np.min(costs[apart]) / max(costs[best], 1e-9)) if apart.any() else 1.0
    step_s = _COARSE_S / 5.0
    fine = coarse[best] + np.arange(-10, 11) * step_s
    costs, Rs = _costs(evidence, imu_rows, fine)
    at = int(np.clip(np.argmin(costs), 1, len(fine) - 2))
    low, middle, high = costs[at - 1 : at + 2]
    bend = max(float(low - 2.0 * middle + high) / step_s**2, 1e-9)
    shift = float(fine[at] + np.clip((low - high) / (2.0 * bend * step_s), -step_s, step_s))
    scale = max(float(middle) / evidence.dof, 1.0)
    shift_sigma = float(np.sqrt(2.0 * scale / bend))
    return _alignment(evidence, imu_rows, Rs[at], scale, np.eye(3), (shift, shift_sigma, contrast))


def align_at(
    path: CameraPath, imu_rows: FloatArray, shift_s: float, axis_cam: FloatArray
) -> Alignment | None:
    """Find a mounting, but for a turn about an axis of the camera (3,), with a delay taken for known.

    For a rig that turns about this axis at one rate all the time, see `align`.
    """
    evidence = gather(path)
    if evidence is None:
        return None
    imu_rows = _with_angles(imu_rows)
    costs, Rs = _costs(evidence, imu_rows, np.array([shift_s]))
    scale = max(float(costs[0]) / evidence.dof, 1.0)
    across = np.linalg.svd(axis_cam[None])[2][1:].T
    return _alignment(evidence, imu_rows, Rs[0], scale, across, (shift_s, 0.0, np.inf))


def force_misfits(path: CameraPath, imu_rows: FloatArray, maps: FloatArray) -> FloatArray | None:
    """How well the specific force fits the camera's accelerations if it is mapped into the camera's frame.

    Args:
        path: Of the camera, in the imu's clock.
        imu_rows: As for `align`.
        maps: From the imu's frame to the camera's, rotations or not, shape (k, 3, 3).

    Returns:
        Rms of the accelerations that are left, over their sigmas, shape (k,), with the best gravity, lever
        arm and bias; None where there are too few poses in a row.
    """
    evidence = gather(path)
    if evidence is None:
        return None
    D = _Reduced.at(evidence, _with_angles(imu_rows), 0.0).D
    n = 3 * len(evidence.accel_sigma)
    rows = [*range(n), *range(len(D) - PRIORS, len(D))]  # without the turns
    basis = np.linalg.qr(evidence.others[rows, :9])[0]
    left = evidence.seen[rows, None] - D[rows] @ maps.reshape(-1, 9).T
    left -= basis @ (basis.T @ left)
    return np.asarray(np.sqrt(np.mean(left[:n] ** 2, axis=0)))


def _alignment(
    evidence: Evidence,
    rows: FloatArray,
    R: FloatArray,
    scale: float,
    asked: FloatArray,
    shift: tuple[float, float, float],
) -> Alignment:
    """The mounting R (cam from imu), known about the axes `asked`, (3, k); delay, its sigma and contrast."""
    problem = _Reduced.at(evidence, rows, shift[0])
    J = _tangent(R) @ asked
    worst = float(np.linalg.eigvalsh(J.T @ problem.A @ J / scale)[0])
    bias = R.T @ problem.turn_bias(R.ravel())
    return Alignment(R.T, shift[0], bias, 1.0 / np.sqrt(max(worst, 1e-3)), shift[1], shift[2])


def _with_angles(rows: FloatArray) -> FloatArray:
    """Append the integral of the rates, rad, as three columns: over a fifth of a second nearly the turn."""
    return np.hstack([rows, running_integral(np.diff(rows[:, 0]), rows[:, 1:4])])


@dataclass(frozen=True)
class _Reduced:
    """Cost r' A r - 2 b' r + c of r = vec(R_cam_imu) at one delay, all that is linear eliminated."""

    A: FloatArray
    b: FloatArray
    c: float
    D: FloatArray
    _y: FloatArray
    _others: FloatArray

    @classmethod
    def at(cls, e: Evidence, rows: FloatArray, shift_s: float) -> _Reduced:
        """Set it up.

        Args:
            e: What vision says.
            rows: Inertial readings, see `align`.
            shift_s: The delay.
        """
        t = rows[:, 0]
        force = np.stack([np.interp(e.grid_s + shift_s, t, rows[:, 4 + m]) for m in range(3)], axis=1)
        outer = (e.R_target_cam[:, :, :, None] * force[:, None, None, :]).reshape(-1, 27)
        by_force = (e.kernels @ outer).reshape(-1, 3, 9) / e.accel_sigma[:, None, None]
        turned = np.stack([np.interp(e.turn_span_s + shift_s, t, rows[:, 7 + m]) for m in range(3)], axis=-1)
        turn = (turned[1] - turned[0]) / e.turn_sigma[:, None]
        by_turn = (np.eye(3)[None, :, :, None] * turn[:, None, None, :]).reshape(-1, 9)
        D = np.vstack([by_force.reshape(-1, 9), by_turn, np.zeros((PRIORS, 9))])
        PD, Py = e.project(D), e.project(e.seen)
        return cls(PD.T @ PD, PD.T @ Py, float(Py @ Py), D, e.seen, e.others)

    def turn_bias(self, r: FloatArray) -> FloatArray:
        """The gyro's bias in the camera frame that goes with r, rad/s, shape (3,)."""
        found = np.linalg.lstsq(self._others, self._y - self.D @ r, rcond=None)[0]
        return np.asarray(found[9:], dtype=np.float64)


def _costs(e: Evidence, rows: FloatArray, shifts_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least cost over all mountings for each shift, shape (s,), and R_cam_imu there, shape (s, 3, 3)."""
    problems = [_Reduced.at(e, rows, float(d)) for d in shifts_s]
    A, b = np.array([p.A for p in problems]), np.array([p.b for p in problems])
    R = np.broadcast_to(_STARTS, (len(shifts_s), *_STARTS.shape)).copy()
    for _ in range(_DESCENTS):
        J = _tangent(R)
        Jt, r = np.swapaxes(J, 2, 3), R.reshape(*R.shape[:2], 9)
        gradient = Jt @ (r @ A - b[:, None])[..., None]
        H = Jt @ A[:, None] @ J
        damping = 1e-6 + 0.02 * np.einsum("skaa->sk", H)
        step = -np.linalg.solve(H + damping[:, :, None, None] * np.eye(3), gradient)[..., 0]
        R = so3.exp(step) @ R
    r = R.reshape(*R.shape[:2], 9)
    cost = np.vecdot(r @ A - 2.0 * b[:, None], r)
    at, each = np.argmin(cost, axis=1), np.arange(len(shifts_s))
    return cost[each, at] + np.array([p.c for p in problems]), R[each, at]


def _tangent(R: FloatArray) -> FloatArray:
    """Derivative of vec(exp(w) R) by w at 0, shape (..., 9, 3)."""
    generators = so3.hat(np.eye(3))
    return np.stack([(generators[m] @ R).reshape(*R.shape[:-2], 9) for m in range(3)], axis=-1)
