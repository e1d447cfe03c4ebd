"""Smooth vector functions of time with exact first and second derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import make_interp_spline

from vical_mocks.rotations import FloatArray


class Curve(Protocol):
    """A 3-vector as a function of time."""

    def evaluate(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return value, first and second time derivative at `t_s`, each of shape (*t_s.shape, 3)."""
        ...


class Sinusoids:
    """Offset plus slope plus a sum of sinusoids, valid for all times.

    Args:
        offset: Constant part, shape (3,).
        slope: Growth per second, shape (3,); zeros for a bounded curve.
        amplitude: Amplitudes, shape (k, 3).
        frequency_hz: Frequencies, shape (k, 3).
        phase_rad: Phases, shape (k, 3).
    """

    def __init__(
        self,
        offset: FloatArray,
        amplitude: FloatArray | None = None,
        frequency_hz: FloatArray | None = None,
        phase_rad: FloatArray | None = None,
        slope: FloatArray | None = None,
    ) -> None:
        self.offset = np.asarray(offset, dtype=np.float64)
        self.slope = np.zeros(3) if slope is None else np.asarray(slope, dtype=np.float64)
        self.amplitude = np.zeros((0, 3)) if amplitude is None else np.asarray(amplitude, dtype=np.float64)
        shape = self.amplitude.shape
        self.frequency_hz = np.zeros(shape) if frequency_hz is None else np.asarray(frequency_hz)
        self.phase_rad = np.zeros(shape) if phase_rad is None else np.asarray(phase_rad)

    def evaluate(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Curve.evaluate`."""
        t = np.asarray(t_s, dtype=np.float64)[..., None]
        value = self.offset + self.slope * t
        first = np.broadcast_to(self.slope, value.shape).copy()
        second = np.zeros_like(value)
        for amplitude, frequency_hz, phase in zip(
            self.amplitude, self.frequency_hz, self.phase_rad, strict=True
        ):
            w = 2 * np.pi * frequency_hz
            s, c = np.sin(w * t + phase), np.cos(w * t + phase)
            value += amplitude * s
            first += amplitude * w * c
            second -= amplitude * w * w * s
        return value, first, second


class PeriodicSpline:
    """Quintic spline through given knots, repeated for ever; acceleration and jerk are continuous.

    Args:
        knots: Values at equal time steps, shape (n, 3), n >= 6; the curve closes after n steps.
        step_s: Time between knots, s.
    """

    def __init__(self, knots: FloatArray, step_s: float) -> None:
        closed = np.vstack([knots, knots[:1]])
        self.period_s = step_s * len(knots)
        self._spline = make_interp_spline(np.arange(len(closed)) * step_s, closed, k=5, bc_type="periodic")
        self._first, self._second = self._spline.derivative(1), self._spline.derivative(2)

    def evaluate(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Curve.evaluate`."""
        t = np.mod(np.asarray(t_s, dtype=np.float64), self.period_s)
        return np.asarray(self._spline(t)), np.asarray(self._first(t)), np.asarray(self._second(t))


@dataclass(frozen=True)
class Pause:
    """A stretch of standing still: motion slows down to nothing at `start_s` and resumes after `end_s`."""

    start_s: float
    end_s: float


class Paused:
    """Another curve run through a clock that stops during pauses (smoothly: acceleration stays continuous).

    Args:
        curve: What to run.
        pauses: Times of rest, not overlapping (ramps included), any order.
        ramp_s: How long slowing down and starting again take, s.
    """

    def __init__(self, curve: Curve, pauses: Sequence[Pause], ramp_s: float = 0.5) -> None:
        self._curve, self._pauses, self._ramp_s = curve, tuple(pauses), ramp_s

    def evaluate(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Curve.evaluate`."""
        t = np.asarray(t_s, dtype=np.float64)
        clock, rate, rate_slope = t.copy(), np.ones_like(t), np.zeros_like(t)
        for pause in self._pauses:
            for start_s, sign in ((pause.start_s - self._ramp_s, 1.0), (pause.end_s, -1.0)):
                x = np.clip((t - start_s) / self._ramp_s, 0.0, 1.0)
                # smoothstep 3x^2-2x^3 takes the rate away (or gives it back); clock loses its integral
                clock -= sign * (self._ramp_s * (x**3 - x**4 / 2) + np.maximum(t - start_s - self._ramp_s, 0))
                rate -= sign * (3 * x**2 - 2 * x**3)
                rate_slope -= sign * (6 * x - 6 * x**2) / self._ramp_s
        value, first, second = self._curve.evaluate(clock)
        r = rate[..., None]
        return value, first * r, second * r * r + first * rate_slope[..., None]
