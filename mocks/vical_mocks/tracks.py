"""Simulated feature tracks: unknown landmarks of a room, as a tracker would deliver them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from vical_mocks.points import (
    SimulatedFrame,
    SimulatedRun,
    SimulationOptions,
    add_pixel_noise,
    exposure_times,
    project_points,
    simulate_imu,
)
from vical_mocks.rig import Rig, reference_rig
from vical_mocks.rotations import FloatArray


def room_landmarks(
    seed: int,
    count: int = 180,
    *,
    near_m: float = 0.6,
    far_m: float = 3.0,
    centre_m: FloatArray | None = None,
) -> FloatArray:
    """A cloud of landmarks around the viewing direction of `hand_motion`, world frame, m, shape (count, 3).

    Directions are uniform over +-50 deg x +-42 deg around the middle of the board as seen from the usual
    viewpoint, distances uniform in [near_m, far_m] from there: with 180 about 60 are in view at a time.

    Args:
        seed: Of the cloud.
        count: How many.
        near_m: Least distance along the optical axis, m.
        far_m: Largest distance, m.
        centre_m: Viewpoint, m; None: that of `hand_motion` with its defaults.
    """
    rng = np.random.default_rng([seed, 41])
    viewpoint = np.array([0.175, 0.125, -0.6]) if centre_m is None else np.asarray(centre_m, np.float64)
    depth = rng.uniform(near_m, far_m, count)
    x = depth * np.tan(np.deg2rad(rng.uniform(-50, 50, count)))
    y = depth * np.tan(np.deg2rad(rng.uniform(-42, 42, count)))
    return np.asarray(viewpoint + np.stack([x, y, depth], axis=-1))


def simulate_tracks(
    seed: int,
    duration_s: float = 60.0,
    *,
    rig: Rig | None = None,
    landmarks_m: FloatArray | None = None,
    max_features: int = 60,
    new_id_on_return: bool = True,
    moving_fraction: float = 0.0,
    timeshift_cam_imu_s: float = 0.0,
    **options: Any,
) -> SimulatedRun:
    """Simulate a recording of unknown landmarks, as a feature tracker would deliver them.

    At most `max_features` are followed at a time; one that leaves the image is lost, and when it comes back
    it is a new feature (unless `new_id_on_return` is off).

    Args:
        seed: Of everything random.
        duration_s: Length, s.
        rig: Truth; None: `reference_rig`.
        landmarks_m: World points, shape (n, 3); None: `room_landmarks(seed)`.
        max_features: Tracks at a time.
        new_id_on_return: See above.
        moving_fraction: Share of landmarks that walk through the room at 0.2 m/s (outliers by nature).
        timeshift_cam_imu_s: Used only without `rig`.
        **options: Fields of `SimulationOptions` (`missing_fraction` breaks tracks).
    """
    chosen = SimulationOptions(**options)
    truth = rig or reference_rig(seed, timeshift_cam_imu_s=timeshift_cam_imu_s)
    points = room_landmarks(seed) if landmarks_m is None else np.asarray(landmarks_m, np.float64)
    rng = np.random.default_rng([seed, 32])
    t_imu_ns, gyro, force = simulate_imu(truth, duration_s, chosen, rng)
    t_s, t_cam_ns = exposure_times(truth, duration_s, chosen, rng)
    uv, visible = project_points(truth, t_s, points)
    moving = rng.random(len(points)) < moving_fraction
    if moving.any():
        uv[:, moving], visible[:, moving] = _walking(truth, t_s, points[moving], rng)
    visible &= rng.random(visible.shape) >= chosen.missing_fraction
    uv, outlier = add_pixel_noise(uv, chosen, rng)
    frames: list[SimulatedFrame] = []
    landmark_of: dict[int, int] = {}
    following: dict[int, int] = {}  # landmark to track id
    for i in range(len(t_s)):
        following = {row: track for row, track in following.items() if visible[i, row]}
        waiting = [int(row) for row in np.flatnonzero(visible[i]) if int(row) not in following]
        for row in rng.permutation(waiting)[: max_features - len(following)]:
            track = len(landmark_of) if new_id_on_return else int(row)
            following[int(row)] = track
            landmark_of[track] = int(row)
        rows = np.array(sorted(following), dtype=np.int64)
        ids = np.array([following[int(row)] for row in rows], dtype=np.int64)
        frames.append(
            SimulatedFrame(int(t_cam_ns[i]), ids, uv[i, rows], float(t_s[i]), outlier[i, rows] | moving[rows])
        )
    return SimulatedRun(truth, points, t_imu_ns, gyro, force, frames, chosen, duration_s, landmark_of)


def _walking(
    rig: Rig, t_s: FloatArray, points_m: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Pixels of points that walk at 0.2 m/s to and fro in random directions."""
    direction = rng.standard_normal(points_m.shape)
    direction *= 0.2 / np.linalg.norm(direction, axis=-1, keepdims=True)
    phase = rng.uniform(0, 2 * np.pi, len(points_m))
    offset = np.sin(t_s[:, None] + phase)[..., None] * direction
    R, p = rig.camera_pose_target(t_s)
    in_camera = np.einsum("fji,fnj->fni", R, points_m + offset - p[:, None])
    return rig.lens.project(in_camera)
