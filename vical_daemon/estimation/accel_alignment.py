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
from itertools import permutations, product

import numpy as np

from vical_daemon.estimation import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.rotation_start import camera_turns

_HALF_S = 0.2  # windows of 0.4 s: hand motion is straight enough, 2 mm of noise give 0.1 m/s^2
_STEP_S = 0.01
_LEVER_ARM_PRIOR_M = 0.3
_BIAS_PRIOR = 0.3  # m/s^2
_GYRO_BIAS_PRIOR_RPS = 0.1
_PRIORS = 9  # rows for these three vectors
_MIN_WINDOWS = 12
_COARSE_S, _FINE_S = 0.02, 0.004
_APART_S = 0.25  # another delay this far away must fit worse by the contrast
_MIN_CONTRAST = 4.0
_MAX_ROTATION_SIGMA_RAD = np.deg2rad(1.0)
_MAX_SHIFT_SIGMA_S = 2e-3
_DESCENTS = 12


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
            and self.rotation_sigma_rad < _MAX_ROTATION_SIGMA_RAD
            and self.timeshift_sigma_s < _MAX_SHIFT_SIGMA_S
        )


@dataclass(frozen=True)
class _Evidence:
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
        return max(len(self.seen) - _PRIORS - 16, 1)

    def project(self, x: FloatArray) -> FloatArray:
        """Take out what the eliminated unknowns explain."""
        out: FloatArray = x - self.basis @ (self.basis.T @ x)
        return out


def align(
    imu_rows: FloatArray,
    t_cam_s: FloatArray,
    R_target_cam: FloatArray,
    p_target_cam: FloatArray,
    sigma_m: FloatArray,
    sigma_rad: FloatArray,
    shifts_s: tuple[float, float],
) -> Alignment | None:
    """Find mounting and delay from a path of the camera and inertial readings.

    Args:
        imu_rows: Columns t_s, gyro xyz (rad/s), specific force xyz (m/s^2), shape (m, 7).
        t_cam_s: Stamps of the poses in the camera's clock, s, increasing, shape (n,).
        R_target_cam: Attitudes of the camera, shape (n, 3, 3).
        p_target_cam: Its positions, m, shape (n, 3).
        sigma_m: Standard deviation of each position, m, shape (n,).
        sigma_rad: Of each attitude, rad, shape (n,).
        shifts_s: Lowest and highest time shift to look at, s.

    Returns:
        The alignment, or None where there are too few poses in a row.
    """
    evidence = _gather(t_cam_s, R_target_cam, p_target_cam, sigma_m, sigma_rad)
    if evidence is None:
        return None
    imu_rows = _with_angles(imu_rows)
    coarse = np.arange(shifts_s[0], shifts_s[1] + 1e-9, _COARSE_S)
    costs, _ = _costs(evidence, imu_rows, coarse)
    best = int(np.argmin(costs))
    apart = np.abs(coarse - coarse[best]) > _APART_S
    contrast = float(np.min(costs[apart]) / max(costs[best], 1e-9)) if apart.any() else 1.0
    fine = coarse[best] + np.arange(-10, 11) * _FINE_S
    costs, Rs = _costs(evidence, imu_rows, fine)
    at = int(np.clip(np.argmin(costs), 1, len(fine) - 2))
    low, middle, high = costs[at - 1 : at + 2]
    bend = max(float(low - 2.0 * middle + high) / _FINE_S**2, 1e-9)
    shift = float(fine[at] + np.clip((low - high) / (2.0 * bend * _FINE_S), -_FINE_S, _FINE_S))
    scale = max(float(middle) / evidence.dof, 1.0)
    problem = _Reduced.at(evidence, imu_rows, shift)
    J = _tangent(Rs[at])
    information = J.T @ problem.A @ J / scale
    worst = float(np.linalg.eigvalsh(information)[0])
    R_imu_cam = Rs[at].T
    return Alignment(
        R_imu_cam,
        shift,
        R_imu_cam @ problem.turn_bias(Rs[at].ravel()),
        1.0 / np.sqrt(max(worst, 1e-3)),
        float(np.sqrt(2.0 * scale / bend)),
        contrast,
    )


def _with_angles(rows: FloatArray) -> FloatArray:
    """Append the integral of the rates, rad, as three columns: over a fifth of a second nearly the turn."""
    steps = np.diff(rows[:, 0])[:, None]
    angle = np.cumsum(0.5 * (rows[1:, 1:4] + rows[:-1, 1:4]) * steps, axis=0)
    return np.hstack([rows, np.vstack([np.zeros(3), angle])])


def _gather(
    t: FloatArray, R: FloatArray, p: FloatArray, sigma_m: FloatArray, sigma_rad: FloatArray
) -> _Evidence | None:
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
    if len(windows) < _MIN_WINDOWS:
        return None
    kernels = np.array([kernel for _, kernel in windows])
    weights = np.array([weight for weight, _ in windows])
    sigma = np.linalg.norm(weights * sigma_m, axis=1)
    turns = camera_turns(t, so3.quat_from_matrix(R), most=len(t) // 2)
    first, second, turn = turns.first, turns.second, turns.rotvec_cam
    turn_sigma = np.hypot(sigma_rad[first], sigma_rad[second])
    others = _other_unknowns(weights, kernels, R, R_grid, sigma, (t[second] - t[first]) / turn_sigma)
    seen = np.concatenate([(weights @ p / sigma[:, None]).ravel(), (turn / turn_sigma[:, None]).ravel()])
    return _Evidence(
        grid,
        R_grid,
        kernels,
        sigma,
        np.array([t[first], t[second]]),
        turn_sigma,
        np.concatenate([seen, np.zeros(_PRIORS)]),
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
    out = np.zeros((3 * (nw + nk) + _PRIORS, 12))
    lever, bias = np.einsum("wk,kij->wij", weights, R), np.einsum("wg,gij->wij", kernels, R_grid)
    gravity = np.broadcast_to(np.eye(3), lever.shape)
    by_force = np.concatenate([gravity, lever, -bias], axis=2) / accel_sigma[:, None, None]
    out[: 3 * nw, :9] = by_force.reshape(-1, 9)
    out[3 * nw : -_PRIORS, 9:] = -(span_by_sigma[:, None, None] * np.eye(3)).reshape(-1, 3)
    sigmas = np.repeat([_LEVER_ARM_PRIOR_M, _BIAS_PRIOR, _GYRO_BIAS_PRIOR_RPS], 3)
    out[-_PRIORS:, 3:] = np.diag(1.0 / sigmas)
    return out


@dataclass(frozen=True)
class _Reduced:
    """Cost r' A r - 2 b' r + c of r = vec(R_cam_imu) at one delay, all that is linear eliminated."""

    A: FloatArray
    b: FloatArray
    c: float
    _D: FloatArray
    _y: FloatArray
    _others: FloatArray

    @classmethod
    def at(cls, e: _Evidence, rows: FloatArray, shift_s: float) -> _Reduced:
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
        D = np.vstack([by_force.reshape(-1, 9), by_turn, np.zeros((_PRIORS, 9))])
        PD, Py = e.project(D), e.project(e.seen)
        return cls(PD.T @ PD, PD.T @ Py, float(Py @ Py), D, e.seen, e.others)

    def turn_bias(self, r: FloatArray) -> FloatArray:
        """The gyro's bias in the camera frame that goes with r, rad/s, shape (3,)."""
        found = np.linalg.lstsq(self._others, self._y - self._D @ r, rcond=None)[0]
        return np.asarray(found[9:], dtype=np.float64)


def _costs(e: _Evidence, rows: FloatArray, shifts_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least cost over all mountings for each shift, shape (s,), and R_cam_imu there, shape (s, 3, 3)."""
    problems = [_Reduced.at(e, rows, float(d)) for d in shifts_s]
    A, b = np.array([p.A for p in problems]), np.array([p.b for p in problems])
    R = np.broadcast_to(_STARTS, (len(shifts_s), *_STARTS.shape)).copy()
    for _ in range(_DESCENTS):
        J = _tangent(R)
        r = R.reshape(*R.shape[:2], 9)
        gradient = np.einsum("skij,ski->skj", J, np.einsum("sij,skj->ski", A, r) - b[:, None])
        H = np.einsum("skia,sij,skjb->skab", J, A, J)
        damping = 1e-6 + 0.02 * np.einsum("skaa->sk", H)
        step = -np.linalg.solve(H + damping[:, :, None, None] * np.eye(3), gradient[..., None])[..., 0]
        R = so3.exp(step) @ R
    r = R.reshape(*R.shape[:2], 9)
    cost = np.einsum("ski,sij,skj->sk", r, A, r) - 2.0 * np.einsum("si,ski->sk", b, r)
    at, each = np.argmin(cost, axis=1), np.arange(len(shifts_s))
    return cost[each, at] + np.array([p.c for p in problems]), R[each, at]


def _tangent(R: FloatArray) -> FloatArray:
    """Derivative of vec(exp(w) R) by w at 0, shape (..., 9, 3)."""
    generators = so3.hat(np.eye(3))
    return np.stack([(generators[m] @ R).reshape(*R.shape[:-2], 9) for m in range(3)], axis=-1)


def _cube_rotations() -> FloatArray:
    """The 24 rotations of a cube, shape (24, 3, 3): any rotation is within 63 degrees of one."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(order)] * np.array(signs)
            if np.linalg.det(R) > 0.0:
                found.append(R)
    return np.array(found)


_STARTS = _cube_rotations()
