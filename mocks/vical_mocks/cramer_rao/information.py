"""The information matrix that goes forward from frame to frame: state, constants, landmarks in view.

What is left behind is eliminated by Schur complements, which is exact. Nothing of `vical_daemon` is used.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vical_mocks.cramer_rao.error_model import STATE
from vical_mocks.rig import Rig

FloatArray = npt.NDArray[np.float64]

# One-sigma priors so wide that they tell nothing next to seconds of data (rad, m/s, m, rad/s, m/s^2).
_STATE_PRIOR = np.repeat([3.0, 10.0, 10.0, 0.3, 2.0], 3)
DRAW = "draw"  # a constant that is 1: what the noise of a recording moves goes along with it


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
        gravity_sigma_mps2: One-sigma prior of its magnitude.
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
    gravity_sigma_mps2: float = 0.015
    target_free: bool = False


@dataclass
class Constants:
    """Places and priors of the constant parameters after the state."""

    slices: dict[str, slice] = field(default_factory=dict)
    prior_sigma: list[float] = field(default_factory=list)

    def add(self, name: str, size: int, sigma: float) -> None:
        """Append a block of `size` constants with one prior sigma."""
        start = STATE + len(self.prior_sigma)
        self.slices[name] = slice(start, start + size)
        self.prior_sigma += [sigma] * size

    @classmethod
    def of(cls, options: BoundOptions, *, drawn: bool = False) -> Constants:
        """Return the constants that these options leave unknown."""
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
        if drawn:
            c.add(DRAW, 1, 1.0)
        return c


class Information:
    """The information matrix over [state, constants, landmarks], with elimination."""

    def __init__(self, constants: Constants, rig: Rig, options: BoundOptions) -> None:
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
            self.matrix[place, place] += np.outer(direction, direction) / options.gravity_sigma_mps2**2

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
        self.matrix = eliminate(joint, np.arange(STATE))

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
        self.matrix = eliminate(self.matrix, np.concatenate([np.arange(r, r + 3) for r in rows]))
        self.landmarks = [name for name in self.landmarks if name not in identities]

    def landmark_place(self, identity: int) -> slice:
        """Return the rows of a landmark in the matrix."""
        start = self.fixed + 3 * self.landmarks.index(identity)
        return slice(start, start + 3)

    def solution(self) -> tuple[FloatArray, FloatArray]:
        """Covariance of state and constants, landmarks marginalised; and their error by the draw."""
        information = eliminate(self.matrix, np.arange(self.fixed, len(self.matrix)))
        kept = self.fixed - (DRAW in self.constants.slices)  # it is the last constant
        pull, information = information[:kept, kept:], information[:kept, :kept]
        scale = 1 / np.sqrt(np.diag(information))
        covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
        return np.asarray(covariance), -(covariance @ pull).sum(axis=1)


def eliminate(information: FloatArray, gone: npt.NDArray[np.int64]) -> FloatArray:
    """Schur complement: the information left about the other variables."""
    if len(gone) == 0:
        return information
    kept = np.setdiff1d(np.arange(len(information)), gone)
    scale = 1 / np.sqrt(np.diag(information)[gone])
    inner = information[np.ix_(gone, gone)] * np.outer(scale, scale)
    cross = information[np.ix_(kept, gone)] * scale
    left = information[np.ix_(kept, kept)] - cross @ np.linalg.solve(inner, cross.T)
    return np.asarray((left + left.T) / 2)
