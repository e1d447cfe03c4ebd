"""How large the noises of an orientation problem are: restricted maximum likelihood of their scales."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.temporal.drift_smoother import DriftProblem
from vical_daemon.estimation.temporal.drift_smoother import cost as drift_cost
from vical_daemon.estimation.temporal.orientation_problem import Linear, OrientationSensor

_MOST_SLOW = 4.0  # logarithm of a slow error over the noise; as far below
_CLOSE = 0.1  # a minimum this close, in steps, is reached


def scaled(linear: Linear, scales: FloatArray) -> DriftProblem:
    """The problem for given noises: logs of [noise of each sensor, slow error of each, gyro drift]."""
    S = len(linear.slow)
    sensor_scale, slow_scale = np.exp(2.0 * scales[:S]), np.exp(2.0 * (scales[:S] + scales[S : 2 * S]))
    drift = linear.drift * np.exp(2.0 * scales[2 * S])
    Q_inverse = np.zeros_like(linear.problem.Q_inverse)
    Q_inverse[:, [3, 4, 5], [3, 4, 5]] = 1.0 / linear.walk[:, None]
    log_determinant = 3.0 * float(np.log(linear.walk).sum())
    if S == 1:  # the slow error joins the drift
        Q = drift[:, None, None] * np.eye(3) + slow_scale[0] * linear.slow[0]
        Q_inverse[:, :3, :3] = np.linalg.inv(Q)
        log_determinant += float(np.log(np.linalg.det(Q)).sum())
    else:
        Q_inverse[:, [0, 1, 2], [0, 1, 2]] = 1.0 / drift[:, None]
        log_determinant += 3.0 * float(np.log(drift).sum())
        for i in range(S):
            part = slice(6 + 3 * i, 9 + 3 * i)
            Q_inverse[:, part, part] = linear.slow_inverse[i] / slow_scale[i]
            steps = len(linear.drift)
            log_determinant += float(linear.slow_log_determinant[i] + 3.0 * steps * np.log(slow_scale[i]))
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
