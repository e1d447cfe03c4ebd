"""The estimator's state: nominal values with names, and where each error lives in the covariance.

Attitude errors are generalised Rodrigues parameters with a = 1, f = 4 (four times the modified Rodrigues
parameters; equal to the rotation vector for small angles), local (right): R = R_nominal * delta.
[Crassidis & Markley, "Unscented filtering for spacecraft attitude estimation", 2003, eq. (33)-(35)]
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.target_modes import MODES, TargetModes

ATTITUDE = slice(0, 3)  # rad, local (right) error of R_world_imu
POSITION = slice(3, 6)  # m, p_world_imu
VELOCITY = slice(6, 9)  # m/s, in world
GYRO_BIAS = slice(9, 12)  # rad/s
ACCEL_BIAS = slice(12, 15)  # m/s^2
BIASES = slice(GYRO_BIAS.start, ACCEL_BIAS.stop)  # rad/s, then m/s^2
GRAVITY = slice(15, 18)  # m/s^2, in the world; see `moved_gravity`
MOTION = slice(ATTITUDE.start, VELOCITY.stop)  # what moves
CORE = GRAVITY.stop  # numbers of these

LOWER = np.array([(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)])  # entries of the accelerometer matrix
LOWER_FLAT = 3 * LOWER[:, 0] + LOWER[:, 1]  # the same among its nine numbers, row by row


@dataclass(frozen=True, slots=True)
class CameraSlices:
    """Where one camera's errors live; None: not estimated."""

    position: slice | None  # m, p_imu_cam
    rotation: slice | None  # rad, local (right) error of R_imu_cam
    timeshift: int | None  # s
    skew: int | None  # s/s, drift of the time shift
    intrinsics: slice | None  # px, fx fy cx cy
    distortion: slice | None  # 4 coefficients, or 5
    readout: int | None  # s


@dataclass(frozen=True, slots=True)
class Layout:
    """Order of the error state: [core | gravity | imu | cameras | target scale | target shape].

    The core is what moves, biases and gravity: of the filter as above, of a window see `MarginalPrior`.

    Attributes:
        core: Length of the core.
        size: Length of the error state.
        dynamic: Number of leading errors that enter the propagation (core, gravity and imu).
        gravity: Its magnitude, m/s^2, index, of a window, whose world stands upright; None: see `GRAVITY`.
        gyro_matrix: 9 entries, row-major, of M_g - I; None: not estimated.
        accel_matrix: 6 entries (lower triangle) of M_a - I; the lower triangle fixes the gauge, since a
            full matrix could be traded against R_imu_cam.
        accel_positions: Positions of the accelerometer's axes, 6 numbers of `imu_scale`, m, or None.
        accel_lag: How late the accelerometer's readings are against the gyro's, s, index or None.
        cameras: By name.
        target_scale: Relative size of the board, index or None.
        target_shape: How far the board is off in each of its modes, m; None: as in its file.
        target_modes: The ways in which it may be off; None: no target.
        held: Lenses that are held and whose errors are states all the same, by camera.
    """

    core: int
    size: int
    dynamic: int
    gravity: int | None
    gyro_matrix: slice | None
    accel_matrix: slice | None
    accel_positions: slice | None
    accel_lag: int | None
    cameras: dict[str, CameraSlices]
    target_scale: int | None
    target_shape: slice | None = None
    target_modes: TargetModes | None = None
    held: Mapping[str, FixedLens] = field(default_factory=dict)

    def __deepcopy__(self, memo: object) -> Layout:
        """Itself: it does not change, and a copy of a filter has the layout of the filter."""
        return self

    @property
    def inertial(self) -> slice:
        """Gravity of a window, and numbers of the imu (see `imu_scale`), as far as they are estimated."""
        return slice(self.core, self.dynamic)

    @property
    def camera(self) -> CameraSlices:
        """Of the only camera."""
        (only,) = self.cameras.values()
        return only

    @property
    def drifts(self) -> list[tuple[int, int]]:
        """Where errors of time shifts and of their rates are."""
        cameras = self.cameras.values()
        return [(c.timeshift, c.skew) for c in cameras if c.timeshift is not None and c.skew is not None]

    def lens(self, camera: str) -> slice:
        """Where fx fy cx cy and the distortion of a lens lie, which must be among the errors."""
        where = self.cameras[camera]
        assert where.intrinsics is not None
        assert where.distortion is not None
        return slice(where.intrinsics.start, where.distortion.stop)

    def errors_of(self, camera: str) -> list[int]:
        """Where all errors of a camera lie."""
        where = self.cameras[camera]
        blocks = where.position, where.rotation, where.intrinsics, where.distortion
        places = [np.r_[block] for block in blocks if block is not None]
        ones = [place for place in (where.timeshift, where.skew, where.readout) if place is not None]
        return [*np.concatenate([*places, ones]).astype(int).tolist()]

    def lens_free(self, camera: str) -> bool:
        """Whether a lens is estimated, not held."""
        return self.cameras[camera].intrinsics is not None and camera not in self.held


def make_layout(
    models: Mapping[str, str],
    *,
    fix: frozenset[str],
    estimate: frozenset[str],
    target_m: FloatArray | None = None,
    held: Mapping[str, FixedLens] | None = None,
    core: int = CORE,
) -> Layout:
    """Lay the error state out.

    Args:
        models: Distortion model by camera.
        fix: Names as in `CalibrationOptions`.
        estimate: Likewise.
        target_m: Points of the target, m, shape (n, 3); None: no target.
        held: Lenses whose errors are states although they are in `fix`, by camera.
        core: Length of what comes before the constants.
    """
    places, held = _Places(core), dict(held or {})
    gravity = places.one(core != CORE)
    imu = "imu_intrinsics" in estimate
    gyro_matrix, accel_matrix = places.block(imu, 9), places.block(imu, 6)
    accel_positions = places.block("size_effect" in estimate, 6)
    accel_lag = places.one("accel_lag" in estimate)
    dynamic = places.used
    blocks = {
        name: _camera_slices(places, model, fix, held=name in held, readout="readout" in estimate)
        for name, model in models.items()
    }
    scale = places.one("target_scale" in estimate)
    modes = None if target_m is None else TargetModes.of(target_m)
    shape = places.block(modes is not None and "target_shape" in estimate, MODES)
    return Layout(
        core,
        places.used,
        dynamic,
        gravity,
        gyro_matrix,
        accel_matrix,
        accel_positions,
        accel_lag,
        blocks,
        scale,
        shape,
        modes,
        held,
    )


@dataclass(slots=True)
class _Places:
    """Hands out the places of an error state one after the other; `used`: how many so far."""

    used: int

    def block(self, wanted: bool, n: int) -> slice | None:
        """Places of n errors; None where they are not wanted."""
        if not wanted:
            return None
        self.used += n
        return slice(self.used - n, self.used)

    def one(self, wanted: bool) -> int | None:
        """Place of one error; None where it is not wanted."""
        place = self.block(wanted, 1)
        return None if place is None else place.start


def _camera_slices(
    places: _Places, model: str, fix: frozenset[str], *, held: bool, readout: bool
) -> CameraSlices:
    """Places of one camera; `held`: the errors of its lens are states although it is fixed."""
    pose, shift = "extrinsics" not in fix, "timeshift" not in fix
    lens = "intrinsics" not in fix or held
    return CameraSlices(
        position=places.block(pose, 3),
        rotation=places.block(pose, 3),
        timeshift=places.one(shift),
        skew=places.one(shift),
        intrinsics=places.block(lens, 4),
        distortion=places.block(lens, len(COEFFICIENTS[model])),
        readout=places.one(readout),
    )


@dataclass(slots=True)
class CameraState:
    """Nominal values of one camera (see `CameraEstimate`); `skew` is the drift of the time shift, s/s.

    `readout_axis` and `term`: see `CameraPrior`; they are no numbers, and stay.
    """

    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    timeshift_s: float
    intrinsics: FloatArray
    distortion: FloatArray
    distortion_model: str
    resolution: tuple[int, int]
    readout_s: float = 0.0
    skew: float = 0.0
    readout_axis: str = ""
    term: bool = False


@dataclass(slots=True)
class State:
    """Nominal state at `t_s` (the imu's clock).

    Attributes:
        t_s: Instant of the motion state, s since the base.
        R_world_imu: Attitude, shape (3, 3).
        p_world_imu: Position, m.
        v_world_imu: Velocity, m/s.
        gyro_bias: rad/s.
        accel_bias: m/s^2.
        gravity: Acceleration of free fall in the world, m/s^2, shape (3,).
        gyro_matrix: M_g in omega = M_g (omega_m - b_g).
        accel_matrix: M_a in f = M_a (f_m - b_a), lower triangular.
        cameras: By name.
        accel_positions: Of the accelerometer's axes x, y, z in the imu frame, m, shape (3, 3), of zero mean.
        accel_lag_s: The specific force stamped t is that of t - accel_lag_s; the gyro's stamps are right.
        target_scale: True size of the board over its stated size.
        target_shape: How far the board is off in each of `Layout.target_modes`, m, shape (11,).
    """

    t_s: float
    R_world_imu: FloatArray
    p_world_imu: FloatArray
    v_world_imu: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray
    gravity: FloatArray
    cameras: dict[str, CameraState]
    gyro_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    accel_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    accel_positions: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    accel_lag_s: float = 0.0
    target_scale: float = 1.0
    target_shape: FloatArray = field(default_factory=lambda: np.zeros(MODES))

    def __deepcopy__(self, memo: object) -> State:
        """With cameras of its own; arrays are shared, as every change of the state makes new ones."""
        return replace(self, cameras={name: replace(camera) for name, camera in self.cameras.items()})


class BiasStart(NamedTuple):
    """Biases and gravity at the beginning of a recording, known independently of the calibration.

    Attributes:
        gyro_bias: rad/s, shape (3,).
        accel_bias: m/s^2, shape (3,).
        gravity: Acceleration of free fall in the world, m/s^2; its size is that of before.
    """

    gyro_bias: FloatArray
    accel_bias: FloatArray
    gravity: FloatArray


class MotionStart(NamedTuple):
    """Motion at one instant, known independently of the calibration.

    Attributes:
        t_s: Instant, imu clock, s.
        R_world_imu: Attitude, shape (3, 3).
        p_world_imu: Position, m.
        v_world_imu: Velocity, m/s.
        sigmas: Of attitude (rad), position (m), velocity (m/s), shape (9,).
        elapsed_s: Since the state's instant; stamps may have stepped.
        biases: At the beginning of another recording; None: biases and gravity are those of before.
        turned: How the target seems to have turned against gravity, shape (3, 3); None: it has not moved.
    """

    t_s: float
    R_world_imu: FloatArray
    p_world_imu: FloatArray
    v_world_imu: FloatArray
    sigmas: FloatArray
    elapsed_s: float
    biases: BiasStart | None = None
    turned: FloatArray | None = None


def rotation_from_grp(p: FloatArray) -> FloatArray:
    """Rotation matrices of attitude errors (a = 1, f = 4), rational: no trigonometry.

    With s = |p|^2/16: R = I + 2/(1+s)^2 * (2 (1-s) hat(p)/4 + 4 hat(p)^2 / 16) [Schaub & Junkins (3.152)].

    Args:
        p: Errors, shape (..., 3).

    Returns:
        Rotations, shape (..., 3, 3).
    """
    m = 0.25 * p
    s = np.vecdot(m, m)
    d = 1.0 / (1.0 + s) ** 2
    gamma = 8.0 * d
    return so3.polynomial(1.0 - gamma * s, 4.0 * (1.0 - s) * d, gamma, m)


def rotation_of_grp(p: FloatArray) -> FloatArray:
    """`rotation_from_grp` of one error, shape (3,), in plain numbers: numpy takes ten times as long."""
    x, y, z = (0.25 * p).tolist()
    s = x * x + y * y + z * z
    d = 1.0 / (1.0 + s) ** 2
    return so3.rotation_one(x, y, z, 4.0 * (1.0 - s) * d, 8.0 * d)


def grp_from_rotation(R: FloatArray) -> FloatArray:
    """Attitude errors (a = 1, f = 4) of rotations below 180 degrees, shape (..., 3)."""
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    w = 0.5 * np.sqrt(np.maximum(1.0 + trace, 1e-12))
    v = np.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), axis=-1
    )
    out: FloatArray = v / (w * (1.0 + w))[..., None]
    return out


def moved_gravity(gravity: FloatArray, d: FloatArray) -> FloatArray:
    """Gravity moved by errors: what is along it changes its length, what is across turns it.

    Added as vectors, errors of the direction would change the length, which is known a hundred times better.

    Args:
        gravity: m/s^2, shape (3,).
        d: Errors, m/s^2, shape (..., 3).
    """
    length = math.sqrt(gravity @ gravity)
    along = (d @ gravity / length)[..., None]
    turned = gravity + d - along * gravity / length
    return np.asarray((length + along) * turned / np.sqrt(np.vecdot(turned, turned))[..., None])


def gravity_difference(gravity: FloatArray, origin: FloatArray) -> FloatArray:
    """Error that moves `origin` to `gravity`, m/s^2, shape (3,): the inverse of `moved_gravity`."""
    length, now = math.sqrt(origin @ origin), math.sqrt(gravity @ gravity)
    across = gravity * (length**2 / (gravity @ origin)) - origin
    return np.asarray(across + (now - length) * origin / length)


def gravity_root(gravity: FloatArray, direction_rad: float, size_mps2: float) -> FloatArray:
    """Square root of the covariance of gravity known to these sigmas, m/s^2, shape (3, 3)."""
    length = math.sqrt(gravity @ gravity)
    up = gravity / length
    along = up[:, None] * up
    return np.asarray(size_mps2 * along + direction_rad * length * (np.eye(3) - along))
