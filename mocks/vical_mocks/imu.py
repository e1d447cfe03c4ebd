"""An inertial sensor's physics: true motion through the GX3's sampling chain, with biases and noise.

The chain: analog filters (a delay each; as in the device, the accelerometer's is 0.13 ms longer than the
gyro's), 30 taps at 30 kHz, M taps at 1 kHz, then decimation, which is the caller's. Noise is white at 1 kHz
*before* the M taps, as in the device: so its spectrum falls where the filter's does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_mocks.clock import SkewedClock

FloatArray = npt.NDArray[np.float64]
Motion = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Host seconds (n,) -> angular rate rad/s (n, 3) and specific force m/s^2 (n, 3), both in the imu frame."""

BASE_RATE_HZ = 1000
MAX_TAPS = 32
ADC_DELAY_S = 29.0 / 60.0 * 1e-3
GYRO_ANALOG_DELAY_S = 0.57e-3
ACCEL_ANALOG_DELAY_S = 0.70e-3
_BLOCK = 128
_CHUNK = 8
"""Blocks whose motion is computed at once, a second. With one at a time the emulated device took three times
as much of a core, and on a loaded computer all it sent was late, as it is from no device."""


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """Errors of the sensor, constant over a run but for the walks.

    Attributes:
        gyro_noise: White noise density, rad/s/sqrt(Hz).
        accel_noise: White noise density, m/s^2/sqrt(Hz).
        gyro_walk: Bias random walk, rad/s^2/sqrt(Hz).
        accel_walk: Bias random walk, m/s^3/sqrt(Hz).
        gyro_bias_rps: Bias at the start.
        accel_bias_mps2: Bias at the start.
    """

    gyro_noise: float = 0.0
    accel_noise: float = 0.0
    gyro_walk: float = 0.0
    accel_walk: float = 0.0
    gyro_bias_rps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accel_bias_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)


GX3_25_ERRORS = ImuErrors(
    gyro_noise=3.8e-4,
    accel_noise=1.2e-3,
    gyro_walk=2e-5,
    accel_walk=1e-4,
    gyro_bias_rps=(-0.0018, 0.0055, 0.0004),
    accel_bias_mps2=(0.015, -0.02, 0.01),
)
"""Noise and gyro bias as measured on a public capture of a GX3 at rest; the rest is typical."""


def at_rest(t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A level unit that does not move: z points down, so specific force is -g along z."""
    return np.zeros((len(t_s), 3)), np.tile([0.0, 0.0, -9.80665], (len(t_s), 1))


class ImuModel:
    """Samples of a GX3 at its base rate, as a pure function of the sample number.

    Args:
        motion: True motion; None for `at_rest`.
        clock: The device's clock: sample k is taken when it reads k / 1000 s.
        errors: Sensor errors.
        seed: Seed of the noise.
    """

    def __init__(
        self, motion: Motion | None, clock: SkewedClock, errors: ImuErrors | None = None, seed: int = 0
    ) -> None:
        self._motion = motion or at_rest
        self._clock = clock
        self._errors = errors or ImuErrors()
        self._seed = seed
        self._raw: dict[int, FloatArray] = {}
        self._chunk: tuple[int, FloatArray] | None = None  # number, true readings
        self._filtered: tuple[int, int, FloatArray] | None = None
        self._walk: list[FloatArray] = [np.zeros(6)]

    def sample(self, k: int, taps: int) -> tuple[FloatArray, FloatArray]:
        """Filtered gyro (rad/s) and specific force (m/s^2), shape (3,) each, of base sample `k`."""
        block = k // _BLOCK
        if self._filtered is None or self._filtered[:2] != (block, taps):
            self._filtered = (block, taps, self._filter(block, taps))
        row = self._filtered[2][k - block * _BLOCK]
        return row[:3], row[3:]

    def increments(self, k: int, count: int) -> tuple[FloatArray, FloatArray]:
        """Rotation vector (rad) and velocity change (m/s) over the `count` base samples up to `k`.

        Coning and sculling are contained: the rotation is composed sample by sample, and the velocity is
        expressed in the frame of the interval's start.
        """
        rows = np.concatenate([self._raw_row(i)[None] for i in range(k - count + 1, k + 1)])
        dt_s = 1.0 / BASE_RATE_HZ
        R_start_now = np.eye(3)
        velocity = np.zeros(3)
        for row in rows:
            half = R_start_now @ _rotation(0.5 * dt_s * row[:3])
            velocity += half @ row[3:] * dt_s
            R_start_now = half @ _rotation(0.5 * dt_s * row[:3])
        return _rotation_vector(R_start_now), velocity

    def _raw_row(self, k: int) -> FloatArray:
        block = k // _BLOCK
        return np.asarray(self._block(block)[k - block * _BLOCK], np.float64)

    def _filter(self, block: int, taps: int) -> FloatArray:
        rows = np.concatenate([self._block(block - 1)[-(MAX_TAPS - 1) :], self._block(block)])
        sums = np.cumsum(np.concatenate([np.zeros((1, 6)), rows]), axis=0)
        end = np.arange(_BLOCK) + MAX_TAPS
        mean: FloatArray = (sums[end] - sums[end - taps]) / taps
        return mean

    def _block(self, block: int) -> FloatArray:
        """Unfiltered base samples of one block, shape (_BLOCK, 6)."""
        if block not in self._raw:
            for old in [b for b in self._raw if abs(b - block) > 1 + 1000 // _BLOCK + 1]:
                del self._raw[old]
            self._raw[block] = self._true(block) + self._noise(block)
        return self._raw[block]

    def _true(self, block: int) -> FloatArray:
        number, place = divmod(block, _CHUNK)
        if self._chunk is None or self._chunk[0] != number:
            first = number * _CHUNK
            t_s = np.concatenate([self._instants_s(first + i) for i in range(_CHUNK)])
            gyro, _ = self._motion(t_s - GYRO_ANALOG_DELAY_S)
            _, force = self._motion(t_s - ACCEL_ANALOG_DELAY_S)
            self._chunk = number, np.hstack([gyro, force])
        return self._chunk[1][place * _BLOCK : (place + 1) * _BLOCK]

    def _instants_s(self, block: int) -> FloatArray:
        """When the base samples of a block are taken, host seconds, shape (_BLOCK,)."""
        # The clock is all but linear over a block: two exact instants and a line between them.
        first, last = (
            self._clock.host_s(n / BASE_RATE_HZ) for n in (block * _BLOCK, (block + 1) * _BLOCK - 1)
        )
        return np.linspace(first, last, _BLOCK) - ADC_DELAY_S

    def _noise(self, block: int) -> FloatArray:
        e = self._errors
        rng = np.random.default_rng([self._seed, block & 0xFFFFFFFF])
        sigma = np.sqrt(BASE_RATE_HZ) * np.repeat([e.gyro_noise, e.accel_noise], 3)
        bias = np.concatenate([e.gyro_bias_rps, e.accel_bias_mps2])
        noise: FloatArray = bias + self._walked(block) + sigma * rng.standard_normal((_BLOCK, 6))
        return noise

    def _walked(self, block: int) -> FloatArray:
        """Bias walk of a block: one step per block, so that any block can be asked for again."""
        e = self._errors
        step = np.sqrt(_BLOCK / BASE_RATE_HZ) * np.repeat([e.gyro_walk, e.accel_walk], 3)
        while len(self._walk) <= block:
            rng = np.random.default_rng([self._seed, 1, len(self._walk)])
            self._walk.append(self._walk[-1] + step * rng.standard_normal(6))
        walked: FloatArray = self._walk[max(block, 0)]
        return walked


def _rotation(v: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(v))
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-12:
        return np.asarray(np.eye(3) + K, np.float64)
    s, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    matrix: FloatArray = np.eye(3) + s * K + c * (K @ K)
    return matrix


def _rotation_vector(R: FloatArray) -> FloatArray:
    """Rotation vector of a rotation by less than pi."""
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, 0.5 * (np.trace(R) - 1.0))
    vector: FloatArray = axis * (angle / sine if sine > 1e-12 else 1.0)
    return vector
