"""What orientations are registered with: a gyro, or another stream of orientations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve, OrientationCurve, RotationCurve
from vical_daemon.estimation.temporal.rotation_start import Start, coarse_start


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


Reference = GyroReference | StreamReference
