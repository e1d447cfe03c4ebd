"""The final polish of temporal calibration: all orientation sensors jointly against one rotation curve.

Shifts, mountings, worlds, gyro bias and the drift of the integrated gyro are one least-squares problem (see
`orientation_problem` and `drift_smoother`); pairs of closest points are not used any more. How large the
noises are is itself estimated (`orientation_noise`), so that the sigmas that come out are those the data
support.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import MEDIAN_CHI2_3
from vical_daemon.estimation.significance import PERHAPS_SIGMAS, chi_square_limit
from vical_daemon.estimation.temporal.drift_smoother import BIAS, DriftSolution, solve
from vical_daemon.estimation.temporal.orientation_noise import estimate_scales, scaled, scales_of
from vical_daemon.estimation.temporal.orientation_problem import (
    Linear,
    OrientationSensor,
    linearise,
)
from vical_daemon.estimation.temporal.rotation_curves import RotationCurve
from vical_daemon.estimation.temporal.stretch_agreement import widening
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions

__all__ = ["Fit", "OrientationSensor", "polish"]

_GATE = chi_square_limit(3, PERHAPS_SIGMAS)
_ROUNDS = 12
_SHIFT_DONE_S = 2e-8
# in which rounds the noises are estimated and with what steps, for one sensor and for several
_SWEEPS = ({3: (0.5, 0.25), 5: (0.2,)}, {3: (0.5,), 5: (0.3,)})
_STAMP_RATE_SIGMA = 0.1  # prior of the difference between the rates of two clocks


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
    while rounds < _ROUNDS and not done:
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
    covariance = _wanted(solution.covariance, S) * np.outer(factor, factor)
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
    linear: Linear,
    sensors: tuple[OrientationSensor, ...],
    solution: DriftSolution,
    *,
    rescale: bool,
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
        d2 = np.einsum("ki,ki->k", local, np.linalg.solve(s.covariance, local[..., None])[..., 0])
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


def _wanted(covariance: FloatArray, S: int) -> FloatArray:
    """Leave out the gyro's matrix: mountings and shifts, then the bias."""
    p = len(covariance) - 3
    keep = [*range(4 * S), *range(p, p + 3)]
    return covariance[np.ix_(keep, keep)]
