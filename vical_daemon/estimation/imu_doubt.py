"""Are the IMU's scale and alignment as its readings say? Both answers are kept, as for clocks that drift.

To ask every IMU for its two matrices would make lever arm and mounting two to three times less certain; one
whose axes are off by 0.2 %, taken as true, puts them ten stated sigmas off within a minute. So the filter
always has the fifteen entries among its states. That they are zero is a hypothesis beside it: its Gaussian is
the filter's own, conditioned on that, and its odds come from how far the entries lie from zero (Savage-Dickey
density ratio). What is told are mean and covariance of the mixture.
[docs/math/filter.md, eq. (18)]
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.retract import retract
from vical_daemon.estimation.so3 import exp_one, hat
from vical_daemon.estimation.state import LOWER, Layout
from vical_daemon.estimation.unscented import root, solve_lower

ENTRY_SIGMA = 2e-3
"""Scale or alignment of an IMU that is not as it says, one sigma of each entry."""
KNOWN_OFF_SIGMA = 1e-2
"""The same once it is known to be off, or where its matrices are asked for."""
IMU_IN_DOUBT = "sigmas are small; whether the imu's scale and alignment are true is not sure yet"
_OFF = 0.05  # share of rigs where they are not, to begin with
_SURE = 0.99
_EVERY_S = 1.0
_MOST = 300.0  # of a logarithm


def _entries(layout: Layout) -> slice | None:
    if layout.gyro_matrix is None or layout.accel_matrix is None:
        return None
    return slice(layout.gyro_matrix.start, layout.accel_matrix.stop)


def _values(f: CalibrationFilter) -> FloatArray:
    off = f.state.accel_matrix - np.eye(3)
    return np.concatenate([(f.state.gyro_matrix - np.eye(3)).ravel(), off[LOWER[:, 0], LOWER[:, 1]]])


def _factor(f: CalibrationFilter) -> float:
    return max((c.factor for c in f.consistency.values()), default=1.0)


def log_bayes_factor(entries: FloatArray, covariance: FloatArray, factor: float) -> float:
    """Logarithm of how much more likely the data are if the entries are not zero.

    Args:
        entries: As estimated with a prior of `ENTRY_SIGMA`, shape (15,).
        covariance: Of them, shape (15, 15).
        factor: What was learnt beyond the prior is worth so many times less than the covariance says.
    """
    values, unit = entries / ENTRY_SIGMA, np.eye(len(entries))
    information = np.linalg.inv(covariance / ENTRY_SIGMA**2)
    tempered = unit + (information - unit) / factor
    weighted = information @ values / factor
    fits = float(weighted @ np.linalg.solve(tempered, weighted))
    return 0.5 * min(fits, 2.0 * _MOST) - 0.5 * float(np.linalg.slogdet(tempered)[1])


def probability(log_evidence: float) -> float:
    """Probability that the entries are not zero."""
    return float(1.0 / (1.0 + (1.0 - _OFF) / _OFF * np.exp(-log_evidence)))


def surely_off(log_evidence: float) -> bool:
    """Whether that is beyond doubt."""
    return probability(log_evidence) > _SURE


def told(entries: FloatArray, sigmas: FloatArray) -> str:
    """The announcement, with the entry that is off beyond all others."""
    surest = int(np.argmax(np.abs(entries) / sigmas))
    percent, sigma = 100.0 * abs(float(entries[surest])), 100.0 * float(sigmas[surest])
    return f"scale or alignment of the imu is off, by {percent:.2f} +- {sigma:.2f} %: allowed for from now on"


def log_evidence(f: CalibrationFilter) -> float:
    """`log_bayes_factor` of a filter's entries.

    Where images miss by more than their noise although the entries are free, it is the images (a lens that is
    held and wrong, a crooked board), and what they say about the imu is worth less by as much again.
    """
    where = _entries(f.layout)
    if where is None:
        return -_MOST
    return log_bayes_factor(_values(f), f.S[where] @ f.S[where].T, _factor(f) * _misfit(f))


def _misfit(f: CalibrationFilter) -> float:
    return max((c.scale for c in f.consistency.values()), default=1.0)


def off(f: CalibrationFilter) -> float:
    """Probability that the entries are not zero; 1 where that was announced, or they were asked for."""
    return 1.0 if f.imu_off else probability(log_evidence(f))


def averaged(f: CalibrationFilter, *, gyro_frame: bool) -> CalibrationFilter:
    """Return the filter as it is to be told: mean and covariance over both hypotheses.

    Args:
        f: The filter.
        gyro_frame: Cameras are told in the frame in which the gyro's matrix is symmetric, which is that of
            whoever integrates its readings as they are; not in that of the accelerometer.
    """
    where = _entries(f.layout)
    if where is None:
        return f
    p = off(f)
    if p < 1.0:
        f = _mixed(f, where, p)
    return _in_gyro_frame(f) if gyro_frame else f


def _mixed(f: CalibrationFilter, where: slice, p: float) -> CalibrationFilter:
    """The mixture: with probability `p` what the filter says, else that conditioned on entries of zero.

    With U the orthonormal rows of S that move the entries, conditioning takes S U U' S' off P and moves the
    mean by -d; the mixture goes (1 - p) of that way, and p (1 - p) d d' is added.
    """
    L = root(f.S[where] @ f.S[where].T)
    U = solve_lower(L, f.S[where])
    d = f.S @ (U.T @ solve_lower(L, _values(f)))
    S = f.S - (1.0 - np.sqrt(p)) * (f.S @ U.T) @ U
    apart = np.sqrt(p * (1.0 - p) / _factor(f)) * d  # of what is told, which is `factor` times P
    state = retract(f.state, f.layout, -(1.0 - p) * d)
    return replace(f, state=state, S=np.concatenate([S, apart[:, None]], axis=1))


def _in_gyro_frame(f: CalibrationFilter) -> CalibrationFilter:
    """Mounting and lever arm in the frame in which M_g is symmetric, to first order in its entries."""
    assert f.layout.gyro_matrix is not None
    turned = turn(f.S[f.layout.gyro_matrix].reshape(3, 3, -1))
    back = exp_one(-turn(f.state.gyro_matrix))
    S, cameras = f.S.copy(), dict(f.state.cameras)
    for name, slices in f.layout.cameras.items():
        if slices.position is None or slices.rotation is None:
            continue
        cam = cameras[name]
        S[slices.rotation] -= cam.R_imu_cam.T @ turned
        S[slices.position] += hat(cam.p_imu_cam) @ turned
        cameras[name] = replace(cam, R_imu_cam=back @ cam.R_imu_cam, p_imu_cam=back @ cam.p_imu_cam)
    state = copy(f.state)
    state.cameras = cameras
    return replace(f, state=state, S=S)


def turn(M: FloatArray) -> FloatArray:
    """The rotation vector whose matrix the antisymmetric part of M is, shape (3, ...)."""
    return np.asarray(0.5 * (M[[2, 0, 1], [1, 2, 0]] - M[[1, 2, 0], [2, 0, 1]]))


def in_doubt(f: CalibrationFilter) -> bool:
    """Whether the data speak for entries that are not zero, though not yet surely: they soon will.

    Images that do not fit may never decide it; what is told covers both then.
    """
    return not f.imu_off and _misfit(f) == 1.0 and log_evidence(f) > 0.0


def _widen(f: CalibrationFilter) -> None:
    """Take the prior of the entries back, but for that of an IMU which is known to be off.

    With c what the prior's information falls by and E the entries:
    (P^-1 - c E E')^-1 = P + P E (I/c - E' P E)^-1 E' P, and the mean moves by P E (I/c - E' P E)^-1 E' x.
    """
    where = _entries(f.layout)
    assert where is not None
    entries = f.S[where]
    c = ENTRY_SIGMA**-2.0 - KNOWN_OFF_SIGMA**-2.0
    L = root(np.eye(len(entries)) / c - entries @ entries.T)
    W = solve_lower(L, entries @ f.S.T).T
    dx = W @ solve_lower(L, _values(f))
    f.loosen(W)
    f.state = retract(f.state, f.layout, dx)


@dataclass(slots=True)
class ImuDoubt:
    """Asks once a second whether the entries are beyond doubt."""

    _next_s: float = -np.inf

    def look(self, f: CalibrationFilter) -> str:
        """Return what is to be announced, once they are; empty: nothing."""
        if f.imu_off or f.state.t_s < self._next_s:
            return ""
        self._next_s = f.state.t_s + _EVERY_S
        if not surely_off(log_evidence(f)):
            return ""
        _widen(f)
        f.imu_off = True
        where = _entries(f.layout)
        return told(_values(f), np.sqrt(_factor(f)) * f.sigmas()[where])
