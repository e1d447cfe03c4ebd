"""The final polish of temporal calibration: all orientation sensors jointly against one rotation curve.

Model for sensor s: `R_world_s(t) = R_world_ref R_ref_imu(t + shift_s) R_imu_s Exp(noise)`. Shifts,
mountings, worlds, gyro bias and the drift of the integrated gyro are one least-squares problem (see
`drift_smoother`); pairs of closest points are not used any more. How large the noises are is itself estimated
by restricted maximum likelihood, so that the sigmas that come out are those the data support.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation import so3
from vical_daemon.estimation.drift_smoother import BIAS, DriftProblem, DriftSolution, solve
from vical_daemon.estimation.rotation_curves import RotationCurve

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_GATE = 16.27  # chi-square, 3 degrees of freedom, 99.9 %
_MEDIAN_CHI2_3 = 2.366
_MIN_INTERVAL_S = 2e-5  # two sensors may see the same instant; their drift may not be told apart to infinity
_ROUNDS = 12
_SHIFT_DONE_S = 2e-8
# in which rounds the noises are estimated and with what steps, for one sensor and for several
_SWEEPS = ({3: (0.5, 0.25), 5: (0.2,)}, {3: (0.5,), 5: (0.3,)})
_SLOW_START = -1.5  # where the search for log(slow error after a second / noise of one orientation) starts
_SLOW_LIMITS = (-4.0, 4.0)
_TURN_UNKNOWN = 1.0 / 5.0**2  # information about a world that may be turned by any angle
# The gyro's scale errors and the symmetric part of its misalignment: xx yy zz, xy yz xz. The antisymmetric
# part is a rotation of the gyro's axes and cannot be told from the mounting.
_SYMMETRIC = np.zeros((9, 6))
_SYMMETRIC[[0, 4, 8], [0, 1, 2]] = 1.0
_SYMMETRIC[[1, 3, 5, 7, 2, 6], [3, 3, 4, 4, 5, 5]] = 1.0


@dataclass(frozen=True)
class OrientationSensor:
    """A stream of orientations with its present registration.

    Attributes:
        t_s: Stamps in the sensor's clock, s, shape (n,).
        R_world_sensor: Orientations, shape (n, 3, 3).
        covariance: Of the local (right) rotation error, up to a common scale, rad^2, shape (n, 3, 3).
        timeshift_s: t_imu - t_sensor, s.
        R_imu_sensor: Mounting, shape (3, 3).
        R_world_ref: The curve's reference frame in the sensor's world, shape (3, 3).
        used: Orientations that passed the gate, shape (n,).
        log_scale: Log of the factor by which the noise is larger than `covariance` says (in sigma).
        log_slow: Log of the slow error that a second brings over the noise of one orientation. Slow errors
            come from lens and board models which are not exact, and change with the view.
        jitter_s: Standard deviation of the stamps, s; independent from orientation to orientation.
    """

    t_s: FloatArray
    R_world_sensor: FloatArray
    covariance: FloatArray
    timeshift_s: float
    R_imu_sensor: FloatArray
    R_world_ref: FloatArray
    used: BoolArray
    log_scale: float = 0.0
    log_slow: float = _SLOW_START
    jitter_s: float = 0.0


@dataclass(frozen=True)
class DriftNoise:
    """Noise of the curve.

    Attributes:
        density: Gyro noise density, rad/s/sqrt(Hz).
        walk: Bias walk, rad/s^2/sqrt(Hz).
        bias_sigma_rps: Prior of the bias around zero, rad/s.
        log_sigma: How well `density` is known, as the sigma of its logarithm.
        estimate: Estimate the noises' scales from the data; else take them as given.
        matrix_sigma: Prior sigma of each entry of the gyro's scale and misalignment errors; 0: none.
    """

    density: float
    walk: float
    bias_sigma_rps: float
    log_sigma: float
    estimate: bool
    matrix_sigma: float = 0.0


@dataclass(frozen=True)
class Fit:
    """The polished registration.

    Attributes:
        sensors: With their final registration and gates.
        covariance: Of [R_imu_s (3, local), shift_s] for each sensor in turn, then the bias, (4 S + 3) square.
        bias_rps: Gyro bias in the middle of the data, shape (3,).
        log_gyro_scale: Log of the factor by which the gyro's drift is larger than stated.
        rounds: Gauss-Newton rounds.
    """

    sensors: tuple[OrientationSensor, ...]
    covariance: FloatArray
    bias_rps: FloatArray
    log_gyro_scale: float
    rounds: int


@dataclass(frozen=True)
class _Linear:
    """The linearised problem in order of time, before scaling of the noises.

    Attributes:
        problem: With unscaled weights; its Q is set by `_scaled`.
        sensor: Which sensor each row belongs to, shape (n,).
        order: Sorted row to row of the sensors strung together, shape (n,).
        used: Rows that take part, shape (n,).
        drift: Variance per axis of the gyro's drift over each step, rad^2, shape (n - 1,).
        walk: Variance per axis of the bias over each step, (rad/s)^2, shape (n - 1,).
        slow: Covariance of each sensor's slow error over each step per unit of scale, shape (S, n - 1, 3, 3).
    """

    problem: DriftProblem
    sensor: npt.NDArray[np.intp]
    order: npt.NDArray[np.intp]
    used: BoolArray
    drift: FloatArray
    walk: FloatArray
    slow: FloatArray


def polish(
    make_curve: Callable[[FloatArray], RotationCurve],
    sensors: tuple[OrientationSensor, ...],
    bias_rps: FloatArray,
    noise: DriftNoise,
) -> Fit:
    """Solve for all registrations together.

    Args:
        make_curve: Builds the curve for a gyro bias (a curve without bias ignores it).
        sensors: Streams with start values: shift within some 50 ms, mounting within some 10 degrees.
        bias_rps: Start of the bias, shape (3,).
        noise: Of the curve.

    Raises:
        numpy.linalg.LinAlgError: nothing left to fit.
    """
    bias = np.array(bias_rps, dtype=np.float64)
    log_gyro = 0.0
    curve = make_curve(bias)
    solution: DriftSolution | None = None
    rounds, done = 0, False
    while rounds < _ROUNDS and not done:
        rounds += 1
        linear = _linearise(curve, sensors, bias, noise)
        sweeps = _SWEEPS[min(len(sensors) - 1, 1)].get(rounds, ())
        if noise.estimate and sweeps:
            sensors, log_gyro = _estimate_scales(linear, sensors, log_gyro, noise, sweeps)
        solution = solve(_scaled(linear, _scales(sensors, log_gyro)))
        new_sensors, step = _update(linear, sensors, solution, noise.estimate and rounds <= 2, noise.estimate)
        same_gate = all(np.array_equal(a.used, b.used) for a, b in zip(sensors, new_sensors, strict=True))
        sensors = new_sensors
        bias = bias + solution.states[len(solution.states) // 2, BIAS]
        done = rounds > 5 and abs(step) < _SHIFT_DONE_S and same_gate
        if not done:
            curve = make_curve(bias)
    assert solution is not None
    return Fit(sensors, _wanted(solution.covariance, len(sensors)), bias, log_gyro, rounds)


def _linearise(
    curve: RotationCurve, sensors: tuple[OrientationSensor, ...], bias: FloatArray, noise: DriftNoise
) -> _Linear:
    """Residuals and derivatives in the curve's reference frame, sorted by time.

    Parameters per sensor: mounting (3, local), shift; then the gyro's matrix (6). States: drift (3), bias (3)
    and, for several sensors, the slow error of each (3): the first one's starts at zero, the others' at
    anything, which stands for the orientation of their worlds. A single sensor's slow error joins the drift.
    """
    S = len(sensors)
    p = 4 * S + (6 if noise.matrix_sigma > 0.0 else 0)
    low, high = curve.span_s
    times = [np.clip(s.t_s + s.timeshift_s, low, high) for s in sensors]
    index = np.repeat(np.arange(S), [len(t) for t in times])
    order = np.argsort(np.concatenate(times), kind="stable")
    tau, index = np.concatenate(times)[order], index[order]
    R, rate, integral = curve.at(tau)
    turn = (R @ rate[..., None])[..., 0]
    mounting = np.stack([s.R_imu_sensor for s in sensors])[index]
    R_ref_sensor = R @ mounting
    measured = np.concatenate([s.R_world_ref.T @ s.R_world_sensor for s in sensors])[order]
    J = np.zeros((len(tau), 3, p))
    rows = np.arange(len(tau))
    for i in range(3):
        J[rows, :, 4 * index + i] = R_ref_sensor[:, :, i]
    J[rows, :, 4 * index + 3] = turn
    if p > 4 * S:
        J[:, :, 4 * S :] = curve.matrix_effect(tau) @ _SYMMETRIC
    C = (
        R_ref_sensor
        @ np.concatenate([s.covariance for s in sensors])[order]
        @ np.swapaxes(R_ref_sensor, 1, 2)
    )
    jitter2 = np.array([s.jitter_s**2 * np.exp(-2.0 * s.log_scale) for s in sensors])[index]
    C = C + jitter2[:, None, None] * turn[:, :, None] * turn[:, None, :]
    raw = np.concatenate([s.t_s + s.timeshift_s for s in sensors])[order]
    used = np.concatenate([s.used for s in sensors])[order] & (raw >= low) & (raw <= high)
    dt = np.maximum(np.diff(tau), _MIN_INTERVAL_S)
    d = 6 if S == 1 else 6 + 3 * S
    H = np.zeros((len(tau), 3, d))
    H[:, :, :3] = np.eye(3)
    if S > 1:
        for i in range(3):
            H[rows, i, 6 + 3 * index + i] = 1.0
    F = np.tile(np.eye(d), (len(dt), 1, 1))
    F[:, :3, 3:6] = -np.diff(integral, axis=0)
    information = np.zeros(d)
    information[3:6] = 1.0 / noise.bias_sigma_rps**2
    information[6:9] = 1e10  # of several sensors, the first one's slow error starts at zero
    information[9:] = _TURN_UNKNOWN
    mean = np.zeros(d)
    mean[3:6] = -bias
    e = so3.log(measured @ np.swapaxes(R_ref_sensor, 1, 2))
    problem = DriftProblem(
        e,
        J,
        H,
        np.linalg.inv(C) * used[:, None, None],
        F,
        np.zeros((len(dt), d, d)),
        mean,
        information,
        _prior(S, p, noise.matrix_sigma),
    )
    drift = np.maximum(np.diff(curve.variance(tau, noise.density)), 1e-4 * noise.density**2 * _MIN_INTERVAL_S)
    slow = np.empty((S, len(dt), 3, 3))
    for i, s in enumerate(sensors):
        A = R[:-1] @ s.R_imu_sensor
        slow[i] = dt[:, None, None] * (A @ s.covariance.mean(axis=0) @ np.swapaxes(A, 1, 2))
    return _Linear(problem, index, order, used, drift, noise.walk**2 * dt, slow)


def _prior(S: int, p: int, matrix_sigma: float) -> FloatArray:
    """Next to no information: 2 rad on rotations, 0.5 s on shifts; keeps a lost direction finite."""
    diagonal = np.full(p, 1.0 / 2.0**2)
    diagonal[3 : 4 * S : 4] = 1.0 / 0.5**2
    if p > 4 * S:
        diagonal[4 * S :] = 1.0 / matrix_sigma**2
    return np.diag(diagonal)


def _scaled(linear: _Linear, scales: FloatArray) -> DriftProblem:
    """The problem for given noises: logs of [noise of each sensor, slow error of each, gyro drift]."""
    S = len(linear.slow)
    sensor_scale, slow_scale = np.exp(2.0 * scales[:S]), np.exp(2.0 * (scales[:S] + scales[S : 2 * S]))
    drift = linear.drift * np.exp(2.0 * scales[2 * S])
    Q = np.zeros_like(linear.problem.Q)
    Q[:, [0, 1, 2], [0, 1, 2]] = drift[:, None]
    Q[:, [3, 4, 5], [3, 4, 5]] = linear.walk[:, None]
    if S == 1:
        Q[:, :3, :3] += slow_scale[0] * linear.slow[0]
    else:
        for i in range(S):
            part = slice(6 + 3 * i, 9 + 3 * i)
            Q[:, part, part] = slow_scale[i] * linear.slow[i]
    weight = linear.problem.weight / sensor_scale[linear.sensor][:, None, None]
    return replace(linear.problem, weight=weight, Q=Q)


def _scales(sensors: tuple[OrientationSensor, ...], log_gyro: float) -> FloatArray:
    return np.array([*(s.log_scale for s in sensors), *(s.log_slow for s in sensors), log_gyro])


def _estimate_scales(
    linear: _Linear,
    sensors: tuple[OrientationSensor, ...],
    log_gyro: float,
    noise: DriftNoise,
    steps: tuple[float, ...],
) -> tuple[tuple[OrientationSensor, ...], float]:
    """Restricted maximum likelihood of the noises' scales, one after the other by parabolas, in sweeps.

    -2 log L = (weighted squares) + log det(information of all unknowns) - log det(weights and steps), plus
    the prior that says how well the gyro's density is known.
    """
    S = len(sensors)
    counts = np.array([np.count_nonzero(linear.used & (linear.sensor == i)) for i in range(S)])

    def cost(values: FloatArray) -> float:
        solution = solve(_scaled(linear, values))
        likelihood = solution.quadratic + solution.log_determinant + 6.0 * float(counts @ values[:S])
        outside = np.maximum(np.abs(values[S : 2 * S]) - _SLOW_LIMITS[1], 0.0)
        return likelihood + float(values[-1] / noise.log_sigma) ** 2 + 1e3 * float(outside @ outside)

    scales = _scales(sensors, log_gyro)
    here = cost(scales)
    for step in steps:
        for i in range(len(scales)):
            size = 2.0 * step if S <= i < 2 * S else step
            delta = size * np.eye(len(scales))[i]
            down, up = cost(scales - delta), cost(scales + delta)
            bend = down - 2.0 * here + up
            move = 0.5 * (down - up) / bend if bend > 1e-9 else float(np.sign(down - up)) * 2.0
            trial = scales + delta * float(np.clip(move, -2.0, 2.0))
            options = [(here, scales), (down, scales - delta), (up, scales + delta), (cost(trial), trial)]
            here, scales = min(options, key=lambda o: o[0])
    sensors = tuple(
        replace(s, log_scale=float(scales[i]), log_slow=float(scales[S + i])) for i, s in enumerate(sensors)
    )
    return sensors, float(scales[-1])


def _update(
    linear: _Linear,
    sensors: tuple[OrientationSensor, ...],
    solution: DriftSolution,
    rescale: bool,
    estimated: bool,
) -> tuple[tuple[OrientationSensor, ...], float]:
    """Apply a step, and judge every orientation anew by what the solution leaves to its noise."""
    noise = np.empty_like(solution.noise)
    noise[linear.order] = solution.noise  # back from time order to sensor order
    lost = np.empty_like(noise)
    lost[linear.order] = (linear.problem.H @ solution.states[..., None])[..., 0]
    updated = []
    start, largest = 0, 0.0
    for i, s in enumerate(sensors):
        rows = slice(start, start + len(s.t_s))
        start += len(s.t_s)
        x = solution.x[4 * i : 4 * i + 4]
        local = np.einsum("kji,kj->ki", s.R_world_ref.T @ s.R_world_sensor, noise[rows])
        d2 = np.einsum("ki,ki->k", local, np.linalg.solve(s.covariance, local[..., None])[..., 0])
        by_median = 0.5 * float(np.log(max(float(np.median(d2)), 1e-12) / _MEDIAN_CHI2_3))
        log_scale = by_median if rescale else s.log_scale
        largest = max(largest, abs(float(x[3])))
        # the gate may not close in on itself: it stays as wide as the median of all demands
        width = max(log_scale, by_median + np.log(0.8)) if estimated else log_scale
        updated.append(
            replace(
                s,
                timeshift_s=s.timeshift_s + float(np.clip(x[3], -0.1, 0.1)),
                R_imu_sensor=s.R_imu_sensor @ so3.exp(x[:3]),
                R_world_ref=s.R_world_ref @ so3.exp(lost[rows].mean(axis=0)),
                used=d2 < _GATE * np.exp(2.0 * width),
                log_scale=log_scale,
            )
        )
    return tuple(updated), largest


def _wanted(covariance: FloatArray, S: int) -> FloatArray:
    """Leave out the gyro's matrix: mountings and shifts, then the bias."""
    p = len(covariance) - 3
    keep = [*range(4 * S), *range(p, p + 3)]
    return covariance[np.ix_(keep, keep)]
