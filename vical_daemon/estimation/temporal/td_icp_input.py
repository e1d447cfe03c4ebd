"""What temporal calibration is given: options, and gyro samples and orientations fit to be registered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.measurements import FloatArray, ImuNoise

_USUAL = ImuNoise()
MIN_ORIENTATIONS = 12
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
    """

    search_s: float = 5.0
    timeshift_guess_s: float = 0.0
    gyro_density: float = _USUAL.gyro_density
    gyro_walk: float = _USUAL.gyro_walk
    gyro_log_sigma: float = 0.2


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
    return t_s[keep], gyro[keep]


def clean_orientations(
    t_s: FloatArray, R: FloatArray, rotation_sigma: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.intp]] | str:
    """Sort, drop what is not a number, and bring the noise into the form of covariances.

    Returns:
        Stamps, orientations, covariances, and the index of each in the input; or why nothing is left.
    """
    t_s, R = np.asarray(t_s, dtype=np.float64), np.asarray(R, dtype=np.float64)
    n = len(t_s)
    if n < MIN_ORIENTATIONS:
        return f"{n} camera orientations: at least {MIN_ORIENTATIONS} are needed (is the target in view?)"
    sigma = np.asarray(rotation_sigma, dtype=np.float64)
    if sigma.ndim < 3:
        sigma = (np.broadcast_to(sigma, (n,)) ** 2)[:, None, None] * np.eye(3)
    good = np.flatnonzero(
        np.isfinite(t_s) & np.isfinite(R).all(axis=(1, 2)) & np.isfinite(sigma).all(axis=(1, 2))
    )
    index = good[np.argsort(t_s[good], kind="stable")]
    index = index[np.concatenate(([True], np.diff(t_s[index]) > 1e-6))] if len(index) else index
    if len(index) < MIN_ORIENTATIONS:
        return f"{len(index)} usable camera orientations: at least {MIN_ORIENTATIONS} are needed"
    return t_s[index], R[index], sigma[index] + 1e-14 * np.eye(3), index
