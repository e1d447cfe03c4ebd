"""Does the accelerometer belong to this motion? Signs and axes are tried out against the camera's path.

The rotations of gyro and camera give the mounting. The camera's path before a board gives its acceleration.
What is left is linear: a_world = R_world_imu f + g, with the lever arm and gravity unknown. That is solved
for each way in which the accelerometer's axes may be permuted and signed; the one that fits is named.

Mirrored images of a board (u -> -u) give the poses D R D', D p with two reflections. The rotations then fit a
mounting that is turned by half a turn, and the accelerations are those of a negated accelerometer. Only the
side from which the board is seen distinguishes the two.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray, IntArray

_WINDOW = 7  # images of a local parabola; at 20 Hz 0.35 s: shorter is noise, longer cuts hand motion off
_ENOUGH = 40  # accelerations without which nothing is said
_BETTER = 0.5  # residual over that of the axes as they are: a wrong sign or swap changes it several times
_AXES = "xyz"


def explain_accelerometer(
    t_imu_s: FloatArray,
    force_mps2: FloatArray,
    t_cam_s: FloatArray,
    R_world_cam: FloatArray,
    p_world_cam: FloatArray,
    R_imu_cam: FloatArray,
    *,
    front_is_up: bool | None = None,
) -> str:
    """Name the mistake in signs or axes that, undone, makes the specific force fit the camera's path.

    Args:
        t_imu_s: Stamps of the accelerometer, s, shape (m,).
        force_mps2: Specific force, m/s^2, shape (m, 3).
        t_cam_s: Instants of the images in the same clock, increasing, s, shape (n,).
        R_world_cam: Orientations of the camera, shape (n, 3, 3); the world is the board.
        p_world_cam: Its positions, m, shape (n, 3).
        R_imu_cam: Mounting of the camera, shape (3, 3).
        front_is_up: Whether the board is printed on the side to which its z axis points; None: not known.

    Returns:
        In words; empty where no mistake explains it.
    """
    steady = _steady(t_cam_s)
    inside = (t_cam_s[steady][:, 0] > t_imu_s[0]) & (t_cam_s[steady][:, -1] < t_imu_s[-1])
    steady = steady[inside]
    if len(steady) < _ENOUGH:
        return ""
    R_world_imu = R_world_cam @ R_imu_cam.T
    smooth, bend = _parabola(t_cam_s[steady])
    acceleration = np.einsum("kw,kwi->ki", bend, p_world_cam[steady])
    leverage = np.einsum("kw,kwij->kij", bend, R_world_imu[steady])  # of the lever arm
    force = _at(t_imu_s, force_mps2, t_cam_s)
    turned = np.einsum("kw,kwij,kwl->kijl", smooth, R_world_imu[steady], force[steady])

    def residual(A: FloatArray) -> float:
        """Rms of a = R A f + g - R'' r over the best g and r, m/s^2."""
        target = (acceleration - np.einsum("kijl,jl->ki", turned, A)).ravel()
        ones = np.broadcast_to(np.eye(3), leverage.shape)
        system = np.concatenate([ones, -leverage], axis=2).reshape(-1, 6)
        solution = np.linalg.lstsq(system, target, rcond=None)[0]
        return float(np.sqrt(np.mean((target - system @ solution) ** 2)))

    as_is = residual(np.eye(3))
    mappings = so3.signed_permutations()
    scores = [residual(A) for A in mappings]
    best = int(np.argmin(scores))
    if not scores[best] < _BETTER * as_is:
        return ""
    if np.array_equal(mappings[best], -np.eye(3)):
        seen_from_above = float(np.median(p_world_cam[:, 2])) > 0.0
        return _negated(None if front_is_up is None else seen_from_above == front_is_up)
    return _axes(mappings[best])


def _steady(t_s: FloatArray) -> IntArray:
    """Index windows without a gap, shape (k, _WINDOW)."""
    if len(t_s) < _WINDOW:
        return np.zeros((0, _WINDOW), dtype=np.int64)
    windows = np.arange(len(t_s) - _WINDOW + 1)[:, None] + np.arange(_WINDOW)
    span = t_s[windows[:, -1]] - t_s[windows[:, 0]]
    steady: IntArray = windows[span < 1.5 * np.median(span)]
    return steady


def _parabola(t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights of a least-squares parabola through each window: mean, and second derivative."""
    x = t_s - t_s.mean(axis=1, keepdims=True)
    basis = np.stack([np.ones_like(x), x, x**2], axis=2)
    inverse = np.linalg.pinv(basis)
    # The second derivative of the parabola averages the acceleration over the window: so average the forces.
    mean = np.full_like(x, 1.0 / _WINDOW)
    return mean, 2.0 * inverse[:, 2, :]


def _at(t_imu_s: FloatArray, force: FloatArray, t_s: FloatArray) -> FloatArray:
    """Mean force around each instant, over the interval between images, shape (n, 3)."""
    half_s = 0.5 * float(np.median(np.diff(t_s)))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(force, axis=0)])
    low = np.searchsorted(t_imu_s, t_s - half_s).clip(0, len(t_imu_s) - 1)
    high = np.maximum(np.searchsorted(t_imu_s, t_s + half_s), low + 1)
    mean: FloatArray = (total[high] - total[low]) / (high - low)[:, None]
    return mean


def _negated(seen_from_front: bool | None) -> str:
    negated = (
        "the accelerometer reports gravity instead of specific force (at rest it must read +9.8 upwards): "
        "negate all three of its axes"
    )
    mirrored = "the images are mirrored: the camera sees the board from behind"
    if seen_from_front is None:
        return f"either {negated}, or the images are mirrored; these data cannot tell which"
    return negated if seen_from_front else mirrored


def _axes(A: FloatArray) -> str:
    names = []
    for row in A:
        axis = int(np.flatnonzero(row)[0])
        names.append(("-" if row[axis] < 0.0 else "") + _AXES[axis])
    return (
        "the axes of accelerometer and gyro are not the same: with the accelerometer's axes taken as "
        f"({', '.join(names)}) it fits"
    )
