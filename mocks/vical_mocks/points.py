"""Fast simulation at the level of corners: no images, exact truth, honest noise (tracks: `tracks.py`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_mocks.rig import Rig, reference_rig
from vical_mocks.rotations import FloatArray

IntArray = npt.NDArray[np.int64]

# Simulated stamps are UNIX-sized on purpose: whoever turns them into float seconds too early loses 0.2 us.
EPOCH_NS = 1_700_000_000_000_000_000


def board_points(columns: int = 8, rows: int = 6, spacing_m: float = 0.05) -> FloatArray:
    """Inner corners of a checkerboard in the target frame, m, (rows*columns, 3); id = row*columns + col."""
    col, row = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([col.ravel() * spacing_m, row.ravel() * spacing_m, np.zeros(col.size)], axis=-1)


def crooked_board(seed: int, flat_m: FloatArray | None = None) -> FloatArray:
    """A board as a printer and a table make it, m, (n, 3).

    Narrower than tall by 0.2 % and skew (one-sigma), bent and twisted by 0.5 mm at its edges, bowed in its
    plane by 0.2 mm, each corner 0.15 mm from its place; not turned, shifted or grown as a whole, which no
    image shows.

    Args:
        seed: Of the errors.
        flat_m: The board as it should be, shape (n, 3); None: that of `board_points`. Its size scales the
            errors, which are those of a board 350 mm wide.
    """
    rng = np.random.default_rng([seed, 63])
    points = board_points() if flat_m is None else flat_m
    size = float(np.ptp(points[:, 0]) / 0.35)
    x, y = (points[:, :2] - points[:, :2].mean(axis=0)).T
    narrow, skew = 1e-3 * rng.standard_normal(2)
    half = np.array([x.max(), y.max()])
    second = np.stack([(x / half[0]) ** 2, (y / half[1]) ** 2, x * y / half.prod()], axis=-1)
    off = second @ (size * np.array([0.2e-3, 0.2e-3, 0.5e-3]) * rng.standard_normal((3, 3)))
    off[:, 0] += narrow * x + skew * y
    off[:, 1] += skew * x - narrow * y
    out: FloatArray = points + off - off.mean(axis=0) + size * 0.15e-3 * rng.standard_normal(points.shape)
    return out


@dataclass(frozen=True)
class SimulatedFrame:
    """What a detector gives for one image.

    Attributes:
        t_cam_ns: Stamp in the camera's clock, ns.
        ids: Point ids, shape (n,).
        uv_px: Pixels with noise, shape (n, 2).
        t_s: True imu-clock time of the (middle row of the) exposure, s since the start; truth.
        outlier: Which corners were made wrong on purpose, shape (n,); truth, not data.
    """

    t_cam_ns: int
    ids: IntArray
    uv_px: FloatArray
    t_s: float
    outlier: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class SimulationOptions:
    """How the sensors sample; `Rig` says how they are.

    Attributes:
        imu_rate_hz: Samples a second.
        imu_average_s: Each sample is the mean over so long, centred at its stamp; 0: the instantaneous value
            (the white noise is the same).
        accel_lag_s: How late the accelerometer's readings are against the gyro's.
        camera_rate_hz: Frames per second.
        corner_sigma_px: White noise per axis.
        noise_spread: Standard deviation of the logarithm of a frame's white noise, as motion blur varies it;
            frames within a second are alike.
        frame_sigma_px: Noise common to all corners of a frame, per axis.
        outlier_fraction: Share of corners displaced by up to `outlier_px`.
        outlier_px: Largest displacement per axis of an outlier.
        missing_fraction: Share of corners dropped at random.
        hidden_fraction: Share of frames in which half the board (a random half-plane) is hidden.
        whole_board_only: Frames that do not show every point are dropped.
        stamp_jitter_s: One-sigma of independent errors of the camera's stamps.
        imu_stamp_jitter_s: The same for the imu.
        frame_drop_fraction: Share of frames lost.
        epoch_ns: Stamp of t_s = 0.
    """

    imu_rate_hz: float = 100.0
    imu_average_s: float = 0.0
    accel_lag_s: float = 0.0
    camera_rate_hz: float = 20.0
    corner_sigma_px: float = 0.5
    noise_spread: float = 0.0
    frame_sigma_px: float = 0.0
    outlier_fraction: float = 0.0
    outlier_px: float = 20.0
    missing_fraction: float = 0.0
    hidden_fraction: float = 0.0
    whole_board_only: bool = False
    stamp_jitter_s: float = 0.0
    imu_stamp_jitter_s: float = 0.0
    frame_drop_fraction: float = 0.0
    epoch_ns: int = EPOCH_NS


@dataclass(frozen=True)
class SimulatedRun:
    """A recording without images, and the truth behind it.

    Attributes:
        rig: The truth.
        points_m: World points, shape (n, 3); row = id for boards. For tracks: see `landmark_of`.
        t_imu_ns: Stamps of the imu, shape (m,), int64.
        gyro_rps, specific_force_mps2: Readings, shape (m, 3).
        frames: In order of time.
        options: What it was made with.
        duration_s: Length.
        landmark_of: Track id to row of `points_m` (tracks only; empty for boards, where id = row).
    """

    rig: Rig
    points_m: FloatArray
    t_imu_ns: IntArray
    gyro_rps: FloatArray
    specific_force_mps2: FloatArray
    frames: list[SimulatedFrame]
    options: SimulationOptions
    duration_s: float
    landmark_of: dict[int, int] = field(default_factory=dict)

    def truth(self, t_s: float | None = None) -> dict[str, Any]:
        """Truth at `t_s` (default: the end) in the JSON form of `vical calibrate --json`."""
        return self.rig.truth(self.duration_s if t_s is None else t_s)


def simulate(
    seed: int,
    duration_s: float = 60.0,
    *,
    rig: Rig | None = None,
    points_m: FloatArray | None = None,
    timeshift_cam_imu_s: float = 0.0,
    **options: Any,
) -> SimulatedRun:
    """Simulate a recording of a board.

    Args:
        seed: Of everything random: the motion (unless `rig` is given) and the noise.
        duration_s: Length, s; imu and camera run over the same stretch of their own clocks.
        rig: Truth; None: `reference_rig(seed, timeshift_cam_imu_s=...)`.
        points_m: Target points; None: the 8 x 6 x 50 mm board.
        timeshift_cam_imu_s: Used only without `rig`.
        **options: Fields of `SimulationOptions`.

    Returns:
        The recording with its truth.
    """
    chosen = SimulationOptions(**options)
    truth = rig or reference_rig(seed, timeshift_cam_imu_s=timeshift_cam_imu_s)
    points = board_points() if points_m is None else np.asarray(points_m, np.float64)
    rng = np.random.default_rng([seed, 31])
    t_imu_ns, gyro, force = simulate_imu(truth, duration_s, chosen, rng)
    frames = _simulate_frames(truth, points, duration_s, chosen, rng)
    return SimulatedRun(truth, points, t_imu_ns, gyro, force, frames, chosen, duration_s)


def simulate_imu(
    rig: Rig, duration_s: float, options: SimulationOptions, rng: np.random.Generator
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps (ns) and readings of the imu over [0, duration_s].

    White noise of density d sampled at rate f has the standard deviation d*sqrt(f): its sum over the samples
    of one second, times the step, has the variance d^2 s, as that of the continuous noise.
    """
    step_s = 1.0 / options.imu_rate_hz
    t_s = np.arange(0.0, duration_s + step_s / 2, step_s)
    gyro, force = _averaged(rig, t_s, options.imu_average_s)
    if options.accel_lag_s:
        force = _averaged(rig, t_s - options.accel_lag_s, options.imu_average_s)[1]
    root_rate = np.sqrt(options.imu_rate_hz)
    gyro = gyro + rig.densities.gyro * root_rate * rng.standard_normal(gyro.shape)
    force = force + rig.densities.accel * root_rate * rng.standard_normal(force.shape)
    stamped_s = t_s + options.imu_stamp_jitter_s * rng.standard_normal(t_s.shape)
    return _to_ns(stamped_s, options.epoch_ns), gyro, force


def _averaged(rig: Rig, t_s: FloatArray, width_s: float) -> tuple[FloatArray, FloatArray]:
    """Means of rate and specific force over `width_s` about instants (Gauss-Legendre)."""
    if not width_s:
        return rig.imu_reading(t_s)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    readings = [rig.imu_reading(t_s + x * width_s / 2) for x in nodes]
    gyro, force = (sum(w / 2 * r[k] for w, r in zip(weights, readings, strict=True)) for k in (0, 1))
    return np.asarray(gyro), np.asarray(force)


def exposure_times(
    rig: Rig, duration_s: float, options: SimulationOptions, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """True times (s) of the frames, and their stamps (ns) in the camera's clock.

    The camera's clock starts at zero with the recording, so that with a shift of +0.2 s the first image
    is taken at t_s = 0.2 and the last ones after the imu has stopped, as in a real recording.
    """
    step_s = 1.0 / options.camera_rate_hz
    t_cam_s = np.arange(0.0, duration_s + step_s / 2, step_s) + 0.37 * step_s
    t_cam_s = t_cam_s[rng.random(t_cam_s.shape) >= options.frame_drop_fraction]
    t_s = t_cam_s + rig.timeshift_cam_imu_s
    for _ in range(3):  # the shift is a function of imu time; the drift is slow, so this settles at once
        t_s = t_cam_s + rig.timeshift_at(t_s)
    stamped_s = t_cam_s + options.stamp_jitter_s * rng.standard_normal(t_cam_s.shape)
    return t_s, _to_ns(stamped_s, options.epoch_ns)


def project_points(
    rig: Rig, t_s: FloatArray, points_m: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Noise-free pixels (frames, n, 2) of world points and whether each is visible; rows read out in turn."""
    uv, visible = rig.lens.project(rig.points_in_camera(t_s, points_m))
    if rig.readout_s == 0.0:
        return uv, visible
    for _ in range(4):  # where a point appears says when its row is read, which moves the point
        t_row = t_s[:, None] + rig.readout_s * np.clip(rig.row_share(uv), -0.5, 0.5)
        R, p = rig.camera_pose_target(t_row)
        uv, visible = rig.lens.project(np.einsum("fnji,fnj->fni", R, points_m - p))
    return uv, visible


def _to_ns(t_s: FloatArray, epoch_ns: int) -> IntArray:
    return np.rint(t_s * 1e9).astype(np.int64) + epoch_ns


def _simulate_frames(
    rig: Rig, points_m: FloatArray, duration_s: float, options: SimulationOptions, rng: np.random.Generator
) -> list[SimulatedFrame]:
    t_s, t_cam_ns = exposure_times(rig, duration_s, options, rng)
    uv, visible = project_points(rig, t_s, points_m)
    if options.whole_board_only:
        visible &= visible.all(axis=1, keepdims=True)
    visible &= rng.random(visible.shape) >= options.missing_fraction
    visible &= ~_hidden_halves(points_m, len(t_s), options.hidden_fraction, rng)
    uv, outlier = add_pixel_noise(uv, options, rng)
    frames = []
    for i in range(len(t_s)):
        ids = np.flatnonzero(visible[i])
        if len(ids):
            frames.append(
                SimulatedFrame(
                    int(t_cam_ns[i]), ids.astype(np.int64), uv[i, ids], float(t_s[i]), outlier[i, ids]
                )
            )
    return frames


def _hidden_halves(
    points_m: FloatArray, frames: int, fraction: float, rng: np.random.Generator
) -> npt.NDArray[np.bool_]:
    """Which points an obstacle hides: in some frames everything on one side of a line through the board."""
    angle = rng.uniform(0, 2 * np.pi, frames)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    beyond = normal @ (points_m[:, :2] - points_m[:, :2].mean(axis=0)).T > 0
    return np.asarray(beyond & (rng.random(frames) < fraction)[:, None])


def add_pixel_noise(
    uv: FloatArray, options: SimulationOptions, rng: np.random.Generator
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Noisy pixels (frames, n, 2), and which points were displaced on purpose (frames, n)."""
    white = rng.standard_normal(uv.shape)
    if options.noise_spread > 0.0:
        alike = max(round(options.camera_rate_hz), 1)
        steps = rng.standard_normal(len(uv) + alike - 1)
        level = np.convolve(steps, np.full(alike, alike**-0.5), "valid")
        white *= np.exp(options.noise_spread * level)[:, None, None]
    noisy = uv + options.corner_sigma_px * white
    noisy = noisy + options.frame_sigma_px * rng.standard_normal((len(uv), 1, 2))
    outlier = rng.random(uv.shape[:2]) < options.outlier_fraction
    wrong = rng.uniform(-options.outlier_px, options.outlier_px, uv.shape)
    return np.where(outlier[..., None], noisy + wrong, noisy), outlier
