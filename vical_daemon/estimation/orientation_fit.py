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
from vical_daemon.estimation.drift_smoother import DriftProblem, DriftSolution, solve
from vical_daemon.estimation.rotation_curves import RotationCurve

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_GATE = 16.27  # chi-square, 3 degrees of freedom, 99.9 %
_MEDIAN_CHI2_3 = 2.366
_MIN_INTERVAL_S = 2e-5  # two sensors may see the same instant; their drift may not be told apart to infinity
_ROUNDS = 12
_SHIFT_DONE_S = 2e-8


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
    """

    density: float
    walk: float
    bias_sigma_rps: float
    log_sigma: float
    estimate: bool


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
    """The linearised problem in order of time, before scaling of the noises."""

    problem: DriftProblem
    sensor: npt.NDArray[np.intp]
    order: npt.NDArray[np.intp]
    used: BoolArray


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
        if rounds in (3, 5) and noise.estimate:
            sensors, log_gyro = _estimate_scales(linear, sensors, log_gyro, noise)
        solution = solve(_scaled(linear, sensors, log_gyro))
        new_sensors, step = _update(linear, sensors, solution, rounds <= 2 and noise.estimate)
        same_gate = all(np.array_equal(a.used, b.used) for a, b in zip(sensors, new_sensors, strict=True))
        sensors = new_sensors
        change = solution.bias[len(solution.bias) // 2]
        bias = bias + change
        done = rounds > 5 and abs(step) < _SHIFT_DONE_S and same_gate
        if not done:
            curve = make_curve(bias)
    assert solution is not None
    return Fit(sensors, _wanted(solution.covariance, len(sensors)), bias, log_gyro, rounds)


def _linearise(
    curve: RotationCurve, sensors: tuple[OrientationSensor, ...], bias: FloatArray, noise: DriftNoise
) -> _Linear:
    """Residuals and derivatives in the curve's reference frame, sorted by time.

    Parameters per sensor: mounting (3, local), shift; then, for every sensor but the first, its world (3):
    the first one's is the free first drift.
    """
    S = len(sensors)
    p = 4 * S + 3 * (S - 1)
    parts, gates = [], []
    low, high = curve.span_s
    for i, s in enumerate(sensors):
        tau = s.t_s + s.timeshift_s
        inside = (tau >= low) & (tau <= high)
        tau = np.clip(tau, low, high)
        R, rate, integral = curve.at(tau)
        R_ref_sensor = R @ s.R_imu_sensor
        measured = s.R_world_ref.T @ s.R_world_sensor
        e = so3.log(measured @ np.swapaxes(R_ref_sensor, 1, 2))
        J = np.zeros((len(tau), 3, p))
        turn = (R @ rate[..., None])[..., 0]
        J[:, :, 4 * i : 4 * i + 3] = R_ref_sensor
        J[:, :, 4 * i + 3] = turn
        if i:
            J[:, :, 4 * S + 3 * (i - 1) : 4 * S + 3 * i] = np.eye(3)
        C = R_ref_sensor @ s.covariance @ np.swapaxes(R_ref_sensor, 1, 2)
        C = C + (s.jitter_s**2 * np.exp(-2.0 * s.log_scale)) * turn[:, :, None] * turn[:, None, :]
        parts.append((tau, e, J, np.linalg.inv(C), integral))
        gates.append(s.used & inside)
    times = np.concatenate([part[0] for part in parts])
    order = np.argsort(times, kind="stable")
    tau, e, J, W, integral = (np.concatenate([part[c] for part in parts])[order] for c in range(5))
    used = np.concatenate(gates)[order]
    index = np.repeat(np.arange(S), [len(s.t_s) for s in sensors])[order]
    dt = np.maximum(np.diff(tau), _MIN_INTERVAL_S)
    floor = noise.density**2 * _MIN_INTERVAL_S * 1e-4
    problem = DriftProblem(
        e=e,
        J=J,
        weight=W * used[:, None, None],
        bias_effect=np.diff(integral, axis=0),
        drift_variance=np.maximum(np.diff(curve.variance(tau, noise.density)), floor),
        walk_variance=noise.walk**2 * dt,
        bias_prior=(-bias, noise.bias_sigma_rps**2),
        prior_information=_prior(S, p),
    )
    return _Linear(problem, index, order, used)


def _prior(S: int, p: int) -> FloatArray:
    """Next to no information: 2 rad on rotations, 0.5 s on shifts; keeps a lost direction finite."""
    diagonal = np.full(p, 1.0 / 2.0**2)
    diagonal[3 : 4 * S : 4] = 1.0 / 0.5**2
    return np.diag(diagonal)


def _scaled(linear: _Linear, sensors: tuple[OrientationSensor, ...], log_gyro: float) -> DriftProblem:
    factor = np.exp(-2.0 * np.array([s.log_scale for s in sensors]))[linear.sensor]
    return replace(
        linear.problem,
        weight=linear.problem.weight * factor[:, None, None],
        drift_variance=linear.problem.drift_variance * np.exp(2.0 * log_gyro),
    )


def _estimate_scales(
    linear: _Linear, sensors: tuple[OrientationSensor, ...], log_gyro: float, noise: DriftNoise
) -> tuple[tuple[OrientationSensor, ...], float]:
    """Restricted maximum likelihood of the noises' scales, one after the other by parabolas, three sweeps.

    -2 log L = (weighted squares) + log det(information of all unknowns) - log det(weights), plus the prior
    that says how well the gyro's density is known.
    """
    S = len(sensors)
    counts = np.array([np.count_nonzero(linear.used & (linear.sensor == i)) for i in range(S)])
    links = len(linear.sensor) - 1
    scales = np.array([*(s.log_scale for s in sensors), log_gyro])

    def cost(values: FloatArray) -> float:
        trial = tuple(replace(s, log_scale=float(v)) for s, v in zip(sensors, values[:S], strict=True))
        solution = solve(_scaled(linear, trial, float(values[S])))
        likelihood = solution.quadratic + solution.log_determinant
        likelihood += 6.0 * float(counts @ values[:S]) + 6.0 * links * float(values[S])
        return likelihood + float(values[S] / noise.log_sigma) ** 2

    here = cost(scales)
    for step in (0.5, 0.25, 0.12):
        for i in range(S + 1):
            d = np.zeros(S + 1)
            d[i] = step
            down, up = cost(scales - d), cost(scales + d)
            bend = down - 2.0 * here + up
            move = 0.5 * (down - up) / bend if bend > 1e-9 else float(np.sign(down - up)) * 2.0
            trial = scales + d * float(np.clip(move, -2.0, 2.0))
            value = cost(trial)
            options = [(here, scales), (down, scales - d), (up, scales + d), (value, trial)]
            here, scales = min(options, key=lambda o: o[0])
    sensors = tuple(replace(s, log_scale=float(v)) for s, v in zip(sensors, scales[:S], strict=True))
    return sensors, float(scales[S])


def _update(
    linear: _Linear, sensors: tuple[OrientationSensor, ...], solution: DriftSolution, rescale: bool
) -> tuple[tuple[OrientationSensor, ...], float]:
    """Apply a step, and judge every orientation anew by what the solution leaves to its noise."""
    S = len(sensors)
    noise = np.empty_like(solution.noise)
    noise[linear.order] = solution.noise  # back from time order to sensor order
    drift = np.empty_like(solution.drift)
    drift[linear.order] = solution.drift
    updated = []
    start, largest = 0, 0.0
    for i, s in enumerate(sensors):
        rows = slice(start, start + len(s.t_s))
        start += len(s.t_s)
        x = solution.x[4 * i : 4 * i + 4]
        world = drift[rows].mean(axis=0)
        if i:
            world = world + solution.x[4 * S + 3 * (i - 1) : 4 * S + 3 * i]
        local = np.einsum("kji,kj->ki", s.R_world_ref.T @ s.R_world_sensor, noise[rows])
        d2 = np.einsum("ki,ki->k", local, np.linalg.solve(s.covariance, local[..., None])[..., 0])
        log_scale = s.log_scale
        if rescale:
            log_scale = 0.5 * float(np.log(max(float(np.median(d2[s.used])), 1e-12) / _MEDIAN_CHI2_3))
        largest = max(largest, abs(float(x[3])))
        updated.append(
            replace(
                s,
                timeshift_s=s.timeshift_s + float(np.clip(x[3], -0.1, 0.1)),
                R_imu_sensor=s.R_imu_sensor @ so3.exp(x[:3]),
                R_world_ref=s.R_world_ref @ so3.exp(world),
                used=d2 < _GATE * np.exp(2.0 * log_scale),
                log_scale=log_scale,
            )
        )
    return tuple(updated), largest


def _wanted(covariance: FloatArray, S: int) -> FloatArray:
    """Leave out the worlds: mountings and shifts, then the bias."""
    p = len(covariance) - 3
    keep = [*range(4 * S), *range(p, p + 3)]
    return covariance[np.ix_(keep, keep)]
