"""The truth about a simulated rig: where things are, how they move, how wrong the sensors are.

Time: `t_s` is seconds of the imu's clock since the start of the simulation; it *is* true time. The camera's
clock differs: `t_imu = t_cam + timeshift` (Kalibr's sign), where the shift may drift (skew) and jump (bump).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_mocks.lens import Lens
from vical_mocks.rotations import FloatArray, exp_so3, quaternion_wxyz
from vical_mocks.trajectory import Trajectory, hand_motion

STANDARD_GRAVITY_MPS2 = 9.80665
_DERIVATIVE_S = 1e-4  # of rates, by central differences


@dataclass(frozen=True)
class ImuDensities:
    """Continuous-time noise densities; the defaults are those of a 3DM-GX3-25."""

    gyro: float = float(np.deg2rad(0.03))  # rad/s/sqrt(Hz)
    gyro_walk: float = 2.0e-5  # rad/s^2/sqrt(Hz)
    accel: float = 80e-6 * STANDARD_GRAVITY_MPS2  # m/s^2/sqrt(Hz)
    accel_walk: float = 2.0e-4  # m/s^3/sqrt(Hz)

    def scaled(self, factor: float) -> ImuDensities:
        """All four densities times `factor`."""
        return ImuDensities(
            self.gyro * factor, self.gyro_walk * factor, self.accel * factor, self.accel_walk * factor
        )


class BiasWalk:
    """A bias that starts somewhere and walks at random; the same seed gives the same walk.

    Args:
        start: Value at time 0, shape (3,).
        density: Density of the walk, unit of the bias per sqrt(s).
        seed: Of the random steps.
        step_s: Between the knots of the walk; linear in between. Times before 0 have the starting value.
    """

    def __init__(self, start: npt.ArrayLike, density: float, seed: int, step_s: float = 0.1) -> None:
        self._density, self._seed, self._step_s = density, seed, step_s
        self._rng = np.random.default_rng([seed, 21])
        self._knots = np.asarray(start, np.float64)[None]
        self._lock = threading.Lock()
        self._jump: tuple[float, FloatArray] | None = None

    def with_step(self, at_s: float, step: npt.ArrayLike) -> BiasWalk:
        """The same walk, but for a step from `at_s` on, in the unit of the bias, shape (3,)."""
        other = BiasWalk(self._knots[0], self._density, self._seed, self._step_s)
        other._jump = at_s, np.asarray(step, np.float64)
        return other

    def value(self, t_s: npt.ArrayLike) -> FloatArray:
        """Bias at times `t_s`, shape (..., 3)."""
        x = np.maximum(np.asarray(t_s, np.float64), 0.0) / self._step_s
        needed = int(np.max(x, initial=0.0)) + 2
        with self._lock:  # the emulator asks from several threads
            if needed > len(self._knots):
                # Always whole blocks of the same size: the walk must not depend on how it is asked for.
                blocks = -(-(needed - len(self._knots)) // 1024)
                steps = self._rng.standard_normal((blocks * 1024, 3)) * self._density * np.sqrt(self._step_s)
                self._knots = np.vstack([self._knots, self._knots[-1] + np.cumsum(steps, axis=0)])
            knots = self._knots
        i = np.floor(x).astype(np.int64)
        w = (x - i)[..., None]
        out = np.asarray(knots[i] * (1 - w) + knots[i + 1] * w)
        if self._jump is not None:
            at_s, step = self._jump
            out = out + (np.asarray(t_s) >= at_s)[..., None] * step
        return out


@dataclass(frozen=True)
class Bump:
    """The camera is knocked at `at_s`: extrinsics and time shift jump once.

    Attributes:
        at_s: When, s (imu clock).
        rotation_rad: Added rotation vector, in the old camera frame: R_imu_cam @ exp(rotation).
        translation_m: Added to p_imu_cam, imu frame.
        timeshift_s: Added to the time shift.
    """

    at_s: float
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    timeshift_s: float = 0.0


# The lens looks along the imu's x axis, its right is the imu's -y: a camera bolted on the front of a robot,
# a few degrees from square.
NOMINAL_R_IMU_CAM: FloatArray = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ exp_so3(
    np.deg2rad([2.0, -3.0, 1.5])
)
NOMINAL_P_IMU_CAM: FloatArray = np.array([0.08, 0.02, -0.03])
# The board leans against a wall: gravity is along no axis of the target frame.
NOMINAL_GRAVITY_DIRECTION: FloatArray = np.array([0.12, 0.93, 0.347])


def nominal_gravity(magnitude_mps2: float = STANDARD_GRAVITY_MPS2) -> FloatArray:
    """Free fall in the target frame of a board that stands, leaning a little, m/s^2."""
    return np.asarray(magnitude_mps2 * NOMINAL_GRAVITY_DIRECTION / np.linalg.norm(NOMINAL_GRAVITY_DIRECTION))


@dataclass(frozen=True)
class Rig:
    """Truth of one imu and one camera.

    Attributes:
        trajectory: Motion of the imu in the world (= target frame).
        R_imu_cam: Attitude of the camera in the imu before any bump, shape (3, 3).
        p_imu_cam: Lever arm before any bump, m, shape (3,).
        timeshift_cam_imu_s: t_imu = t_cam + timeshift at t_s = 0, s.
        clock_skew_ppm: Growth of the shift, microseconds per second.
        clock_skew_from_s: When it begins to grow, s.
        gravity_world_mps2: Acceleration of free fall in the target frame; not along an axis.
        lens: Intrinsics and distortion.
        readout_s: First to last row; 0: global shutter. The frame's stamp is that of the middle row:
            row v is taken readout_s * (v / height - 0.5) later.
        readout_axis: "rows", or "columns": column u is taken readout_s * (u / width - 0.5) later.
        densities: White noise and bias walks of the imu.
        gyro_bias, accel_bias: rad/s and m/s^2.
        gyro_matrix, accel_matrix: Scale and misalignment: reading = matrix @ truth + bias + noise.
        accel_positions: Of the accelerometer's axes x, y, z in the imu frame, m, shape (3, 3).
        bumps: Knocks, in order of time.
    """

    trajectory: Trajectory
    R_imu_cam: FloatArray = field(default_factory=lambda: NOMINAL_R_IMU_CAM.copy())
    p_imu_cam: FloatArray = field(default_factory=lambda: NOMINAL_P_IMU_CAM.copy())
    timeshift_cam_imu_s: float = 0.0
    clock_skew_ppm: float = 0.0
    clock_skew_from_s: float = 0.0
    gravity_world_mps2: FloatArray = field(default_factory=nominal_gravity)
    lens: Lens = field(default_factory=Lens)
    readout_s: float = 0.0
    readout_axis: str = "rows"
    densities: ImuDensities = field(default_factory=ImuDensities)
    gyro_bias: BiasWalk = field(default_factory=lambda: BiasWalk(np.zeros(3), 0.0, 0))
    accel_bias: BiasWalk = field(default_factory=lambda: BiasWalk(np.zeros(3), 0.0, 0))
    gyro_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    accel_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    accel_positions: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    bumps: tuple[Bump, ...] = ()

    def row_share(self, uv_px: FloatArray) -> FloatArray:
        """When points (..., 2) are read from the middle of the image on, as a share of the readout."""
        axis = ("columns", "rows").index(self.readout_axis)
        return np.asarray(uv_px[..., axis] / self.lens.resolution[axis] - 0.5)

    # --- time -----------------------------------------------------------------------------------------
    def timeshift_at(self, t_s: npt.ArrayLike) -> FloatArray:
        """The shift t_imu - t_cam at imu times `t_s`, s, shape of `t_s`."""
        t = np.asarray(t_s, np.float64)
        drifted_s = np.maximum(t - self.clock_skew_from_s, 0.0) if self.clock_skew_from_s else t
        shift = self.timeshift_cam_imu_s + self.clock_skew_ppm * 1e-6 * drifted_s
        for bump in self.bumps:
            shift = shift + np.where(t >= bump.at_s, bump.timeshift_s, 0.0)
        return np.asarray(shift)

    def t_cam(self, t_s: npt.ArrayLike) -> FloatArray:
        """What the camera's clock shows at imu times `t_s`, s."""
        return np.asarray(t_s, np.float64) - self.timeshift_at(t_s)

    # --- space ----------------------------------------------------------------------------------------
    def extrinsics_at(self, t_s: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """R_imu_cam (..., 3, 3) and p_imu_cam (..., 3) at imu times `t_s`, bumps included."""
        t = np.asarray(t_s, np.float64)
        R = np.broadcast_to(self.R_imu_cam, (*t.shape, 3, 3))
        p = np.broadcast_to(self.p_imu_cam, (*t.shape, 3))
        for bump in self.bumps:
            after = t >= bump.at_s
            R = np.where(after[..., None, None], R @ exp_so3(bump.rotation_rad), R)
            p = np.where(after[..., None], p + np.asarray(bump.translation_m), p)
        return np.asarray(R), np.asarray(p)

    def camera_pose_target(self, t_s: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pose of the camera in the target frame at imu (true) times `t_s`.

        Returns:
            R_target_cam of shape (..., 3, 3) and p_target_cam, m, of shape (..., 3): the point
            `p_cam` of the camera frame is at `R_target_cam @ p_cam + p_target_cam`.
        """
        R_world_imu = self.trajectory.R_world_imu(t_s)
        R_imu_cam, p_imu_cam = self.extrinsics_at(t_s)
        lever = np.einsum("...ij,...j->...i", R_world_imu, p_imu_cam)
        return np.asarray(R_world_imu @ R_imu_cam), self.trajectory.p_world_imu(t_s) + lever

    def points_in_camera(self, t_s: npt.ArrayLike, points_m: FloatArray) -> FloatArray:
        """World points (n, 3) in the camera frame at times (...,): shape (..., n, 3), m."""
        R, p = self.camera_pose_target(t_s)
        return np.asarray((points_m - p[..., None, :]) @ R)

    # --- inertial -------------------------------------------------------------------------------------
    def imu_motion(self, t_s: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """True angular rate (rad/s) and specific force (m/s^2) in the imu frame, each (..., 3); no errors."""
        R_world_imu = self.trajectory.R_world_imu(t_s)
        force_world = self.trajectory.a_world_imu(t_s) - self.gravity_world_mps2
        force = np.einsum("...ji,...j->...i", R_world_imu, force_world)
        return self.trajectory.omega_imu_rps(t_s), np.asarray(force)

    def imu_reading(self, t_s: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """What the sensors would show without white noise: scale, misalignment and biases included."""
        rate, force = self.imu_motion(t_s)
        if self.accel_positions.any():
            force = force + self._size_effect(t_s, rate)
        gyro = rate @ self.gyro_matrix.T + self.gyro_bias.value(t_s)
        return gyro, force @ self.accel_matrix.T + self.accel_bias.value(t_s)

    def _size_effect(self, t_s: npt.ArrayLike, rate: FloatArray) -> FloatArray:
        """What each axis measures for its distance from the origin, m/s^2, shape (..., 3)."""
        t = np.asarray(t_s)
        before, after = (self.trajectory.omega_imu_rps(t + d) for d in (-_DERIVATIVE_S, _DERIVATIVE_S))
        turning = (after - before) / (2.0 * _DERIVATIVE_S)
        axes = [
            (np.cross(turning, r) + np.cross(rate, np.cross(rate, r)))[..., i]
            for i, r in enumerate(self.accel_positions)
        ]
        return np.stack(axes, axis=-1)

    # --- for people and reports -----------------------------------------------------------------------
    def truth(self, t_s: float = 0.0, camera: str = "cam0") -> dict[str, Any]:
        """The truth at `t_s` in the JSON form of `vical calibrate --json`."""
        R_imu_cam, p_imu_cam = self.extrinsics_at(t_s)
        return {
            "cameras": {
                camera: {
                    "T_imu_cam": {"p_m": p_imu_cam.tolist(), "q_wxyz": quaternion_wxyz(R_imu_cam).tolist()},
                    "timeshift_cam_imu_s": float(self.timeshift_at(t_s)),
                    "intrinsics": list(self.lens.intrinsics),
                    "distortion_model": self.lens.model,
                    "distortion": list(self.lens.distortion),
                }
            },
            "imu": {
                "gyro_bias_rps": self.gyro_bias.value(t_s).tolist(),
                "accel_bias_mps2": self.accel_bias.value(t_s).tolist(),
            },
            "gravity_world_mps2": self.gravity_world_mps2.tolist(),
        }


def reference_rig(
    seed: int,
    *,
    mean_rate_dps: float = 55.0,
    timeshift_cam_imu_s: float = 0.0,
    trajectory: Trajectory | None = None,
    densities: ImuDensities | None = None,
    side: int = -1,
    **changes: Any,
) -> Rig:
    """The reference case: hand motion before an 8 x 6 x 50 mm board, GX3 noise, 640 x 480, f = 520 px.

    Args:
        seed: Chooses motion and biases.
        mean_rate_dps: Of the hand motion, deg/s.
        timeshift_cam_imu_s: True shift, s.
        trajectory: Instead of the hand motion.
        densities: Instead of the GX3's.
        side: See `vical_mocks.trajectory`.
        **changes: Any other field of `Rig`.
    """
    rng = np.random.default_rng([seed, 22])
    noise = ImuDensities() if densities is None else densities
    extrinsics = (changes.get("R_imu_cam", NOMINAL_R_IMU_CAM), changes.get("p_imu_cam", NOMINAL_P_IMU_CAM))
    motion = trajectory or hand_motion(seed, mean_rate_dps, T_imu_cam=extrinsics, side=side)
    biases = {
        "gyro_bias": BiasWalk(np.deg2rad(0.2) * rng.standard_normal(3), noise.gyro_walk, seed),
        "accel_bias": BiasWalk(0.02 * rng.standard_normal(3), noise.accel_walk, seed + 1_000_003),
    }
    return Rig(
        trajectory=motion,
        timeshift_cam_imu_s=timeshift_cam_imu_s,
        densities=noise,
        **(biases | changes),
    )
