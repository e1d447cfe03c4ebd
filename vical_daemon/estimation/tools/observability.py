"""Which parameters a given motion makes observable: the Gramian of the linearised system along a trajectory.

Without process noise the whole trajectory is a function of the first state and of constant parameters. The
derivative of every measurement by those numbers, summed up as information, says what the motion can
determine: its null space are the directions lost, and its inverse bounds from below how well the rest can be
known. All integrals of the error equations are running sums over the imu's samples, so nothing is integrated
twice.

Errors: attitude (world frame, left), position, velocity, gyro and accelerometer bias, gravity; mounting
(local, right), lever arm, time shift; and optional blocks. [docs/math/observability.md]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.measurements import ROWS, FloatArray
from vical_daemon.estimation.model.camera_rays import read_share
from vical_daemon.estimation.temporal.rotation_curves import running_integral

IntArray = npt.NDArray[np.intp]

# What counts as one step of each parameter: makes metres, radians and seconds comparable
UNITS = {
    "attitude": 0.01,
    "position": 0.01,
    "velocity": 0.05,
    "gyro_bias": 0.01,
    "accel_bias": 0.1,
    "gravity": 0.1,
    "rotation": 0.01,
    "lever_arm": 0.01,
    "timeshift": 0.001,
    "intrinsics": 5.0,
    "distortion": 0.02,
    "gyro_matrix": 0.01,
    "accel_matrix": 0.01,
    "target_scale": 0.01,
    "readout": 0.002,
}

_LOST = 1e-7  # singular value (in the units above, relative to the largest) below which a direction is lost


@dataclass(frozen=True)
class Motion:
    """A motion, sampled like an imu does.

    Attributes:
        t_s: Instants, increasing, s, shape (m,).
        R_world_imu: Attitude, shape (m, 3, 3).
        p_world_imu: Position, m, shape (m, 3).
        v_world_imu: Velocity, m/s, shape (m, 3).
        rate_rps: Angular rate in the imu frame, shape (m, 3).
        specific_force_mps2: In the imu frame, shape (m, 3).
    """

    t_s: FloatArray
    R_world_imu: FloatArray
    p_world_imu: FloatArray
    v_world_imu: FloatArray
    rate_rps: FloatArray
    specific_force_mps2: FloatArray


@dataclass(frozen=True)
class Setup:
    """What looks at what.

    Attributes:
        R_imu_cam: Mounting, shape (3, 3).
        p_imu_cam: Lever arm, m, shape (3,).
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: Four coefficients, shape (4,).
        model: radtan or equidistant.
        resolution: width, height, px; points outside are not seen.
        landmarks_m: Points in the world, m, shape (n, 3).
        seen: Without a board, in a world with z up: rows of `landmarks_m` that each image shows. Their places
            are unknown, and eliminated. None: the points inside of the image are seen.
        readout_axis: What a rolling shutter reads one after the other.
        estimate: Of {"intrinsics", "imu_matrix", "target_scale", "readout"}: further unknowns.
        corner_sigma_px: Noise of a point per axis, px.
    """

    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    intrinsics: FloatArray
    distortion: FloatArray
    landmarks_m: FloatArray
    model: str = "radtan"
    resolution: tuple[int, int] = (640, 480)
    estimate: frozenset[str] = frozenset()
    corner_sigma_px: float = 0.5
    seen: tuple[npt.NDArray[np.intp], ...] | None = None
    readout_axis: str = ROWS


def block_layout(setup: Setup) -> dict[str, slice]:
    """Return the columns of each block of unknowns."""
    sizes = [(name, 3) for name in ("attitude", "position", "velocity", "gyro_bias", "accel_bias", "gravity")]
    sizes += [("rotation", 3), ("lever_arm", 3), ("timeshift", 1)]
    if "intrinsics" in setup.estimate:
        sizes += [("intrinsics", 4), ("distortion", 4)]
    if "imu_matrix" in setup.estimate:
        sizes += [("gyro_matrix", 9), ("accel_matrix", 6)]
    if "target_scale" in setup.estimate:
        sizes += [("target_scale", 1)]
    if "readout" in setup.estimate:
        sizes += [("readout", 1)]
    layout, start = {}, 0
    for name, size in sizes:
        layout[name] = slice(start, start + size)
        start += size
    return layout


@dataclass(frozen=True)
class Direction:
    """A direction in the space of unknowns that the motion leaves open (or nearly so).

    Attributes:
        parts: Share of each block in it, largest first, as (block, share 0 to 1).
        vector: In the scaled unknowns, unit length, shape (p,).
        strength: Singular value relative to the largest.
    """

    parts: list[tuple[str, float]]
    vector: FloatArray
    strength: float


@dataclass(frozen=True)
class Observability:
    """The verdict.

    Attributes:
        blocks: Name of each block and its columns.
        rank: Directions determined.
        unknowns: How many there are.
        lost: Directions that are not.
        sigma: Bound on each unknown's standard deviation (inf in a lost direction), SI units, shape (p,).
        information: Of the unknowns in their own units, shape (p, p).
    """

    blocks: dict[str, slice]
    rank: int
    unknowns: int
    lost: list[Direction]
    sigma: FloatArray
    information: FloatArray
    units: FloatArray = field(repr=False, default_factory=lambda: np.ones(0))


def pose_sensitivities(
    motion: Motion, layout: dict[str, slice], p: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives of attitude, velocity and position at all times by the unknowns, each (m, 3, p).

    theta' = -R (db + dS w), v' = -hat(R f) theta - R (da + dA f) + dg, p' = v: [world frame, left attitude
    error]
    """
    m = len(motion.t_s)
    dt = np.diff(motion.t_s)
    R, w, f = motion.R_world_imu, motion.rate_rps, motion.specific_force_mps2
    eye = np.eye(3)
    theta = np.zeros((m, 3, p))
    theta[:, :, layout["attitude"]] = eye
    theta[:, :, layout["gyro_bias"]] = -running_integral(dt, R)
    if "gyro_matrix" in layout:
        flow = (R[:, :, :, None] * w[:, None, None, :]).reshape(m, 3, 9)
        theta[:, :, layout["gyro_matrix"]] = -running_integral(dt, flow)
    force = (R @ f[..., None])[..., 0]
    slope = -so3.hat(force) @ theta
    slope[:, :, layout["accel_bias"]] -= R
    slope[:, :, layout["gravity"]] += eye
    if "accel_matrix" in layout:
        rows, columns = np.tril_indices(3)
        slope[:, :, layout["accel_matrix"]] -= R[:, :, rows] * f[:, None, columns]
    velocity = running_integral(dt, slope)
    velocity[:, :, layout["velocity"]] += eye
    position = running_integral(dt, velocity)
    position[:, :, layout["position"]] += eye
    return theta, velocity, position


def gramian(motion: Motion, setup: Setup, frames: Sequence[int] | npt.NDArray[np.intp]) -> Observability:
    """Judge a motion.

    Args:
        motion: The motion.
        setup: Camera and points.
        frames: Samples of the motion at which an image is taken.

    Returns:
        What can be determined and what cannot.
    """
    layout = block_layout(setup)
    p = max(s.stop for s in layout.values())
    theta, _, position = pose_sensitivities(motion, layout, p)
    if setup.seen is not None:
        rows = [
            _frame_jacobian(motion, setup, layout, int(k), theta[k], position[k], ids)
            for k, ids in zip(frames, setup.seen, strict=True)
        ]
        return _of_unknown_points(rows, setup, layout)
    information = np.zeros((p, p))
    for k in frames:
        J = _frame_jacobian(motion, setup, layout, int(k), theta[k], position[k])[1]
        information += J.T @ J
    information /= setup.corner_sigma_px**2
    return judge(information, layout)


def _of_unknown_points(
    rows: list[tuple[IntArray, FloatArray]], setup: Setup, layout: dict[str, slice]
) -> Observability:
    """Judge images of points whose places are unknown: points eliminated by the Schur complement.

    Where the first image was taken, and its heading, is the world's choice; so is what gravity does to its
    tilt. With z up and gravity of known size this leaves all unknowns but attitude, position and gravity's z.
    """
    kept = np.concatenate([_horizontal(name, columns) for name, columns in layout.items()])
    n = len(setup.landmarks_m)
    H, V, W = np.zeros((len(kept), len(kept))), np.zeros((n, 3, 3)), np.zeros((n, 3, len(kept)))
    for ids, stacked in rows:
        J = stacked.reshape(len(ids), 2, -1)
        by_point = -J[:, :, layout["position"]]  # a point that moves is a camera that moves back
        J = J[:, :, kept]
        H += np.einsum("nia,nib->ab", J, J)
        V[ids] += np.swapaxes(by_point, 1, 2) @ by_point
        W[ids] += np.swapaxes(by_point, 1, 2) @ J
    V += (1e-12 * np.trace(V, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)  # seen once, or never
    information = H - np.einsum("nia,nib->ab", W, np.linalg.solve(V, W))
    blocks, start = {}, 0
    for name, columns in layout.items():
        size = len(_horizontal(name, columns))
        if size:
            blocks[name] = slice(start, start + size)
            start += size
    return judge(information / setup.corner_sigma_px**2, blocks)


def _horizontal(name: str, columns: slice) -> IntArray:
    """Columns of a block that are no choice of the world."""
    if name in ("attitude", "position"):
        return np.zeros(0, np.intp)
    return np.arange(columns.start, columns.stop - (name == "gravity"))


def _frame_jacobian(
    motion: Motion,
    setup: Setup,
    layout: dict[str, slice],
    k: int,
    theta: FloatArray,
    position: FloatArray,
    among: IntArray | None = None,
) -> tuple[IntArray, FloatArray]:
    """Points (n,) seen in one image, of those `among` which it shows, and derivatives of pixels (2 n, p)."""
    R, p0 = motion.R_world_imu[k], motion.p_world_imu[k]
    landmarks = setup.landmarks_m if among is None else setup.landmarks_m[among]
    arm = landmarks - p0
    in_imu = arm @ R
    in_cam = (in_imu - setup.p_imu_cam) @ setup.R_imu_cam
    uv, J_point, J_lens = project_jacobians(in_cam, setup.intrinsics, setup.distortion, setup.model)
    width, height = setup.resolution
    with np.errstate(invalid="ignore"):
        seen = (uv >= -0.5).all(axis=1) & (uv[:, 0] < width - 0.5) & (uv[:, 1] < height - 0.5)
    ids = np.flatnonzero(seen & (in_cam[:, 2] > 0.01))
    R_cam_world = setup.R_imu_cam.T @ R.T
    by_theta = R_cam_world @ so3.hat(arm[ids])
    dX = by_theta @ theta - R_cam_world @ position
    dX[:, :, layout["rotation"]] += so3.hat(in_cam[ids])
    dX[:, :, layout["lever_arm"]] -= setup.R_imu_cam.T
    flow = by_theta @ (R @ motion.rate_rps[k]) - R_cam_world @ motion.v_world_imu[k]
    dX[:, :, layout["timeshift"]] += flow[:, :, None]
    if "readout" in layout:
        row = read_share(uv[ids], setup.resolution, setup.readout_axis)
        dX[:, :, layout["readout"]] += (flow * row[:, None])[:, :, None]
    if "target_scale" in layout:
        dX[:, :, layout["target_scale"]] += (landmarks[ids] @ R_cam_world.T)[:, :, None]
    J = J_point[ids] @ dX
    if "intrinsics" in layout:
        J[:, :, layout["intrinsics"]] += J_lens[ids, :, :4]
        J[:, :, layout["distortion"]] += J_lens[ids, :, 4:]
    return ids if among is None else among[ids], np.asarray(J.reshape(2 * len(ids), -1), dtype=np.float64)


def judge(information: FloatArray, layout: dict[str, slice], lost: float = _LOST) -> Observability:
    """Split the unknowns into what an information matrix determines and what it does not.

    Args:
        information: In the unknowns' own units, shape (p, p).
        layout: Columns of each block.
        lost: Relative singular value (of the measurements' derivative) below which a direction is lost.
    """
    p = len(information)
    units = np.ones(p)
    for name, columns in layout.items():
        units[columns] = UNITS[name]
    values, vectors = np.linalg.eigh(information * np.outer(units, units))
    strength = np.sqrt(np.maximum(values, 0.0) / max(float(values[-1]), 1e-300))
    # squaring loses digits: what the eigenvalues cannot resolve (1e-16 of the largest) is lost as well
    gone = strength < max(lost, 3e-8)
    keep = ~gone
    variance = np.einsum("ij,j->i", vectors[:, keep] ** 2, 1.0 / values[keep]) if keep.any() else np.zeros(p)
    touched = np.sqrt(np.sum(vectors[:, gone] ** 2, axis=1)) if gone.any() else np.zeros(p)
    sigma = np.where(touched > 1e-4, np.inf, units * np.sqrt(variance))
    directions = [
        Direction(_parts(vectors[:, i], layout), vectors[:, i], float(strength[i]))
        for i in np.flatnonzero(gone)
    ]
    return Observability(layout, int(keep.sum()), p, directions, sigma, information, units)


def _parts(vector: FloatArray, layout: dict[str, slice]) -> list[tuple[str, float]]:
    shares = [(name, float(np.linalg.norm(vector[columns]))) for name, columns in layout.items()]
    return sorted(((n, s) for n, s in shares if s > 0.05), key=lambda part: -part[1])


def covariance_of(result: Observability, prior: float) -> FloatArray:
    """Return the covariance of all unknowns with next to no prior, so that lost directions stay finite.

    Args:
        result: The verdict.
        prior: Sigma of the prior in the units that make unknowns comparable (1e3: a radian, ten metres, a
            second).

    Returns:
        In the unknowns' own units, shape (p, p).
    """
    u = result.units
    values, vectors = np.linalg.eigh(result.information * np.outer(u, u))
    half = vectors / np.sqrt(np.maximum(values, 0.0) + prior**-2)
    return np.asarray((half @ half.T) * np.outer(u, u), dtype=np.float64)
