"""How large the noises of an orientation problem are: restricted maximum likelihood of their scales."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.drift_smoother import DriftProblem, solve
from vical_daemon.estimation.orientation_problem import DriftNoise, Linear, OrientationSensor

FloatArray = npt.NDArray[np.float64]

_SLOW_LIMITS = (-4.0, 4.0)


def scaled(linear: Linear, scales: FloatArray) -> DriftProblem:
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


def scales_of(sensors: tuple[OrientationSensor, ...], log_gyro: float) -> FloatArray:
    """Logs of the noises' scales in the order that `scaled` expects, shape (2 S + 1,)."""
    return np.array([*(s.log_scale for s in sensors), *(s.log_slow for s in sensors), log_gyro])


def estimate_scales(
    linear: Linear,
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
        solution = solve(scaled(linear, values))
        likelihood = solution.quadratic + solution.log_determinant + 6.0 * float(counts @ values[:S])
        outside = np.maximum(np.abs(values[S : 2 * S]) - _SLOW_LIMITS[1], 0.0)
        return likelihood + float(values[-1] / noise.log_sigma) ** 2 + 1e3 * float(outside @ outside)

    scales = scales_of(sensors, log_gyro)
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
