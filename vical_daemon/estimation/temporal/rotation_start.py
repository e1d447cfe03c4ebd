"""The start of a registration, knowing nothing: delay over several seconds, mounting and gyro bias.

The model (t_imu = t_cam + shift): `R_world_cam(t) = R_world_ref R_ref_imu(t + shift) R_imu_cam`.

1. The angle by which a body turns between two instants does not depend on the frame it is written in. The
   shift at which the camera's turns match the imu's is found on a grid over several seconds, robustly.
2. Matched turns are vectors related by R_imu_cam: robust Wahba.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import geman_mcclure_weight
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve, OrientationCurve, RotationCurve
from vical_daemon.estimation.temporal.rotation_turns import MIN_PAIRS, Turns, camera_turns

GRID_S = 0.01  # of shifts: a hand's rate changes over 0.1 s; a quarter of it about the best ones
_AT_ONCE = 1000  # shifts that are compared together: 30 MB with 300 turns; the default search has 1001
_CANDIDATES = 4  # shifts whose directions are compared too: periodic motion agrees in size at several


@dataclass(frozen=True)
class Start:
    """A rough registration.

    Attributes:
        timeshift_s: t_imu - t_cam, s.
        R_imu_cam: Mounting, shape (3, 3).
        bias_rps: Rough residual gyro bias, rad/s, shape (3,).
        agreement: Share of turns that agree in size at this shift, 0 to 1.
        misfit_rad: Median length of the residual turn vectors.
        typical_rad: Median size of the camera's turns, for comparison.
        baseline_s: Time over which the turns were taken, s.
        scale_rad: How far the sizes of two turns may differ and still agree.
        mirrored: A mirrored mounting (one axis reversed) fits far better: axes are mixed up.
    """

    timeshift_s: float
    R_imu_cam: FloatArray
    bias_rps: FloatArray
    agreement: float
    misfit_rad: float
    mirrored: bool
    typical_rad: float
    baseline_s: float
    scale_rad: float

    @property
    def misfit_share(self) -> float:
        """Misfit over the size of the turns: noise over signal."""
        return self.misfit_rad / max(self.typical_rad, 1e-9)


def angles_between(qa: FloatArray, qb: FloatArray) -> FloatArray:
    """Angles between orientations given as quaternions (..., 4), rad, shape (...,)."""
    return np.asarray(2.0 * np.arccos(np.minimum(np.abs(np.vecdot(qa, qb)), 1.0)))


def robust_cost(difference: FloatArray, scale: float) -> FloatArray:
    """Geman-McClure: 0 for agreement, towards 1 for gross disagreement."""
    d2 = (difference / scale) ** 2
    return np.asarray(d2 / (1.0 + d2))


def shift_costs(
    curve: RotationCurve, t_cam_s: FloatArray, turns: Turns, shifts_s: FloatArray, scale: float
) -> FloatArray:
    """Return the mean robust disagreement of turn angles at each shift of a regular grid, shape (s,).

    Pairs that leave the curve's span count as undecided (0.6): a shift with little overlap must not win.
    """
    start, end = curve.span_s
    step = float(shifts_s[1] - shifts_s[0])
    grid = curve.quaternion(np.arange(start, end, step))
    offsets = np.round(shifts_s / step).astype(np.intp)
    a = np.round((t_cam_s[turns.first] - start) / step).astype(np.intp)
    b = np.round((t_cam_s[turns.second] - start) / step).astype(np.intp)
    costs = np.empty(len(offsets))
    for begin in range(0, len(offsets), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        ia, ib = a + offsets[part, None], b + offsets[part, None]
        inside = (ia >= 0) & (ib < len(grid))
        angle = angles_between(grid[np.where(inside, ia, 0)], grid[np.where(inside, ib, 0)])
        costs[part] = np.where(inside, robust_cost(angle - turns.angle, scale), 0.6).mean(axis=1)
    return costs


def agreement_scale(turns: Turns) -> float:
    """How far two turns may differ and still agree: a quarter of a usual turn, at least 0.6 deg."""
    return max(0.25 * float(np.quantile(turns.angle, 0.4)), 0.01)


def _minima(costs: FloatArray, apart: int) -> list[int]:
    """Return the lowest points of a sampled curve, best first, none closer than `apart` samples."""
    found: list[int] = []
    for i in np.argsort(costs):
        if all(abs(int(i) - j) >= apart for j in found):
            found.append(int(i))
            if len(found) == _CANDIDATES:
                break
    return found


def coarse_start(
    curve: RotationCurve, t_cam_s: FloatArray, q_world_cam: FloatArray, shifts_s: tuple[float, float]
) -> Start | None:
    """Find shift and mounting without any prior knowledge.

    Several local minima of the angle cost are judged by how well the turns agree as vectors: motion that
    swings to and fro repeats its angles after half a period, but not its directions.

    Args:
        curve: The imu's (or any reference's) orientation.
        t_cam_s: Camera stamps, s, shape (n,).
        q_world_cam: Camera orientations, shape (n, 4).
        shifts_s: Lowest and highest shift to look at, s.

    Returns:
        The best start, or None where fewer than 8 turns can be formed.
    """
    turns = camera_turns(t_cam_s, q_world_cam)
    if len(turns.first) < MIN_PAIRS:
        return None
    scale = agreement_scale(turns)
    grid = np.arange(np.floor(shifts_s[0] / GRID_S), np.ceil(shifts_s[1] / GRID_S) + 1.0) * GRID_S
    if len(grid) < 2:
        grid = np.array([grid[0], grid[0] + GRID_S])
    costs = shift_costs(curve, t_cam_s, turns, grid, scale)
    best: Start | None = None
    for i in _minima(costs, apart=5):
        start = _start_at(curve, t_cam_s, turns, float(grid[i]), scale)
        if start is not None and (best is None or start.misfit_rad < best.misfit_rad):
            best = start
    return best


def _start_at(
    curve: RotationCurve, t_cam_s: FloatArray, turns: Turns, shift_s: float, scale: float
) -> Start | None:
    """Refine the shift around a grid point and solve for the mounting there."""
    fine = shift_s + np.arange(-6, 7) * (GRID_S / 4.0)
    low, high = curve.span_s
    ta, tb = t_cam_s[turns.first] + fine[:, None], t_cam_s[turns.second] + fine[:, None]
    inside = (ta >= low) & (tb <= high)
    if np.count_nonzero(inside[6]) < 8:
        return None
    difference = angles_between(curve.quaternion(ta), curve.quaternion(tb)) - turns.angle
    costs = np.where(inside, robust_cost(difference, scale), 0.6).mean(axis=1)
    best = int(np.argmin(costs))
    shift = float(fine[best])
    use = inside[best] & (np.abs(difference[best]) < 1.5 * scale)
    if np.count_nonzero(use) < 6:
        return None
    qa, qb = curve.quaternion(ta[best][use]), curve.quaternion(tb[best][use])
    turn_imu = so3.turn_between(qa, qb)
    dt = tb[best][use] - ta[best][use]
    R, bias, misfit, mirrored = _mounting(turn_imu, turns.rotvec_cam[use], dt)
    agreement = float(np.mean(np.abs(difference[best][inside[best]]) < scale))
    # turns whose size does not agree count as badly as a whole turn misplaced
    share = np.count_nonzero(use) / len(turns.first)
    return Start(
        shift,
        R,
        bias,
        agreement,
        misfit / share**2,
        mirrored,
        float(np.median(turns.angle)),
        turns.baseline_s,
        scale,
    )


def _mounting(
    turn_imu: FloatArray, turn_cam: FloatArray, dt: FloatArray
) -> tuple[FloatArray, FloatArray, float, bool]:
    """Robust Wahba: R with turn_imu = R turn_cam + bias dt, by reweighting; the misfit; mirrored axes?"""
    weight, bias = np.ones(len(dt)), np.zeros(3)
    for i in range(8):
        target = turn_imu - bias * dt[:, None]
        U, s, Vt = np.linalg.svd((target * weight[:, None]).T @ turn_cam)
        sign = np.sign(np.linalg.det(U @ Vt))
        # the smallest singular value is what a mirrored mounting would gain and a rotation must pay; later
        # rounds have put aside what disagrees with a rotation
        if i == 0:
            mirrored = bool(sign < 0 and s[2] > 0.25 * s[1] and s[2] > 0.02 * s[0])
        R = (U * np.array([1.0, 1.0, sign])) @ Vt
        residual = turn_imu - turn_cam @ R.T
        bias = np.sum(residual * (weight * dt)[:, None], axis=0) / np.sum(weight * dt * dt)
        residual = residual - bias * dt[:, None]
        length2 = np.vecdot(residual, residual)
        weight = geman_mcclure_weight(length2 / max(2.0 * float(np.median(length2)), 1e-12))
    return R, bias, float(np.sqrt(np.median(length2))), mirrored


@dataclass(frozen=True)
class GyroReference:
    """A gyro.

    Attributes:
        t_s: Stamps, increasing, s, shape (m,).
        gyro_rps: Rates in the imu frame, rad/s, shape (m, 3).
        sensor, name: What the other sensor and the reference are called in messages.
    """

    t_s: FloatArray
    gyro_rps: FloatArray
    sensor: str = "camera"
    name: str = "IMU"

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last sample, s."""
        return float(self.t_s[0]), float(self.t_s[-1])

    def curve(self, bias_rps: FloatArray) -> RotationCurve:
        """The orientation over time, for a gyro bias (3,)."""
        return GyroCurve.integrate(self.t_s, self.gyro_rps, bias_rps)

    def start(
        self, t_s: FloatArray, q_world_sensor: FloatArray, shifts_s: tuple[float, float]
    ) -> tuple[Start | None, FloatArray]:
        """Find a start for orientations (n, 4) at `t_s` (n,), and the bias to begin with, rad/s (3,).

        It is found once more with the bias that it reveals if that bias blurs the agreement.
        """
        bias = np.zeros(3)
        start: Start | None = None
        for _ in range(3):
            start = coarse_start(self.curve(bias), t_s, q_world_sensor, shifts_s)
            if start is None:
                break
            bias = bias + start.bias_rps
            if np.linalg.norm(start.bias_rps) * start.baseline_s < 0.25 * start.scale_rad:
                break
        return start, bias

    def mirrored(self) -> GyroReference:
        """Every mirrored mounting is this and a rotation."""
        return replace(self, gyro_rps=self.gyro_rps * np.array([-1.0, 1.0, 1.0]))

    def scaled(self, factor: float) -> GyroReference:
        """The same in another unit."""
        return replace(self, gyro_rps=self.gyro_rps * factor)


@dataclass(frozen=True)
class StreamReference:
    """Orientations, interpolated; they have no bias. Attributes and methods as those of a gyro."""

    orientations: OrientationCurve
    sensor: str = "sensor"
    name: str = "reference"

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last orientation, s."""
        return self.orientations.span_s

    def curve(self, _bias_rps: FloatArray) -> RotationCurve:
        """The orientations."""
        return self.orientations

    def start(
        self, t_s: FloatArray, q_world_sensor: FloatArray, shifts_s: tuple[float, float]
    ) -> tuple[Start | None, FloatArray]:
        """Find a start."""
        return coarse_start(self.orientations, t_s, q_world_sensor, shifts_s), np.zeros(3)

    def mirrored(self) -> None:
        """Orientations are rotations: no axis can be reversed."""

    def scaled(self, _factor: float) -> None:
        """They have no unit."""


Reference = GyroReference | StreamReference
