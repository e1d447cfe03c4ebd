"""Posterior Cramer-Rao bound along the true trajectory: what the data can tell at best, and no filter code.

Model: one state (attitude, velocity, position, gyro and accelerometer bias) per frame, tied to the next
one by the inertial readings in between (white noise and bias walks as continuous-time densities, error
equations integrated in steps of at most 10 ms at the truth), to the pixels by the projection, and to
constants: lever arm, mounting, time shift, gravity, and as asked lens, target scale, IMU scale, landmarks.
The information matrix over [newest state, constants, landmarks in view] goes forward from frame to frame;
the state left behind and landmarks seen for the last time are eliminated by Schur complements. That is
exact, so its inverse at time t is the bound for any estimator that uses the data up to t.

Uses the simulation's truth (`vical_mocks`), and nothing of `vical_daemon`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_mocks.cramer_rao.error_model import STATE, inertial_factors, pixel_jacobians
from vical_mocks.cramer_rao.information import DRAW, BoundOptions, Constants, Information
from vical_mocks.points import SimulatedFrame, SimulatedRun

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Draw:
    """The noise of one recording (`luck.draw_of`), to follow what it makes of an efficient estimate.

    Attributes:
        pushes: What the noise of the inertial readings, and the walk of the biases, does from one frame to
            the next, shape (frames - 1, 15).
        pixels: Noise of each frame's corners that are no outliers, px, shapes (2n,).
    """

    pushes: FloatArray
    pixels: list[FloatArray]


@dataclass(frozen=True)
class Bound:
    """The bound at one time.

    Attributes:
        t_s: Data up to here were used.
        slices: Name of a block to its place: p_imu_cam (m), r_imu_cam (rad, local), timeshift (s),
            gravity (m/s^2), intrinsics (px), distortion, readout (s), target_scale, gyro_matrix,
            accel_matrix, gyro_bias (rad/s), accel_bias (m/s^2), and of the newest frame attitude,
            velocity, position.
        covariance: Of all of them.
        error: Estimate minus truth, to first order, of the estimator that reaches the bound (weighted least
            squares over all data up to here), where its noise was given; else zero.
    """

    t_s: float
    slices: dict[str, slice]
    covariance: FloatArray
    error: FloatArray

    def sigma(self, name: str) -> FloatArray:
        """One-sigma bounds of one block."""
        place = self.slices[name]
        return np.asarray(np.sqrt(np.diag(self.covariance)[place]))

    def block(self, *names: str) -> FloatArray:
        """Joint covariance of several blocks, in the order given."""
        index = np.concatenate([np.arange(self.slices[n].start, self.slices[n].stop) for n in names])
        return np.asarray(self.covariance[np.ix_(index, index)])


def _pixel_information(jacobian: FloatArray, by_time: FloatArray, options: BoundOptions) -> FloatArray:
    """J^T C^-1 J with C = corner noise + what is common to the frame (stamp error, offset)."""
    weight = options.corner_sigma_px**-2
    common = []
    if options.stamp_jitter_s > 0:
        common.append(by_time[:, :1] * options.stamp_jitter_s)
    if options.frame_sigma_px > 0:
        common.append(np.tile(np.eye(2) * options.frame_sigma_px, (len(jacobian) // 2, 1)))
    information = weight * jacobian.T @ jacobian
    if common:  # Woodbury: the common parts are few
        u = np.hstack(common)
        inner = np.eye(u.shape[1]) + weight * u.T @ u
        cross = weight * jacobian.T @ u
        information -= cross @ np.linalg.solve(inner, cross.T)
    return information


def bounds(
    run: SimulatedRun,
    options: BoundOptions | None = None,
    times_s: Sequence[float] | None = None,
    draw: Draw | None = None,
) -> list[Bound]:
    """The bound after each of `times_s` (s since the start; None: at the end only).

    Frames outside the imu's stretch, and corners that were made outliers, tell nothing.
    """
    chosen = options or BoundOptions(corner_sigma_px=run.options.corner_sigma_px)
    wanted = list(times_s) if times_s is not None else [run.duration_s]
    information = Information(Constants.of(chosen, drawn=draw is not None), run.rig, chosen)
    frames = frames_of(run)
    last_seen = {int(i): n for n, f in enumerate(frames) for i in f.ids} if chosen.target_free else {}
    factors = inertial_factors(run.rig, np.array([f.t_s for f in frames]), chosen.imu_matrix_prior > 0)
    seen = _derivatives(run, frames)
    found: list[Bound] = []
    for n, frame in enumerate(frames):
        while len(found) < len(wanted) and frame.t_s > wanted[len(found)]:
            found.append(_snapshot(information, wanted[len(found)]))
        if len(found) == len(wanted):
            return found
        if n > 0:
            push = None if draw is None else draw.pushes[n - 1]
            transition, influence, noise = (factor[n - 1] for factor in factors)
            _propagate(information, transition, influence, noise, push)
        _update(information, frame, next(seen), chosen, None if draw is None else draw.pixels[n])
        if chosen.target_free:
            information.remove_landmarks({i for i in information.landmarks if last_seen[i] <= n})
    return found + [_snapshot(information, t_s) for t_s in wanted[len(found) :]]


def frames_of(run: SimulatedRun) -> list[SimulatedFrame]:
    """The frames that the imu's stretch covers."""
    return [f for f in run.frames if 0.0 <= f.t_s <= run.duration_s]


def _snapshot(information: Information, t_s: float) -> Bound:
    state = {
        "attitude": slice(0, 3),
        "velocity": slice(3, 6),
        "position": slice(6, 9),
        "gyro_bias": slice(9, 12),
        "accel_bias": slice(12, 15),
    }
    places = {name: place for name, place in information.constants.slices.items() if name != DRAW}
    covariance, error = information.solution()
    if "drift" in places:  # the shift at the end, where inside it is that at the start
        to_end = np.eye(len(covariance))
        to_end[places["timeshift"], places["drift"]] = t_s
        covariance, error = to_end @ covariance @ to_end.T, to_end @ error
    return Bound(t_s, state | places, covariance, error)


def _propagate(
    information: Information,
    transition: FloatArray,
    influence: FloatArray,
    noise: FloatArray,
    push: FloatArray | None,
) -> None:
    inputs = np.zeros((STATE, information.fixed - STATE))
    columns = {"gravity": slice(0, 3), "gyro_matrix": slice(3, 12), "accel_matrix": slice(12, 18)}
    for name, source in columns.items():
        if name in information.constants.slices:
            place = information.constants.slices[name]
            inputs[:, place.start - STATE : place.stop - STATE] = influence[:, source]
    if push is not None:
        inputs[:, information.constants.slices[DRAW].start - STATE] = push
    information.propagate(transition, inputs, noise)


def _derivatives(run: SimulatedRun, frames: Sequence[SimulatedFrame]) -> Iterator[dict[str, FloatArray]]:
    """Pixel derivatives of one frame after the other, worked out many frames at a time; outliers left out."""
    for start in range(0, len(frames), 50):
        some = frames[start : start + 50]
        rows = [[run.landmark_of.get(int(i), int(i)) for i in f.ids[~f.outlier]] for f in some]
        yield from pixel_jacobians(run.rig, some, [run.points_m[np.array(r, dtype=np.int64)] for r in rows])


def _update(
    information: Information,
    frame: SimulatedFrame,
    by: dict[str, FloatArray],
    options: BoundOptions,
    noise: FloatArray | None,
) -> None:
    ids = frame.ids[~frame.outlier]
    if len(ids) == 0:
        return
    if options.target_free:
        for identity in ids:
            if int(identity) not in information.landmarks:
                information.add_landmark(int(identity))
    full = np.zeros((2 * len(ids), len(information.matrix)))
    full[:, 0:3], full[:, 6:9] = by["attitude"], by["position"]
    for name, place in information.constants.slices.items():
        if name in by:
            full[:, place] = by[name]
    if "drift" in information.constants.slices:
        full[:, information.constants.slices["drift"]] = by["timeshift"] * frame.t_s
    if noise is not None:
        full[:, information.constants.slices[DRAW].start] = -noise
    if options.target_free:
        for n, identity in enumerate(ids):
            full[2 * n : 2 * n + 2, information.landmark_place(int(identity))] = by["points"][
                2 * n : 2 * n + 2
            ]
    information.matrix += _pixel_information(full, by["timeshift"], options)
