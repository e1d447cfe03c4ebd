"""What the model itself makes observable: Lie derivatives, computed numerically at a generic state.

The Lie derivatives of the outputs along the dynamics are, up to factorials, the Taylor coefficients in time
of what the camera sees. Those are computed exactly here, by arithmetic on truncated power series, for a
state and inputs drawn at random; their derivatives by the state come from the complex step, which loses no
digits. The rank of that matrix is the dimension of what can be found from any interval of data, however
short, if the motion is general. [Hermann & Krener 1977; Kelly & Sukhatme 2011 for the camera-imu case]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.power_series import ComplexArray, div, exp, matmul, mul, shift, trajectory
from vical_daemon.estimation.measurements import FloatArray

_STEP = 1e-30
_ORDER = 12
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class ModelBlocks:
    """Which unknowns the model has.

    Attributes:
        target_free: The points are unknown.
        timeshift: The camera is late by an unknown time.
        intrinsics: fx fy cx cy k1 k2 p1 p2 are unknown.
        imu_matrix: Gyro matrix (9) and lower-triangular accelerometer matrix (6) are unknown.
        target_scale: The board's size is unknown.
        readout: Rows are taken one after the other; how long an image takes is unknown.
        gravity: free (3 unknowns), magnitude (known: 2) or known (0: the world is level).
        points: How many points are seen.
    """

    target_free: bool = False
    timeshift: bool = True
    intrinsics: bool = False
    imu_matrix: bool = False
    target_scale: bool = False
    readout: bool = False
    gravity: Literal["free", "magnitude", "known"] = "free"
    points: int = 6


@dataclass(frozen=True)
class ModelRank:
    """The verdict on a model.

    Attributes:
        rank: Dimension of what can be found.
        unknowns: How many unknowns there are.
        singular_values: Of the scaled matrix, largest first.
        null_space: Orthonormal, shape (unknowns - rank, unknowns), in the order of `names`.
        names: One per unknown.
    """

    rank: int
    unknowns: int
    singular_values: FloatArray
    null_space: FloatArray
    names: list[str]


class _World:
    """A generic state and generic inputs; `outputs` maps small changes of the unknowns to Taylor series."""

    def __init__(self, blocks: ModelBlocks, seed: int, rate: FloatArray, force: FloatArray) -> None:
        rng = np.random.default_rng(seed)
        self.blocks = blocks
        self.R0, self.R_imu_cam = (exp(rng.normal(0, 0.6, 3).astype(np.complex128)) for _ in range(2))
        self.p0 = rng.normal(0, 0.3, 3)
        self.v0 = rng.normal(0, 0.5, 3)
        self.g = rng.normal(0, 1, 3)
        self.g *= 9.81 / np.linalg.norm(self.g)
        self.p_imu_cam = rng.normal(0, 0.3, 3)
        self.rate, self.force = rate, force
        # points in front of the camera at t = 0
        points = np.column_stack(
            (rng.uniform(-0.6, 0.6, (blocks.points, 2)), rng.uniform(1.0, 2.0, blocks.points))
        )
        in_imu = points @ self.R_imu_cam.real.T + self.p_imu_cam
        self.points = in_imu @ self.R0.real.T + self.p0
        self.names = self._names()

    def _names(self) -> list[str]:
        b = self.blocks
        sizes = [("attitude", 3), ("position", 3), ("velocity", 3), ("gyro_bias", 3), ("accel_bias", 3)]
        sizes += [
            ("gravity", {"free": 3, "magnitude": 2, "known": 0}[b.gravity]),
            ("rotation", 3),
            ("lever_arm", 3),
        ]
        sizes += [("timeshift", 1)] if b.timeshift else []
        sizes += [("lens", 8)] if b.intrinsics else []
        sizes += [("gyro_matrix", 9), ("accel_matrix", 6)] if b.imu_matrix else []
        sizes += [("target_scale", 1)] if b.target_scale else []
        sizes += [("readout", 1)] if b.readout else []
        sizes += [("landmark", 3 * b.points)] if b.target_free else []
        return [name for name, size in sizes for _ in range(size)]

    def outputs(self, x: ComplexArray) -> ComplexArray:
        """Taylor coefficients of all image coordinates for unknowns moved by x, flattened."""
        part = {
            name: x[[i for i, n in enumerate(self.names) if n == name]] for name in dict.fromkeys(self.names)
        }
        w, f = self.rate.astype(np.complex128), self.force.astype(np.complex128)
        if self.blocks.imu_matrix:
            w = w - w @ part["gyro_matrix"].reshape(3, 3).T
            A = np.zeros((3, 3), dtype=np.complex128)
            A[np.tril_indices(3)] = part["accel_matrix"]
            f = f - f @ A.T
        w[0] -= part["gyro_bias"]
        f[0] -= part["accel_bias"]
        g = self.g.astype(np.complex128)
        if self.blocks.gravity == "magnitude":
            g = g + part["gravity"] @ np.linalg.svd(self.g[None])[2][1:]
        elif self.blocks.gravity == "free":
            g = g + part["gravity"]
        R, p = trajectory(
            self.R0 @ exp(part["attitude"]), self.v0 + part["velocity"], self.p0 + part["position"], g, w, f
        )
        points = self.points.astype(np.complex128)
        if self.blocks.target_free:
            points = points + part["landmark"].reshape(-1, 3)
        if self.blocks.target_scale:
            points = points * (1.0 + part["target_scale"][0])
        return self._image(R, p, points, part).ravel()

    def _image(
        self, R: ComplexArray, p: ComplexArray, points: ComplexArray, part: dict[str, ComplexArray]
    ) -> ComplexArray:
        K = len(R)
        arm = -np.repeat(p[:, None], len(points), axis=1)
        arm[0] += points
        q = matmul(np.swapaxes(R, 1, 2), arm)
        q[0] -= self.p_imu_cam + part["lever_arm"]
        R_imu_cam = self.R_imu_cam @ exp(part["rotation"])
        X = q @ R_imu_cam
        xy = div(X[..., :2], X[..., 2:])
        if self.blocks.intrinsics:
            xy = self._lens(xy, part["lens"])
        late = np.zeros((K, len(points), 1), dtype=np.complex128)
        if self.blocks.timeshift:
            late[0] += part["timeshift"]
        if self.blocks.readout:
            late += part["readout"] * xy[..., 1:]  # a row is taken the later the lower it lies in the image
        if self.blocks.timeshift or self.blocks.readout:
            xy = shift(xy, late)
        return xy[: K - 1]

    @staticmethod
    def _lens(xy: ComplexArray, lens: ComplexArray) -> ComplexArray:
        """Pinhole with radtan around f = 1, c = 0, k = (-0.2, 0.1), p = 0."""
        x, y = xy[..., 0], xy[..., 1]
        r2 = mul(x, x) + mul(y, y)
        k1, k2, p1, p2 = -0.2 + lens[4], 0.1 + lens[5], 0.001 + lens[6], -0.002 + lens[7]
        radial = k1 * r2 + k2 * mul(r2, r2)
        radial[0] += 1.0
        xyy = mul(x, y)
        u = mul(x, radial) + 2 * p1 * xyy + p2 * (r2 + 2 * mul(x, x))
        v = mul(y, radial) + p1 * (r2 + 2 * mul(y, y)) + 2 * p2 * xyy
        out = np.stack((u * (1 + lens[0]), v * (1 + lens[1])), axis=-1)
        out[0] += lens[2:4]
        return out


def model_rank(blocks: ModelBlocks, motion: str = "general", seed: int = 0, order: int = _ORDER) -> ModelRank:
    """Rank of the Lie derivatives at a generic state.

    Args:
        blocks: The unknowns.
        motion: "general"; "one_axis" (rotation about one axis, any translation); "translation" (no rotation);
            "constant" (constant rate and constant velocity in the body, which the delay cannot survive).
        seed: Of state and inputs.
        order: Highest time derivative.

    Raises:
        ValueError: unknown motion.
    """
    rate, force = _inputs(motion, seed, order + 1)
    world = _World(blocks, seed, rate, force)
    if motion == "constant":
        world = _constant(world, order + 1)
    n = len(world.names)
    J = np.stack([world.outputs(1j * _STEP * np.eye(n)[i]).imag / _STEP for i in range(n)], axis=1)
    # Taylor coefficients of high order are small or large as the time unit likes: scale rows, then columns
    J = J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), 1e-12)
    columns = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    _, s, Vt = np.linalg.svd(J / columns)
    rank = int(np.count_nonzero(s > _TOLERANCE * s[0]))
    null = Vt[rank:] / columns
    null = np.linalg.qr(null.T)[0].T if len(null) else null
    return ModelRank(rank, n, s, np.asarray(null, dtype=np.float64), world.names)


def _inputs(motion: str, seed: int, K: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed + 1000)
    decay = 0.6 ** np.arange(K)[:, None]
    rate = rng.normal(0, 1.0, (K, 3)) * decay
    force = rng.normal(0, 3.0, (K, 3)) * decay
    if motion == "one_axis":
        axis = np.array([0.36, 0.48, 0.8])
        rate = rate[:, :1] * axis
    elif motion == "translation":
        rate = np.zeros_like(rate)
    elif motion == "constant":
        rate = np.zeros_like(rate)
        rate[0] = rng.normal(0, 1.0, 3)
    elif motion != "general":
        raise ValueError(f"unknown motion {motion!r}: use general, one_axis, translation or constant")
    return rate, force


def _constant(world: _World, K: int) -> _World:
    """Choose the force so that the velocity in the body stays constant: f = w x (R'v) - R'g."""
    w = world.rate[0]
    body_v = world.R0.real.T @ world.v0
    rate = world.rate.astype(np.complex128)
    zero = np.zeros(3, dtype=np.complex128)
    R, _ = trajectory(world.R0, zero, zero, zero, rate, np.zeros((K, 3), dtype=np.complex128))
    gravity = np.zeros((K, 3), dtype=np.complex128)
    gravity[0] = world.g
    force = -matmul(np.swapaxes(R, 1, 2), gravity)
    force[0] += np.cross(w, body_v)
    world.force = force.real
    return world
