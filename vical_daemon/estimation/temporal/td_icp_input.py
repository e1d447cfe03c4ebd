"""What temporal calibration is given: options, and gyro samples and orientations fit to be registered."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import BoolArray, FloatArray, ImuNoise
from vical_daemon.estimation.temporal.rotation_turns import without_long_rest

_USUAL = ImuNoise()
USUAL_RAD = float(np.deg2rad(0.1))
"""Noise of an orientation from a board as it usually is, rad."""
SHIFT_LOST_S = 3e-3  # sigma of a delay that is no answer: 0.2 deg at 60 deg/s
MIN_ORIENTATIONS = 12  # 36 equations for mounting, world, bias and delay (10)
SLOWEST_GYRO_HZ = 10.0  # as for `calibrate`: between slower samples a hand turns to and fro unseen


@dataclass(frozen=True, slots=True)
class TdIcpOptions:
    """Settings; the defaults suit a 3DM-GX3-25 or better.

    Attributes:
        search_s: The shift is looked for within +- this of the guess, s.
        timeshift_guess_s: Middle of the search, s.
        gyro_density: Gyro noise density, rad/s/sqrt(Hz).
        gyro_walk: Gyro bias walk, rad/s^2/sqrt(Hz).
        gyro_log_sigma: How well the density is known (sigma of its logarithm).
        lost_s: Sigma of a delay that is no answer, s.
    """

    search_s: float = 5.0
    timeshift_guess_s: float = 0.0
    gyro_density: float = _USUAL.gyro_density
    gyro_walk: float = _USUAL.gyro_walk
    gyro_log_sigma: float = 0.2
    lost_s: float = SHIFT_LOST_S


LONGEST_HOLE_S = 86_400.0
"""In the readings of a gyro, s: a day. They are interpolated evenly, and memory for years there is not."""


def clean_gyro(t_s: FloatArray, gyro: FloatArray) -> tuple[FloatArray, FloatArray] | str:
    """Sort, drop what is not a number or stamped twice; a string says why nothing is left."""
    t_s, gyro = np.asarray(t_s, dtype=np.float64), np.asarray(gyro, dtype=np.float64)
    good = np.isfinite(t_s) & np.isfinite(gyro).all(axis=-1) if len(t_s) else np.zeros(0, dtype=bool)
    t_s, gyro = t_s[good], gyro[good]
    if len(t_s) < 2 * MIN_ORIENTATIONS:
        return f"{len(t_s)} gyro samples: too few"
    order = np.argsort(t_s, kind="stable")
    t_s, gyro = t_s[order], gyro[order]
    keep = np.concatenate(([True], np.diff(t_s) > 1e-6))  # a sample stamped twice adds nothing
    rate_hz = 1.0 / float(np.median(np.diff(t_s[keep]))) if np.count_nonzero(keep) > 1 else 0.0
    if rate_hz < SLOWEST_GYRO_HZ:
        return (
            f"the gyro has {rate_hz:.3g} samples a second by its stamps; at least {SLOWEST_GYRO_HZ:g} are "
            "needed (are its stamps in the right unit, is it the IMU's file?)"
        )
    t_s, gyro = t_s[keep], gyro[keep]
    hole_s = float(np.diff(t_s).max())
    if hole_s > LONGEST_HOLE_S:
        return (
            f"the stamps of the gyro jump by {hole_s / 86_400.0:.0f} days: its clock was set; give the data "
            "before or after it alone"
        )
    return t_s, gyro


@dataclass(frozen=True)
class OrientationStream:
    """Orientations of one sensor in any fixed world.

    Attributes:
        name: For the report.
        t_s: Stamps in the sensor's clock, s, shape (n,).
        R_world_sensor: Orientations, shape (n, 3, 3).
        rotation_sigma: Their noise, rad: one number, or (n,), or covariances of the local error (n, 3, 3).
            Only the proportions between orientations matter: the noise is measured.
    """

    name: str
    t_s: FloatArray
    R_world_sensor: FloatArray
    rotation_sigma: float | FloatArray = USUAL_RAD


@dataclass(frozen=True)
class CleanStream:
    """Orientations that can be registered, in order of time.

    Attributes:
        name: Of the sensor.
        t_s: Stamps, increasing, s, shape (n,).
        R_world_sensor: Orientations, shape (n, 3, 3).
        covariance: Of their local errors, rad^2, shape (n, 3, 3).
        q: The orientations as quaternions, shape (n, 4).
        index: Of each in the stream as it was given, shape (n,).
        n_given: Orientations in that.
        at_rest: Of these, those left out because the rig rested for most of the recording.
    """

    name: str
    t_s: FloatArray
    R_world_sensor: FloatArray
    covariance: FloatArray
    q: FloatArray
    index: npt.NDArray[np.intp]
    n_given: int
    at_rest: int = 0

    def some(self, which: slice | BoolArray) -> CleanStream:
        """Only these orientations."""
        return replace(
            self,
            t_s=self.t_s[which],
            R_world_sensor=self.R_world_sensor[which],
            covariance=self.covariance[which],
            q=self.q[which],
            index=self.index[which],
        )

    def thinned(self) -> CleanStream:
        """Every other orientation; the rest counts as not given."""
        half = self.some(slice(None, None, 2))
        n = len(half.t_s)
        return replace(half, index=np.arange(n), n_given=self.n_given - len(self.t_s) + n)

    def moving(self) -> CleanStream:
        """The stream without most of its rest, where it mostly rests."""
        keep = without_long_rest(self.t_s, self.q)
        return replace(self.some(keep), at_rest=int(np.count_nonzero(~keep)))


def clean_stream(stream: OrientationStream, base_s: float = 0.0) -> CleanStream | str:
    """Sort, drop what is not a number, count stamps from `base_s`; a string says why nothing is left."""
    t_s, R = np.asarray(stream.t_s, dtype=np.float64), np.asarray(stream.R_world_sensor, dtype=np.float64)
    n = len(t_s)
    if n < MIN_ORIENTATIONS:
        return f"{n} camera orientations: at least {MIN_ORIENTATIONS} are needed (is the target in view?)"
    sigma = np.asarray(stream.rotation_sigma, dtype=np.float64)
    if sigma.ndim < 3:
        sigma = (np.broadcast_to(sigma, (n,)) ** 2)[:, None, None] * np.eye(3)
    good = np.flatnonzero(
        np.isfinite(t_s) & np.isfinite(R).all(axis=(1, 2)) & np.isfinite(sigma).all(axis=(1, 2))
    )
    index = good[np.argsort(t_s[good], kind="stable")]
    index = index[np.concatenate(([True], np.diff(t_s[index]) > 1e-6))] if len(index) else index
    if len(index) < MIN_ORIENTATIONS:
        return f"{len(index)} usable camera orientations: at least {MIN_ORIENTATIONS} are needed"
    R = R[index]
    q, covariance = so3.quat_from_matrix(R), sigma[index] + 1e-14 * np.eye(3)
    return CleanStream(stream.name, t_s[index] - base_s, R, covariance, q, index, n)
