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

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from vical_mocks.points import SimulatedFrame, SimulatedRun, simulate
from vical_mocks.rig import Rig
from vical_mocks.tracks import simulate_tracks

from benchmarks.error_model import STATE, inertial_factors, pixel_jacobians

FloatArray = npt.NDArray[np.float64]

# One-sigma priors so wide that they tell nothing next to seconds of data (rad, m/s, m, rad/s, m/s^2).
_STATE_PRIOR = np.repeat([3.0, 10.0, 10.0, 0.3, 2.0], 3)


@dataclass(frozen=True)
class BoundOptions:
    """Which parameters are unknown.

    Attributes:
        corner_sigma_px: White noise per axis and corner.
        frame_sigma_px: Noise common to the corners of a frame, per axis.
        stamp_jitter_s: Independent error of each frame's stamp.
        intrinsics: fx fy cx cy unknown.
        distortion: The four coefficients unknown.
        timeshift: Time shift unknown.
        drift_prior: One-sigma prior of its drift, s/s; the time shift is then that at the end. 0: no drift.
        extrinsics: Lever arm and mounting unknown.
        readout: Rolling-shutter readout unknown.
        target_scale_prior: One-sigma relative prior of the target's size; 0: known.
        imu_matrix_prior: Prior of each entry of the gyro (9) and accelerometer (6, lower triangle)
            matrices; 0: known.
        gravity: "free" (three numbers), "magnitude" (its direction is unknown) or "known".
        target_free: World points are unknown; the first pose fixes the world.
    """

    corner_sigma_px: float = 0.5
    frame_sigma_px: float = 0.0
    stamp_jitter_s: float = 0.0
    intrinsics: bool = True
    distortion: bool = True
    timeshift: bool = True
    drift_prior: float = 0.0
    extrinsics: bool = True
    readout: bool = False
    target_scale_prior: float = 0.0
    imu_matrix_prior: float = 0.0
    gravity: str = "magnitude"
    target_free: bool = False


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
    """

    t_s: float
    slices: dict[str, slice]
    covariance: FloatArray

    def sigma(self, name: str) -> FloatArray:
        """One-sigma bounds of one block."""
        place = self.slices[name]
        return np.asarray(np.sqrt(np.diag(self.covariance)[place]))

    def block(self, *names: str) -> FloatArray:
        """Joint covariance of several blocks, in the order given."""
        index = np.concatenate([np.arange(self.slices[n].start, self.slices[n].stop) for n in names])
        return self.covariance[np.ix_(index, index)]


@dataclass
class _Constants:
    """Places and priors of the constant parameters after the state."""

    slices: dict[str, slice] = field(default_factory=dict)
    prior_sigma: list[float] = field(default_factory=list)

    def add(self, name: str, size: int, sigma: float) -> None:
        start = STATE + len(self.prior_sigma)
        self.slices[name] = slice(start, start + size)
        self.prior_sigma += [sigma] * size

    @classmethod
    def of(cls, options: BoundOptions) -> _Constants:
        c = cls()
        if options.extrinsics:
            c.add("p_imu_cam", 3, 1.0)
            c.add("r_imu_cam", 3, 3.0)
        if options.timeshift:
            c.add("timeshift", 1, 1.0)
            if options.drift_prior > 0:
                c.add("drift", 1, options.drift_prior)
        c.add("gravity", 3, 1e-7 if options.gravity == "known" else 10.0)
        if options.intrinsics:
            c.add("intrinsics", 4, 100.0)
        if options.distortion:
            c.add("distortion", 4, 1.0)
        if options.readout:
            c.add("readout", 1, 0.1)
        if options.target_scale_prior > 0 and not options.target_free:
            c.add("target_scale", 1, options.target_scale_prior)
        if options.imu_matrix_prior > 0:
            c.add("gyro_matrix", 9, options.imu_matrix_prior)
            c.add("accel_matrix", 6, options.imu_matrix_prior)
        return c


class _Information:
    """The information matrix over [state, constants, landmarks], with elimination."""

    def __init__(self, constants: _Constants, rig: Rig, options: BoundOptions) -> None:
        self.constants = constants
        state_sigma = _STATE_PRIOR.copy()
        if options.target_free:
            state_sigma[[0, 1, 2, 6, 7, 8]] = 1e-7  # the first pose *is* the world
        self.matrix = np.diag(np.concatenate([state_sigma, constants.prior_sigma]) ** -2.0)
        self.fixed = len(self.matrix)
        self.landmarks: list[int] = []
        if options.gravity == "magnitude":
            place = constants.slices["gravity"]
            direction = rig.gravity_world_mps2 / np.linalg.norm(rig.gravity_world_mps2)
            self.matrix[place, place] += np.outer(direction, direction) / 1e-6**2

    def propagate(self, transition: FloatArray, inputs: FloatArray, noise: FloatArray) -> None:
        """Move from one frame's state to the next.

        Args:
            transition: d new / d old state, (15, 15).
            inputs: d new / d constants, (15, constants).
            noise: Covariance of the new state given the old one and the constants, (15, 15).
        """
        size = len(self.matrix)
        scale = 1 / np.sqrt(np.diag(noise))
        weight = np.linalg.inv(noise * np.outer(scale, scale)) * np.outer(scale, scale)
        jacobian = np.zeros((STATE, STATE + size))  # columns: old state, new state, constants, landmarks
        jacobian[:, :STATE], jacobian[:, STATE : 2 * STATE] = -transition, np.eye(STATE)
        jacobian[:, 2 * STATE : STATE + self.fixed] = -inputs
        joint = jacobian.T @ weight @ jacobian
        old = np.r_[np.arange(STATE), np.arange(2 * STATE, STATE + size)]
        joint[np.ix_(old, old)] += self.matrix
        self.matrix = _eliminate(joint, np.arange(STATE))

    def add_landmark(self, identity: int) -> None:
        """Take an unknown world point up (weak prior of 100 m)."""
        size = len(self.matrix)
        grown = np.zeros((size + 3, size + 3))
        grown[:size, :size] = self.matrix
        grown[size:, size:] = np.eye(3) / 100.0**2
        self.matrix = grown
        self.landmarks.append(identity)

    def remove_landmarks(self, identities: set[int]) -> None:
        """Eliminate points that will not be seen again."""
        if not identities:
            return
        rows = [self.fixed + 3 * i for i, name in enumerate(self.landmarks) if name in identities]
        self.matrix = _eliminate(self.matrix, np.concatenate([np.arange(r, r + 3) for r in rows]))
        self.landmarks = [name for name in self.landmarks if name not in identities]

    def landmark_place(self, identity: int) -> slice:
        start = self.fixed + 3 * self.landmarks.index(identity)
        return slice(start, start + 3)

    def covariance(self) -> FloatArray:
        """Of state and constants, landmarks marginalised."""
        information = _eliminate(self.matrix, np.arange(self.fixed, len(self.matrix)))
        scale = 1 / np.sqrt(np.diag(information))
        return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def _eliminate(information: FloatArray, gone: npt.NDArray[np.int64]) -> FloatArray:
    """Schur complement: the information left about the other variables."""
    if len(gone) == 0:
        return information
    kept = np.setdiff1d(np.arange(len(information)), gone)
    scale = 1 / np.sqrt(np.diag(information)[gone])
    inner = information[np.ix_(gone, gone)] * np.outer(scale, scale)
    cross = information[np.ix_(kept, gone)] * scale
    left = information[np.ix_(kept, kept)] - cross @ np.linalg.solve(inner, cross.T)
    return np.asarray((left + left.T) / 2)


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
    run: SimulatedRun, options: BoundOptions | None = None, times_s: Sequence[float] | None = None
) -> list[Bound]:
    """The bound after each of `times_s` (s since the start; None: at the end only).

    Frames outside the imu's stretch, and corners that were made outliers, tell nothing.
    """
    chosen = options or BoundOptions(corner_sigma_px=run.options.corner_sigma_px)
    wanted = list(times_s) if times_s is not None else [run.duration_s]
    information = _Information(_Constants.of(chosen), run.rig, chosen)
    frames = [f for f in run.frames if 0.0 <= f.t_s <= run.duration_s]
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
            _propagate(information, *(factor[n - 1] for factor in factors))
        _update(information, frame, next(seen), chosen)
        if chosen.target_free:
            information.remove_landmarks({i for i in information.landmarks if last_seen[i] <= n})
    return found + [_snapshot(information, t_s) for t_s in wanted[len(found) :]]


def _snapshot(information: _Information, t_s: float) -> Bound:
    state = {
        "attitude": slice(0, 3),
        "velocity": slice(3, 6),
        "position": slice(6, 9),
        "gyro_bias": slice(9, 12),
        "accel_bias": slice(12, 15),
    }
    places, covariance = information.constants.slices, information.covariance()
    if "drift" in places:  # the shift at the end, where inside it is that at the start
        to_end = np.eye(len(covariance))
        to_end[places["timeshift"], places["drift"]] = t_s
        covariance = to_end @ covariance @ to_end.T
    return Bound(t_s, state | places, covariance)


def _propagate(
    information: _Information, transition: FloatArray, influence: FloatArray, noise: FloatArray
) -> None:
    inputs = np.zeros((STATE, information.fixed - STATE))
    columns = {"gravity": slice(0, 3), "gyro_matrix": slice(3, 12), "accel_matrix": slice(12, 18)}
    for name, source in columns.items():
        if name in information.constants.slices:
            place = information.constants.slices[name]
            inputs[:, place.start - STATE : place.stop - STATE] = influence[:, source]
    information.propagate(transition, inputs, noise)


def _derivatives(run: SimulatedRun, frames: Sequence[SimulatedFrame]) -> Iterator[dict[str, FloatArray]]:
    """Pixel derivatives of one frame after the other, worked out many frames at a time; outliers left out."""
    for start in range(0, len(frames), 50):
        some = frames[start : start + 50]
        rows = [[run.landmark_of.get(int(i), int(i)) for i in f.ids[~f.outlier]] for f in some]
        yield from pixel_jacobians(run.rig, some, [run.points_m[np.array(r, dtype=np.int64)] for r in rows])


def _update(
    information: _Information, frame: SimulatedFrame, by: dict[str, FloatArray], options: BoundOptions
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
    if options.target_free:
        for n, identity in enumerate(ids):
            full[2 * n : 2 * n + 2, information.landmark_place(int(identity))] = by["points"][
                2 * n : 2 * n + 2
            ]
    information.matrix += _pixel_information(full, by["timeshift"], options)


def describe(bound: Bound) -> str:
    """One Markdown table row: time, time shift, lever arm, mounting, focal length and centre."""
    p = bound.sigma("p_imu_cam") * 1e3
    r = np.rad2deg(bound.sigma("r_imu_cam"))
    shift = f"{bound.sigma('timeshift')[0] * 1e6:.1f}" if "timeshift" in bound.slices else "-"
    lens = "- | -"
    if "intrinsics" in bound.slices:
        f = bound.sigma("intrinsics")
        lens = f"{f[0]:.3f}/{f[1]:.3f} | {f[2]:.3f}/{f[3]:.3f}"
    places = f"{p[0]:.3f}/{p[1]:.3f}/{p[2]:.3f} | {r[0]:.4f}/{r[1]:.4f}/{r[2]:.4f}"
    return f"{bound.t_s:.0f} | {shift} | {places} | {lens}"


def main(argv: list[str]) -> int:
    """Print the bound of the reference cases."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks bound", description=__doc__)
    parser.add_argument(
        "--seeds", type=int, default=3, help="motions per case; their mean variance is printed"
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--case", action="append", help="only these cases")
    args = parser.parse_args(argv)
    times = [t for t in (5.0, 10.0, 20.0, 30.0, 60.0, 120.0) if t <= args.seconds]
    print("| case | t s | time shift us | lever arm mm | mounting deg | f px | c px |")
    print("|---|---|---|---|---|---|---|")
    for name, (make, options) in CASES.items():
        if args.case and name not in args.case:
            continue
        runs = [bounds(make(seed, args.seconds), options, times) for seed in range(args.seeds)]
        for at_time in zip(*runs, strict=True):
            mean = Bound(at_time[0].t_s, at_time[0].slices, np.mean([b.covariance for b in at_time], axis=0))
            print(f"| {name} | {describe(mean)} |", flush=True)
    return 0


def _board(seed: int, seconds: float) -> SimulatedRun:
    return simulate(seed, seconds, whole_board_only=True)


def _tracks(seed: int, seconds: float) -> SimulatedRun:
    return simulate_tracks(seed, seconds)


CASES: dict[str, tuple[Callable[[int, float], SimulatedRun], BoundOptions]] = {
    "reference": (_board, BoundOptions(gravity="free")),
    "lens known": (_board, BoundOptions(gravity="free", intrinsics=False, distortion=False)),
    "gravity magnitude known": (_board, BoundOptions()),
    "gravity known": (_board, BoundOptions(gravity="known")),
    "0.1 px": (_board, BoundOptions(gravity="free", corner_sigma_px=0.1)),
    "clocks apart": (_board, BoundOptions(gravity="free", drift_prior=1e-4)),
    "stamp jitter 1 ms": (_board, BoundOptions(gravity="free", stamp_jitter_s=1e-3)),
    "target scale 0.1 %": (_board, BoundOptions(gravity="free", target_scale_prior=1e-3)),
    "IMU matrices 1 %, scale 0.2 %": (
        _board,
        BoundOptions(gravity="free", imu_matrix_prior=0.01, target_scale_prior=2e-3),
    ),
    "target-free": (_tracks, BoundOptions(target_free=True, gravity="free")),
    "target-free, lens known": (
        _tracks,
        BoundOptions(target_free=True, gravity="free", intrinsics=False, distortion=False),
    ),
}
