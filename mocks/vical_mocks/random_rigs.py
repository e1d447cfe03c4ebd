"""Random rigs, far from the reference: other lenses, boards, rates, noises, motions and faults.

Each seed draws a rig of its own: 320 to 1920 px and 45 to 120 deg across, boards of 2 to 12 cm squares
that fill half the image, gravity from any side, 5 to 60 images and 100 to 1000 inertial samples per second,
hand motion of 15 to 100 deg/s, sensors from good to cheap, stamps that jitter, outliers, features that break
off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vical_mocks.lens import Lens
from vical_mocks.points import SimulatedRun, board_points, crooked_board, simulate
from vical_mocks.rig import NOMINAL_R_IMU_CAM, STANDARD_GRAVITY_MPS2, ImuDensities, Rig, reference_rig
from vical_mocks.rotations import FloatArray
from vical_mocks.tracks import room_landmarks, simulate_tracks
from vical_mocks.trajectory import hand_motion

_SIZES = ((320, 240), (640, 480), (752, 480), (1280, 720), (1920, 1080))
_DAYS_APART = 100_000  # between the seeds of one rig's recordings; a study has fewer rigs


def draw_lens(rng: np.random.Generator) -> Lens:
    """Pinhole up to 85 deg across, fisheye beyond."""
    width, height = _SIZES[rng.integers(len(_SIZES))]
    across_deg = rng.uniform(45.0, 120.0)
    centre = np.array([width, height]) * (0.5 + rng.uniform(-0.02, 0.02, 2))
    if across_deg < 85.0:
        focal, model = 0.5 * width / np.tan(np.deg2rad(0.5 * across_deg)), "radtan"
        k = np.array([rng.uniform(-0.3, 0.05), rng.uniform(-0.05, 0.1), *rng.uniform(-1e-3, 1e-3, 2)])
    else:
        focal, model = width / np.deg2rad(across_deg), "equidistant"
        k = np.array([0.02, 0.01, 0.005, 0.001]) * rng.uniform(-1.0, 1.0, 4)
    f, k1234 = float(focal), tuple(k.tolist())
    return Lens((f, f * rng.uniform(0.99, 1.01), *centre.tolist()), k1234, (width, height), model)


def draw_densities(rng: np.random.Generator) -> ImuDensities:
    """From a tenth of a 3DM-GX3-25's noise to a cheap sensor's (accelerometer up to five times)."""
    gyro, accel, walk = np.exp(rng.uniform(np.log([0.1, 0.2, 0.2]), np.log([1.3, 5.0, 2.0])))
    usual = ImuDensities()
    return ImuDensities(
        usual.gyro * gyro, usual.gyro_walk * walk, usual.accel * accel, usual.accel_walk * walk
    )


def draw_sampling(rng: np.random.Generator) -> dict[str, Any]:
    """Rates, noise and faults: fields of `SimulationOptions`."""

    def pick(*values: float) -> float:
        return float(rng.choice(values))

    return {
        "imu_rate_hz": pick(100, 100, 200, 400, 1000),
        "camera_rate_hz": pick(5, 7.5, 10, 15, 20, 30, 60),
        "corner_sigma_px": float(np.exp(rng.uniform(np.log(0.1), np.log(1.0)))),
        "frame_sigma_px": pick(0.0, 0.0, 0.1),
        "stamp_jitter_s": pick(0.0, 0.0, 2e-4, 1e-3),
        "outlier_fraction": pick(0.0, 0.0, 0.02),
        "missing_fraction": pick(0.0, 0.0, 0.05),
        "frame_drop_fraction": pick(0.0, 0.0, 0.05),
    }


def draw_matrices(seed: int) -> dict[str, Any]:
    """Scale and alignment from 0.03 to 1 % off; what of the gyro's is no turn of the frame."""
    rng = np.random.default_rng([seed, 72])
    size = float(np.exp(rng.uniform(np.log(3e-4), np.log(1e-2))))
    G, A = size * rng.standard_normal((2, 3, 3))
    return {"gyro_matrix": np.eye(3) + 0.5 * (G + G.T), "accel_matrix": np.eye(3) + A}


def draw(
    seed: int,
    seconds: float,
    *,
    target_free: bool,
    imu_off: bool = False,
    day: int = 0,
    change: Callable[[Rig], Rig] | None = None,
) -> tuple[SimulatedRun, bool]:
    """A recording of the rig of this seed, and whether its lens is given.

    Args:
        seed: Of the rig: devices, mounting, board, the kind of motion.
        seconds: Length, s.
        target_free: Unknown landmarks instead of a board.
        imu_off: See `draw_matrices`.
        day: Recordings of other days have motion, biases and noise of their own.
        change: What has happened to the rig before this recording.
    """
    rng, own = np.random.default_rng([seed, 71]), seed + _DAYS_APART * day
    lens, densities, sampling = draw_lens(rng), draw_densities(rng), draw_sampling(rng)
    columns, rows = int(rng.integers(5, 13)), int(rng.integers(4, 10))
    spacing_m = float(rng.choice([0.02, 0.03, 0.05, 0.08, 0.12]))
    size_m = ((columns - 1) * spacing_m, (rows - 1) * spacing_m)
    half = np.arctan(0.5 * lens.resolution[0] / lens.intrinsics[0])
    distance_m = max(size_m[0] / (2.0 * np.tan(half) * rng.uniform(0.4, 0.75)), 1.2 * size_m[1])
    R = Rotation.random(rng=rng).as_matrix() if rng.random() < 0.7 else NOMINAL_R_IMU_CAM
    p = rng.standard_normal(3) / np.sqrt(3.0) * np.exp(rng.uniform(np.log(0.01), np.log(0.4)))
    motion = hand_motion(
        own,
        float(np.exp(rng.uniform(np.log(15.0), np.log(100.0)))),
        T_imu_cam=(R, p),
        board_size_m=size_m,
        distance_m=float(distance_m),
        style=str(rng.choice(["sinusoids", "spline"])),
    )
    down = rng.standard_normal(3)
    rig = reference_rig(
        own,
        trajectory=motion,
        densities=densities,
        timeshift_cam_imu_s=float(rng.uniform(-0.15, 0.15)),
        gravity_world_mps2=down * STANDARD_GRAVITY_MPS2 / np.linalg.norm(down),
        R_imu_cam=R,
        p_imu_cam=p,
        lens=lens,
        **(draw_matrices(seed) if imu_off else {}),
    )
    rig = rig if change is None else change(rig)
    lens_given = bool(rng.random() < 0.3)
    if not target_free:
        points = board_points(columns, rows, spacing_m)
        return simulate(own, seconds, rig=rig, points_m=points, **sampling), lens_given
    near_m, far_m = rng.uniform([0.4, 2.0], [1.5, 8.0])
    marks = room_landmarks(seed, int(rng.integers(120, 300)), near_m=near_m, far_m=far_m)
    features = int(rng.integers(30, 120))
    run = simulate_tracks(own, seconds, rig=rig, landmarks_m=marks, max_features=features, **sampling)
    return run, lens_given


def draw_all_off(seed: int, seconds: float, *, target_free: bool) -> tuple[SimulatedRun, bool, FloatArray]:
    """A recording in which nothing is quite as it should be, whether its lens is given, and the board's file.

    IMU matrices as `draw_matrices`; on about half the rigs each: axes of the accelerometer 4 mm apart (one
    sigma), a rolling shutter, clocks 40 ppm apart (one sigma), a late accelerometer, noise that changes, a
    moving average, stamps of the imu that jitter, a hidden part of the board; a board that is bent, 0.4 % too
    large or 2 % too small.
    """
    base, lens_given = draw(seed, 1.0, target_free=target_free, imu_off=True)
    rng = np.random.default_rng([seed, 73])
    off: dict[str, Any] = {}
    if rng.random() < 0.5:
        off |= {
            "readout_s": float(rng.uniform(4e-3, 0.03)),
            "readout_axis": str(rng.choice(["rows", "columns"])),
        }
    if rng.random() < 0.5:
        off["clock_skew_ppm"] = float(rng.normal(0.0, 40.0))
    if rng.random() < 0.5:
        apart_m = rng.normal(0.0, 4e-3, (3, 3))
        off["accel_positions"] = apart_m - apart_m.mean(axis=0)  # the lever arm refers to their mean
    options = {k: v for k, v in vars(base.options).items() if k != "epoch_ns"} | {
        "accel_lag_s": float(rng.choice([0.0, 1e-4, 3e-4])),
        "noise_spread": float(rng.choice([0.0, 0.4])),
        "imu_stamp_jitter_s": float(rng.choice([0.0, 0.0, 1e-4])),
        "imu_average_s": float(rng.choice([0.0, 1.0])) / base.options.imu_rate_hz,
        "corner_sigma_px": float(np.exp(rng.uniform(np.log(0.08), np.log(0.6)))),
    }
    rig, file_m = replace(base.rig, **off), base.points_m
    if target_free:
        features = int(rng.integers(30, 120))
        run = simulate_tracks(seed, seconds, rig=rig, landmarks_m=file_m, max_features=features, **options)
        return run, lens_given, file_m
    board_m = crooked_board(seed, file_m) if rng.random() < 0.6 else file_m
    board_m = board_m * float(rng.choice([1.0, 1.0, 1.004, 0.98]))
    options["hidden_fraction"] = float(rng.choice([0.0, 0.3]))
    return simulate(seed, seconds, rig=rig, points_m=board_m, **options), lens_given, file_m
