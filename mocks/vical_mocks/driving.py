"""A robot that drives along a corridor and looks ahead: its motion, and the features that it passes.

World: z along the corridor, x to the right, y down; the camera begins at the origin and looks along z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vical_mocks.curves import Pause, Sinusoids
from vical_mocks.points import SimulatedRun
from vical_mocks.rig import STANDARD_GRAVITY_MPS2, Rig
from vical_mocks.rotations import FloatArray
from vical_mocks.tracks import simulate_tracks
from vical_mocks.trajectory import Pose, Trajectory

DOWN: FloatArray = np.array([0.0, 1.0, 0.0])
"""Direction of gravity in the world of this module."""
_WEAVE_HZ = (0.04, 0.12)  # how often it steers to one side and back
_SHAKE_HZ = (0.7, 2.5)  # of the body on its wheels
_SHAKE_RAD = np.deg2rad(0.4)  # an axis, on a floor that is not quite even
_HEAVE_M = 2e-3


def driving(seed: int, *, speed_mps: float = 0.8, T_imu_cam: Pose | None = None) -> Trajectory:
    """Drive along the corridor: steering to and fro, with the shaking of an uneven floor.

    Args:
        seed: Chooses frequencies, phases and amplitudes.
        speed_mps: Along the corridor.
        T_imu_cam: (R_imu_cam, p_imu_cam), the camera that looks ahead; None: camera = imu.

    Returns:
        A trajectory valid for all times. The heading follows the path to first order in the steering angle.
    """
    rng = np.random.default_rng([seed, 16])
    steer_hz, steer_phase = rng.uniform(*_WEAVE_HZ, 2), rng.uniform(0, 2 * np.pi, 2)
    steer_rad = np.deg2rad(rng.uniform(5.0, 15.0, 2))
    shake_hz, shake_phase = rng.uniform(*_SHAKE_HZ, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    shake_rad = _SHAKE_RAD * rng.uniform(0.5, 1.0, (3, 3)) / np.sqrt(1.5)

    def per_axis(axis: int, values: FloatArray) -> FloatArray:
        out = np.zeros((len(values), 3))
        out[:, axis] = values
        return out

    rotation = Sinusoids(
        np.zeros(3),
        np.vstack([shake_rad, per_axis(1, steer_rad)]),
        np.vstack([shake_hz, per_axis(1, steer_hz)]),
        np.vstack([shake_phase, per_axis(1, steer_phase)]),
    )
    # dx/dt = speed * heading, so x lags the heading by a quarter of a turn
    aside_m = speed_mps * steer_rad / (2 * np.pi * steer_hz)
    heave_hz, heave_phase = rng.uniform(*_SHAKE_HZ, 1), rng.uniform(0, 2 * np.pi, 1)
    pace_hz, pace_phase = rng.uniform(*_WEAVE_HZ, 1), rng.uniform(0, 2 * np.pi, 1)
    pace_m = 0.3 * speed_mps / (2 * np.pi * pace_hz)  # 30 % faster and slower
    position = Sinusoids(
        np.zeros(3),
        np.vstack([per_axis(0, aside_m), per_axis(1, np.full(1, _HEAVE_M)), per_axis(2, pace_m)]),
        np.vstack([per_axis(0, steer_hz), per_axis(1, heave_hz), per_axis(2, pace_hz)]),
        np.vstack([per_axis(0, steer_phase - np.pi / 2), per_axis(1, heave_phase), per_axis(2, pace_phase)]),
        np.array([0.0, 0.0, speed_mps]),
    )
    imu = None if T_imu_cam is None else (T_imu_cam[0].T, -T_imu_cam[0].T @ T_imu_cam[1])
    return Trajectory(rotation, position, None, imu)


def corridor(seed: int, length_m: float, *, per_m: float = 12.0, half_width_m: float = 3.0) -> FloatArray:
    """Features on the walls, the floor and the ceiling of the corridor ahead, m, shape (n, 3).

    Args:
        seed: Of the places.
        length_m: How far the robot drives.
        per_m: Features in each metre.
        half_width_m: From the middle to each wall. The floor is 0.5 m below the camera, the ceiling 2 m
            above.
    """
    rng = np.random.default_rng([seed, 42])
    count = round(per_m * (length_m + 15.0))
    x = rng.uniform(-half_width_m, half_width_m, count)
    y = rng.uniform(-2.0, 0.5, count)
    wall = rng.random(count) < 0.6
    x = np.where(wall, np.where(x > 0, half_width_m, -half_width_m) * rng.uniform(0.6, 1.0, count), x)
    y = np.where(wall, y, np.where(y > -0.75, 0.5, -2.0))
    return np.stack([x, y, rng.uniform(0.5, length_m + 15.0, count)], axis=1)


def simulate_drive(
    seed: int, duration_s: float, *, rig: Rig, pauses: Sequence[Pause] = (), **options: Any
) -> SimulatedRun:
    """Tracks and inertial readings of a drive along a corridor.

    Args:
        seed: Of everything random, the speed included.
        duration_s: Length, s.
        rig: The robot; its motion and gravity are replaced.
        pauses: When it stands still.
        **options: Fields of `SimulationOptions`.
    """
    rng = np.random.default_rng([seed, 43])
    speed_mps, features = float(rng.uniform(0.4, 1.5)), int(rng.integers(50, 100))
    motion = driving(seed, speed_mps=speed_mps, T_imu_cam=(rig.R_imu_cam, np.asarray(rig.p_imu_cam)))
    moving = replace(
        rig, trajectory=motion.with_pauses(pauses), gravity_world_mps2=STANDARD_GRAVITY_MPS2 * DOWN
    )
    marks = corridor(seed, speed_mps * duration_s)
    return simulate_tracks(seed, duration_s, rig=moving, landmarks_m=marks, max_features=features, **options)
