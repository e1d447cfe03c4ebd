"""How the simulated rig moves: exact position, velocity, acceleration, attitude and angular rate.

World is the frame of the target: x along the columns, y along the rows (down in the image), z into the
board, origin at the first inner corner. With `side=-1` (default) the camera is at z = -distance and looks
along +z, so that a board drawn with x right and y down appears as in OpenCV; `side=+1` puts the camera in
front of a board whose z points out of it (Kalibr's AprilGrid: x right, y *up*).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from vical_mocks.curves import Curve, Pause, Paused, PeriodicSpline, Sinusoids
from vical_mocks.rotations import FloatArray, body_acceleration, body_rate, exp_so3

Pose = tuple[FloatArray, FloatArray]

# 8 x 6 inner corners, 50 mm apart: extent of the corners along x and y, m.
BOARD_SIZE_M = (0.35, 0.25)


class Trajectory:
    """Motion of the imu in the world, defined by the motion of a base rigidly fixed to it.

    Args:
        rotation: Rotation vector theta(t), rad: R_world_base = R_world_base0 @ exp(theta).
        position: Base origin in the world, m.
        R_world_base0: Attitude at theta = 0, shape (3, 3).
        T_base_imu: Pose of the imu in the base (R_base_imu, p_base_imu); None: the base is the imu.
    """

    def __init__(
        self,
        rotation: Curve,
        position: Curve,
        R_world_base0: FloatArray | None = None,
        T_base_imu: Pose | None = None,
    ) -> None:
        self.rotation, self.position = rotation, position
        self.R_world_base0 = np.eye(3) if R_world_base0 is None else np.asarray(R_world_base0, np.float64)
        self.R_base_imu, self.p_base_imu = (np.eye(3), np.zeros(3)) if T_base_imu is None else T_base_imu

    def R_world_imu(self, t_s: npt.ArrayLike) -> FloatArray:
        """Attitude at times `t_s` (scalar or any shape), shape (..., 3, 3)."""
        return np.asarray(self._R_world_base(np.asarray(t_s, np.float64)) @ self.R_base_imu)

    def p_world_imu(self, t_s: npt.ArrayLike) -> FloatArray:
        """Position, m, shape (..., 3)."""
        t = np.asarray(t_s, np.float64)
        return np.asarray(self.position.evaluate(t)[0] + self._R_world_base(t) @ self.p_base_imu)

    def v_world_imu(self, t_s: npt.ArrayLike) -> FloatArray:
        """Velocity in the world, m/s, shape (..., 3)."""
        t = np.asarray(t_s, np.float64)
        theta, first, _ = self.rotation.evaluate(t)
        lever = np.cross(body_rate(theta, first), self.p_base_imu)
        return self.position.evaluate(t)[1] + _apply(self.R_world_base0 @ exp_so3(theta), lever)

    def a_world_imu(self, t_s: npt.ArrayLike) -> FloatArray:
        """Acceleration in the world (without gravity), m/s^2, shape (..., 3)."""
        t = np.asarray(t_s, np.float64)
        theta, first, second = self.rotation.evaluate(t)
        rate, acceleration = body_rate(theta, first), body_acceleration(theta, first, second)
        lever = np.cross(acceleration, self.p_base_imu) + np.cross(rate, np.cross(rate, self.p_base_imu))
        return self.position.evaluate(t)[2] + _apply(self.R_world_base0 @ exp_so3(theta), lever)

    def omega_imu_rps(self, t_s: npt.ArrayLike) -> FloatArray:
        """Angular rate of the imu, in the imu frame, rad/s, shape (..., 3)."""
        theta, first, _ = self.rotation.evaluate(np.asarray(t_s, np.float64))
        return np.asarray(body_rate(theta, first) @ self.R_base_imu)

    def alpha_imu_rps2(self, t_s: npt.ArrayLike) -> FloatArray:
        """Angular acceleration of the imu, in the imu frame, rad/s^2, shape (..., 3)."""
        curve = self.rotation.evaluate(np.asarray(t_s, np.float64))
        return np.asarray(body_acceleration(*curve) @ self.R_base_imu)

    def mean_rate_dps(self, duration_s: float = 60.0) -> float:
        """Mean of the angular rate's magnitude over the first `duration_s`, deg/s."""
        rate = self.omega_imu_rps(np.linspace(0, duration_s, 6001))
        return float(np.rad2deg(np.mean(np.linalg.norm(rate, axis=-1))))

    def with_pauses(self, pauses: Sequence[Pause], ramp_s: float = 0.5) -> Trajectory:
        """The same motion, standing still during `pauses` (what comes after is delayed by them)."""
        return Trajectory(
            Paused(self.rotation, pauses, ramp_s),
            Paused(self.position, pauses, ramp_s),
            self.R_world_base0,
            (self.R_base_imu, self.p_base_imu),
        )

    def _R_world_base(self, t: FloatArray) -> FloatArray:
        return np.asarray(self.R_world_base0 @ exp_so3(self.rotation.evaluate(t)[0]))


def _apply(R: FloatArray, v: FloatArray) -> FloatArray:
    """Rotate vectors: (..., 3, 3) times (..., 3)."""
    return np.asarray(np.einsum("...ij,...j->...i", R, v))


def _viewing_base(side: int) -> FloatArray:
    """Attitude of a camera that looks straight at the board."""
    return np.eye(3) if side < 0 else np.diag([1.0, -1.0, -1.0])


def _imu_in_camera(T_imu_cam: Pose | None) -> Pose | None:
    if T_imu_cam is None:
        return None
    R_imu_cam, p_imu_cam = T_imu_cam
    return R_imu_cam.T, -R_imu_cam.T @ p_imu_cam


def _viewpoint(board_size_m: tuple[float, float], distance_m: float, side: int) -> FloatArray:
    return np.array([board_size_m[0] / 2, board_size_m[1] / 2, side * distance_m])


def hand_motion(
    seed: int,
    mean_rate_dps: float = 55.0,
    *,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
    style: str = "sinusoids",
) -> Trajectory:
    """A rig waved by hand in front of a board that stays in view nearly all the time.

    Slow tilts up to ~20 deg that the position follows (the camera orbits the board), quick shaking about
    all three axes and along them. All frequencies are scaled together so that the mean angular rate over
    the first minute is `mean_rate_dps`; at 55 deg/s the accelerations are about 1.5 m/s^2.

    Args:
        seed: Chooses phases, frequencies and amplitudes.
        mean_rate_dps: Mean magnitude of the angular rate, deg/s.
        T_imu_cam: (R_imu_cam, p_imu_cam), the lens that should keep the board in view; None: camera = imu.
        board_size_m: Extent of the board along x and y, m.
        distance_m: Mean distance of camera and board, m.
        side: -1: the camera is at negative z; +1: at positive z.
        style: "sinusoids" or "spline" (random knots instead of the quick shaking).

    Returns:
        A trajectory valid for all times.
    """
    rng = np.random.default_rng([seed, 11])
    rotation, position = _hand_curves(rng, 1.0, board_size_m, distance_m, side, style)
    base, imu = _viewing_base(side), _imu_in_camera(T_imu_cam)
    # Rates are proportional to the frequencies, but the window of a minute is not: a second pass settles it.
    speed = 1.0
    for _ in range(2):
        speed *= mean_rate_dps / Trajectory(rotation, position, base, imu).mean_rate_dps()
        rng = np.random.default_rng([seed, 11])
        rotation, position = _hand_curves(rng, speed, board_size_m, distance_m, side, style)
    return Trajectory(rotation, position, base, imu)


class _Sum:
    """Two curves added."""

    def __init__(self, a: Curve, b: Curve) -> None:
        self._a, self._b = a, b

    def evaluate(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        a, b = self._a.evaluate(t_s), self._b.evaluate(t_s)
        return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _hand_curves(
    rng: np.random.Generator,
    speed: float,
    board_size_m: tuple[float, float],
    distance_m: float,
    side: int,
    style: str,
) -> tuple[Curve, Curve]:
    """Rotation and position of the camera; `speed` scales all frequencies."""
    slow_hz = speed * rng.uniform(0.06, 0.25, (3, 3))
    slow_phase = rng.uniform(0, 2 * np.pi, (3, 3))
    slow_rad = np.deg2rad([10.0, 10.0, 14.0]) * rng.uniform(0.7, 1.1, (3, 3)) / np.sqrt(3)
    tilt = Sinusoids(np.zeros(3), slow_rad, slow_hz, slow_phase)
    # Tilting about y swings the view along x: the position takes it back, so that the camera orbits.
    orbit_hz, orbit_phase = slow_hz[:, [1, 0, 2]], slow_phase[:, [1, 0, 2]]
    orbit_m = slow_rad[:, [1, 0, 2]] * distance_m * np.array([-1.0, -side, 0.0])
    orbit = Sinusoids(_viewpoint(board_size_m, distance_m, side), orbit_m, orbit_hz, orbit_phase)
    quick_rad, quick_m = np.deg2rad([5.4, 5.4, 11.5]), distance_m * np.array([0.05, 0.04, 0.09])
    if style == "spline":
        knots, step_s = 256, 0.35 / speed
        return (
            _Sum(tilt, PeriodicSpline(0.8 * quick_rad * rng.standard_normal((knots, 3)), step_s)),
            _Sum(orbit, PeriodicSpline(0.8 * quick_m * rng.standard_normal((knots, 3)), step_s)),
        )
    if style != "sinusoids":
        raise ValueError(f"style {style!r} is not known; use 'sinusoids' or 'spline'")
    shake, sway = (
        Sinusoids(
            np.zeros(3),
            amplitude * rng.uniform(0.7, 1.3, (4, 3)) / np.sqrt(2),
            speed * rng.uniform(0.35, 1.3, (4, 3)),
            rng.uniform(0, 2 * np.pi, (4, 3)),
        )
        for amplitude in (quick_rad, quick_m)
    )
    return _Sum(tilt, shake), _Sum(orbit, sway)


def still(
    *,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
) -> Trajectory:
    """Nothing moves: no parameter of the extrinsics but the view itself can be found."""
    place = Sinusoids(_viewpoint(board_size_m, distance_m, side))
    tilted = Sinusoids(np.deg2rad([8.0, -10.0, 4.0]))
    return Trajectory(tilted, place, _viewing_base(side), _imu_in_camera(T_imu_cam))


def pure_translation(
    seed: int,
    *,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
) -> Trajectory:
    """Hand-like translation without any rotation: the lever arm is lost, the time shift is kept."""
    _, sway = _hand_curves(
        np.random.default_rng([seed, 12]), 2.0, board_size_m, distance_m, side, "sinusoids"
    )
    tilted = Sinusoids(np.deg2rad([8.0, -10.0, 4.0]))
    return Trajectory(tilted, sway, _viewing_base(side), _imu_in_camera(T_imu_cam))


def one_axis(
    seed: int,
    axis: npt.ArrayLike,
    *,
    mean_rate_dps: float = 40.0,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
) -> Trajectory:
    """Hand-like translation with rotation about one axis fixed in the *camera* (x right, y down, z out).

    The lever arm along that axis is lost.
    """
    direction = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    # About the optical axis the board stays in view however far one turns; about the others it does not.
    limit_rad = np.deg2rad(12.0 + 28.0 * direction[2] ** 2)
    rng = np.random.default_rng([seed, 13])
    _, sway = _hand_curves(rng, 1.5, board_size_m, distance_m, side, "sinusoids")
    share, base_hz = rng.uniform(0.7, 1.3, (4, 1)), rng.uniform(0.35, 1.3, (4, 1))
    phase = rng.uniform(0, 2 * np.pi, (4, 1))
    base, imu = _viewing_base(side), _imu_in_camera(T_imu_cam)
    speed = 1.0
    for _ in range(3):
        hz = np.tile(base_hz * speed, 3)
        turn = Sinusoids(np.zeros(3), share / 2 * limit_rad * direction, hz, np.tile(phase, 3))
        trajectory = Trajectory(turn, sway, base, imu)
        speed *= mean_rate_dps / trajectory.mean_rate_dps()
    return trajectory


def constant_rate(
    rate_dps: float = 40.0,
    *,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
) -> Trajectory:
    """Turns about the optical axis at one speed on the spot: the time shift cannot be found."""
    turn = Sinusoids(np.zeros(3), slope=np.array([0.0, 0.0, np.deg2rad(rate_dps)]))
    place = Sinusoids(_viewpoint(board_size_m, distance_m, side))
    return Trajectory(turn, place, _viewing_base(side), _imu_in_camera(T_imu_cam))


def fronto_parallel(
    seed: int,
    *,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
) -> Trajectory:
    """The image plane stays parallel to the board at one distance: focal length and distance mix.

    Rotation about the optical axis and shifts parallel to the board only.
    """
    rng = np.random.default_rng([seed, 14])
    turn = _three_waves(rng, np.zeros(3), np.deg2rad([0.0, 0.0, 20.0]), (0.2, 0.7))
    place = _viewpoint(board_size_m, distance_m, side)
    sway = _three_waves(rng, place, distance_m * np.array([0.06, 0.05, 0.0]), (0.3, 1.2))
    return Trajectory(turn, sway, _viewing_base(side), _imu_in_camera(T_imu_cam))


def planar(
    seed: int,
    *,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
) -> Trajectory:
    """A robot on a floor that looks ahead: turns about the camera's y axis and moves in its x-z plane only.

    The lever arm across the floor is lost.
    """
    rng = np.random.default_rng([seed, 15])
    turn = _three_waves(rng, np.zeros(3), np.deg2rad([0.0, 6.0, 0.0]), (0.4, 1.3))
    place = _viewpoint(board_size_m, distance_m, side)
    drive = _three_waves(rng, place, distance_m * np.array([0.08, 0.0, 0.1]), (0.3, 1.2))
    return Trajectory(turn, drive, _viewing_base(side), _imu_in_camera(T_imu_cam))


def about_a_point(
    seed: int,
    point_m: npt.ArrayLike = (0.02, 0.11, -0.04),
    *,
    T_imu_cam: Pose | None = None,
    board_size_m: tuple[float, float] = BOARD_SIZE_M,
    distance_m: float = 0.6,
    side: int = -1,
) -> Trajectory:
    """A tripod's head: turns about all axes and one point, in the frame of the camera, m, shape (3,).

    Without a board the scale is lost, and with it the lever arm along the line from the point to the camera.
    """
    rng = np.random.default_rng([seed, 16])
    turn = _three_waves(rng, np.zeros(3), np.deg2rad([6.0, 6.0, 8.0]), (0.4, 1.3))
    R, p = _imu_in_camera(T_imu_cam) or (np.eye(3), np.zeros(3))
    place = Sinusoids(_viewpoint(board_size_m, distance_m, side))
    return Trajectory(turn, place, _viewing_base(side), (R, p - np.asarray(point_m)))


def _three_waves(
    rng: np.random.Generator, middle: FloatArray, amplitude: FloatArray, hz: tuple[float, float]
) -> Sinusoids:
    """Three sinusoids an axis of one amplitude (shape (3,)), at frequencies and phases of chance."""
    return Sinusoids(middle, np.tile(amplitude, (3, 1)), rng.uniform(*hz, (3, 3)), rng.uniform(0, 6, (3, 3)))
