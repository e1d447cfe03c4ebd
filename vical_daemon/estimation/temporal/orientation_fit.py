"""The final polish of temporal calibration: all orientation sensors jointly against one rotation curve.

Shifts, mountings, worlds, gyro bias and the drift of the integrated gyro are one least-squares problem (see
`orientation_problem` and `drift_smoother`); pairs of closest points are not used any more. How large the
noises are is itself estimated (`estimate_scales`), so that the sigmas that come out are those the data
support.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import MEDIAN_CHI2_3, MOST_STEPS
from vical_daemon.estimation.significance import PERHAPS_SIGMAS, chi_square_limit
from vical_daemon.estimation.temporal.drift_smoother import BIAS, DriftProblem, DriftSolution, solve
from vical_daemon.estimation.temporal.drift_smoother import cost as drift_cost
from vical_daemon.estimation.temporal.orientation_problem import Linear, OrientationSensor, linearise
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.stretch_agreement import widening
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions

_GATE = chi_square_limit(3, PERHAPS_SIGMAS)  # of an orientation
_SHIFT_DONE_S = 2e-8  # a change of the shift below this ends it: a hundredth of the best sigmas
# in which rounds the noises are estimated and with what steps, for one sensor and for several
_SWEEPS = ({3: (0.5, 0.25), 5: (0.2,)}, {3: (0.5,), 5: (0.3,)})
_STAMP_RATE_SIGMA = 0.1  # prior of the difference between the rates of two clocks
_MOST_SLOW = 4.0  # logarithm of a slow error over the noise; as far below
_CLOSE = 0.1  # a minimum this close, in steps, is reached


def scaled(linear: Linear, scales: FloatArray) -> DriftProblem:
    """The problem for given noises: logs of [noise of each sensor, slow error of each, gyro drift]."""
    S = len(linear.slow_sizes)
    sensor_scale, slow_scale = np.exp(2.0 * scales[:S]), np.exp(2.0 * (scales[:S] + scales[S : 2 * S]))
    drift = linear.drift[:, None] * np.exp(2.0 * scales[2 * S])
    sizes, axes = slow_scale[:, None, None] * linear.slow_sizes, linear.slow_axes
    Q_inverse = np.zeros_like(linear.problem.Q_inverse)
    Q_inverse[:, [3, 4, 5], [3, 4, 5]] = 1.0 / linear.walk[:, None]
    log_determinant = 3.0 * float(np.log(linear.walk).sum())
    if S == 1:
        sizes, first = sizes + drift, 0  # the slow error joins the drift
    else:
        Q_inverse[:, [0, 1, 2], [0, 1, 2]], first = 1.0 / drift, 6
        log_determinant += 3.0 * float(np.log(drift).sum())
    for i, inverse in enumerate((axes / sizes[:, :, None]) @ np.swapaxes(axes, 2, 3)):
        part = slice(first + 3 * i, first + 3 * i + 3)
        Q_inverse[:, part, part] = inverse
    log_determinant += float(np.log(sizes).sum())
    weight = linear.problem.weight / sensor_scale[linear.sensor][:, None, None]
    return replace(linear.problem, weight=weight, Q_inverse=Q_inverse, Q_log_determinant=log_determinant)


def scales_of(sensors: tuple[OrientationSensor, ...], log_gyro: float) -> FloatArray:
    """Logs of the noises' scales in the order that `scaled` expects, shape (2 S + 1,)."""
    return np.array([*(s.log_scale for s in sensors), *(s.log_slow for s in sensors), log_gyro])


def estimate_scales(
    linear: Linear,
    sensors: tuple[OrientationSensor, ...],
    log_gyro: float,
    log_sigma: float,
    steps: tuple[float, ...],
) -> tuple[tuple[OrientationSensor, ...], float]:
    """Restricted maximum likelihood of the noises' scales, one after the other by parabolas, in sweeps.

    -2 log L = (weighted squares) + log det(information of all unknowns) - log det(weights and steps), plus
    the prior of the gyro's density, known to `log_sigma` of its logarithm.
    """
    S = len(sensors)
    counts = np.array([np.count_nonzero(linear.used & (linear.sensor == i)) for i in range(S)])

    least = np.array([s.least_log_scale for s in sensors])

    def cost(values: FloatArray) -> float:
        likelihood = drift_cost(scaled(linear, values)) + 6.0 * float(counts @ values[:S])
        outside = np.maximum(np.abs(values[S : 2 * S]) - _MOST_SLOW, 0.0)
        outside = np.concatenate((outside, np.maximum(least - values[:S], 0.0)))
        return likelihood + float(values[-1] / log_sigma) ** 2 + 1e3 * float(outside @ outside)

    scales = scales_of(sensors, log_gyro)
    here = cost(scales)
    for step in steps:
        for i in range(len(scales)):
            size = 2.0 * step if S <= i < 2 * S else step
            delta = size * np.eye(len(scales))[i]
            down, up = cost(scales - delta), cost(scales + delta)
            bend = down - 2.0 * here + up
            move = 0.5 * (down - up) / bend if bend > 1e-9 else float(np.sign(down - up)) * 2.0
            options = [(here, scales), (down, scales - delta), (up, scales + delta)]
            if abs(move) > _CLOSE:
                trial = scales + delta * float(np.clip(move, -2.0, 2.0))
                options.append((cost(trial), trial))
            here, scales = min(options, key=lambda o: o[0])
    sensors = tuple(
        replace(s, log_scale=float(scales[i]), log_slow=float(scales[S + i])) for i, s in enumerate(sensors)
    )
    return sensors, float(scales[-1])


@dataclass(frozen=True)
class Fit:
    """The polished registration.

    Attributes:
        sensors: With their final registration and gates.
        covariance: Of [R_imu_s (3, local), shift_s] for each sensor in turn, then the bias, (4 S + 3) square.
        bias_rps: Gyro bias in the middle of the data, shape (3,).
        rounds: Gauss-Newton rounds.
        stamp_rate: By how much the delay of each sensor grows with time, s/s, shape (S,). No part of the
            solution, where delays are constant: a value far from zero says that the stamps are wrong.
        stamp_rate_sigma: Its standard deviation, s/s, shape (S,).
        widened: By how much stretches of the data disagree beyond their sigmas, [mounting, shift] of each
            sensor; `covariance` is widened by it, shape (S, 2).
    """

    sensors: tuple[OrientationSensor, ...]
    covariance: FloatArray
    bias_rps: FloatArray
    rounds: int
    stamp_rate: FloatArray
    stamp_rate_sigma: FloatArray
    widened: FloatArray


def polish(
    make_curve: Callable[[FloatArray], RotationCurve],
    sensors: tuple[OrientationSensor, ...],
    bias_rps: FloatArray,
    options: TdIcpOptions,
) -> Fit:
    """Solve for all registrations together.

    Args:
        make_curve: Builds the curve for a gyro bias (a curve without bias ignores it).
        sensors: Streams with start values: shift within some 50 ms, mounting within some 10 degrees.
        bias_rps: Start of the bias, shape (3,).
        options: Noise of the gyro.

    Raises:
        numpy.linalg.LinAlgError: nothing left to fit.
    """
    bias = np.array(bias_rps, dtype=np.float64)
    log_gyro = 0.0
    curve = make_curve(bias)
    solution: DriftSolution | None = None
    rounds, done = 0, False
    while rounds < MOST_STEPS and not done:
        rounds += 1
        linear = linearise(curve, sensors, bias, options)
        sweeps = _SWEEPS[min(len(sensors) - 1, 1)].get(rounds, ())
        if sweeps:
            sensors, log_gyro = estimate_scales(linear, sensors, log_gyro, options.gyro_log_sigma, sweeps)
        solution = solve(scaled(linear, scales_of(sensors, log_gyro)))
        new_sensors, step = _update(linear, sensors, solution, rescale=rounds <= 2)
        same_gate = all(np.array_equal(a.used, b.used) for a, b in zip(sensors, new_sensors, strict=True))
        sensors = new_sensors
        bias = bias + solution.states[len(solution.states) // 2, BIAS]
        done = rounds > 5 and abs(step) < _SHIFT_DONE_S and same_gate
        if not done:
            curve = make_curve(bias)
    assert solution is not None
    S, scales = len(sensors), scales_of(sensors, log_gyro)
    widened = widening(scaled(linear, scales), linear.used, S)
    factor = np.concatenate([np.repeat(widened, (3, 1), axis=1).ravel(), np.ones(3)])
    wanted = [*range(4 * S), -3, -2, -1]  # without the gyro's matrix: mountings and shifts, then the bias
    covariance = solution.covariance[np.ix_(wanted, wanted)] * np.outer(factor, factor)
    return Fit(sensors, covariance, bias, rounds, *_stamp_rates(linear, S, scales), widened)


def _stamp_rates(linear: Linear, S: int, scales: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solve once more with delays that may grow with time: their rates and sigmas, each (S,)."""
    problem = linear.problem
    p = problem.J.shape[2]
    growing = problem.J[:, :, 3 : 4 * S : 4] * linear.middle_s[:, None, None]
    prior = np.zeros((p + S, p + S))
    prior[:p, :p] = problem.prior_information
    prior[p:, p:] = np.eye(S) / _STAMP_RATE_SIGMA**2
    wider = replace(problem, J=np.concatenate([problem.J, growing], axis=2), prior_information=prior)
    solution = solve(scaled(replace(linear, problem=wider), scales))
    return solution.x[p:], np.sqrt(np.diagonal(solution.covariance)[p : p + S])


def _update(
    linear: Linear, sensors: tuple[OrientationSensor, ...], solution: DriftSolution, *, rescale: bool
) -> tuple[tuple[OrientationSensor, ...], float]:
    """Apply a step, and gate every orientation again by its residual over its noise."""
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
        d2 = np.vecdot(local, np.linalg.solve(s.covariance, local[..., None])[..., 0])
        by_median = 0.5 * float(np.log(max(float(np.median(d2)), 1e-12) / MEDIAN_CHI2_3))
        by_median = max(by_median, s.least_log_scale)
        log_scale = by_median if rescale else s.log_scale
        largest = max(largest, abs(float(x[3])))
        # the gate may not close in on itself: it stays as wide as the median of all demands
        width = max(log_scale, by_median + np.log(0.8))
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
