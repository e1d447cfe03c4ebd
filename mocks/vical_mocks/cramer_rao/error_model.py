"""Linear error model at the truth, for the bound: inertial transitions with noise, and pixel derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from vical_mocks.cramer_rao.projection import View, jacobians
from vical_mocks.points import SimulatedFrame
from vical_mocks.rig import Rig
from vical_mocks.rotations import skew

FloatArray = npt.NDArray[np.float64]

STATE = 15  # attitude (local), velocity, position, gyro bias, accelerometer bias
_MAX_STEP_S = 10.1e-3


def inertial_factors(
    rig: Rig, times_s: FloatArray, matrices: bool = False
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Error transitions from each frame to the next at the truth, for n + 1 times.

    Args:
        rig: Truth.
        times_s: Of the frames.
        matrices: The imu's matrices are unknown, too.

    Returns:
        Transitions (n, 15, 15); influence of gravity (n, 15, 3), or of [gravity 3, gyro matrix 9,
        accelerometer matrix 6] (n, 15, 18); noise covariances (n, 15, 15).
    """
    gaps_s = np.diff(times_s)
    counts = np.array([steps_in(gap_s)[1] for gap_s in gaps_s])
    inputs = 18 if matrices else 3
    transition, influence = np.empty((len(gaps_s), STATE, STATE)), np.empty((len(gaps_s), STATE, inputs))
    noise = np.empty((len(gaps_s), STATE, STATE))
    for count in np.unique(counts):  # gaps of like length together
        some = counts == count
        total, noise[some] = _integrate(
            rig, times_s[:-1][some], gaps_s[some] / count, int(count), STATE + inputs
        )
        transition[some], influence[some] = total[:, :STATE, :STATE], total[:, :STATE, STATE:]
    return transition, influence, noise


def steps_in(gap_s: float) -> tuple[float, int]:
    """Length (s) and number of the equal steps, of 10 ms at most, that a gap is integrated in."""
    count = max(1, int(np.ceil(gap_s / _MAX_STEP_S)))
    return gap_s / count, count


def _integrate(
    rig: Rig, start_s: FloatArray, step_s: FloatArray, count: int, used: int
) -> tuple[FloatArray, FloatArray]:
    """`count` steps from each start: transitions of the first `used` errors, and noise covariances."""
    densities = rig.densities
    diffusion = (
        np.repeat([densities.gyro, densities.accel, 0.0, densities.gyro_walk, densities.accel_walk], 3) ** 2
    )
    eye, small = np.eye(used), np.eye(STATE)
    total = np.tile(eye, (len(start_s), 1, 1))
    noise = np.zeros((len(start_s), STATE, STATE))
    for k in range(count):
        slopes = error_slopes(rig, start_s + (k + 0.5) * step_s)[:, :used, :used]
        a = slopes * step_s[:, None, None]
        step = eye + a @ (eye + a @ (eye + a / 3) / 2)
        phi, inner = step[:, :STATE, :STATE], a[:, :STATE, :STATE]
        half = small + inner / 2 + inner @ inner / 8
        # Simpson's rule for the integral of phi(s) D phi(s)^T: exact to the order that matters at 10 ms.
        added = np.diag(diffusion) + 4 * _spread(half, diffusion) + _spread(phi, diffusion)
        noise = phi @ noise @ np.swapaxes(phi, 1, 2) + added * (step_s / 6)[:, None, None]
        total = step @ total
    return total, noise


def _spread(phi: FloatArray, diffusion: FloatArray) -> FloatArray:
    """Phi diag(diffusion) phi^T, batched."""
    return np.asarray((phi * diffusion) @ np.swapaxes(phi, 1, 2))


def error_slopes(rig: Rig, t_s: FloatArray) -> FloatArray:
    """Time derivative of [state errors, gravity, gyro matrix, accelerometer matrix] as matrices (n, 33, 33).

    True attitude = estimate times exp(error); reading = matrix times truth + bias + noise.
    """
    R = rig.trajectory.R_world_imu(t_s)
    rate, force = rig.imu_motion(t_s)
    F = np.zeros((len(t_s), STATE + 18, STATE + 18))
    F[:, 0:3, 0:3] = -skew(rate)
    F[:, 0:3, 9:12] = -np.eye(3)
    F[:, 3:6, 0:3] = -R @ skew(force)
    F[:, 3:6, 12:15] = -R
    F[:, 6:9, 3:6] = np.eye(3)
    F[:, 3:6, 15:18] = np.eye(3)
    for row in range(3):
        F[:, row, 18 + 3 * row : 21 + 3 * row] = -rate
        start = 27 + row * (row + 1) // 2
        for column in range(row + 1):
            F[:, 3:6, start + column] = -R[:, :, row] * force[:, column, None]
    return F


def pixel_jacobians(
    rig: Rig, frames: Sequence[SimulatedFrame], points_m: Sequence[FloatArray]
) -> list[dict[str, FloatArray]]:
    """Derivatives of each frame's pixels at the truth; see `projection.jacobians`."""
    counts = [len(points) for points in points_m]
    t_s = np.repeat([frame.t_s for frame in frames], counts)
    R_imu_cam, p_imu_cam = rig.extrinsics_at(t_s)
    path = rig.trajectory
    view = View(
        path.R_world_imu(t_s),
        path.p_world_imu(t_s),
        path.v_world_imu(t_s),
        path.omega_imu_rps(t_s),
        R_imu_cam,
        p_imu_cam,
        rig.lens,
        rig.row_share,
    )
    together = jacobians(view, np.concatenate(points_m))
    ends = 2 * np.cumsum(counts)
    return [
        {name: block[end - 2 * count : end] for name, block in together.items()}
        for count, end in zip(counts, ends, strict=True)
    ]
