"""What a camera's path says of accelerations and turns: the vision half of `accel_alignment`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    GYRO_BIAS_SIGMA_RPS,
    WINDOW_START,
)
from vical_daemon.estimation.temporal.rotation_turns import evenly, turns_apart

_HALF_S = 0.2  # windows of 0.4 s: hand motion is straight enough, 2 mm of noise give 0.1 m/s^2
_STEP_S = 0.01
PRIORS = 9
"""Rows for these three vectors."""
_MIN_WINDOWS = 12


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
    if len(windows) < _MIN_WINDOWS:
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
