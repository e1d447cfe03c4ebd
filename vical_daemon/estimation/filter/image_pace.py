"""Thins images of slow motion: with all of them, noise of the gyro would pass for motion.

A time shift shows in how the rate changes from one image to the next, a lever arm in how the rig turns. Both
are taken from the gyro, with its noise. Squared, this noise counts as information: with 60 images a second at
12 deg/s, the sigma of the time shift is a quarter of the Cramer-Rao bound, and the estimate hardly moves. The
bound is the same for 20 images a second. [docs/math/filter.md, "Images of slow motion"]
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.stamp_steps import LEARN
from vical_daemon.estimation.inertial.white_noise import measured_gyro_density
from vical_daemon.estimation.measurements import ImuNoise
from vical_daemon.estimation.model.rates import RATE_BLOCK_S
from vical_daemon.estimation.significance import EVERY_S

_TIMES = 2.0
"""Change of the rate from one image to the next, over its noise. At 2 the noise adds a quarter to the
information, so that sigmas are 11 % too small."""
_LONGEST_S = 0.1  # between images: with fewer than ten a second other weaknesses of slow cameras show


class ImagePace:
    """Chooses the images that are used, by how fast the rate changes.

    Args:
        noise: Densities as configured.
    """

    def __init__(self, noise: ImuNoise) -> None:
        self._noise = noise
        self._interval_s, self._next_look_s = 0.0, -np.inf
        self._thinning: dict[str, Thinning] = {}

    def takes(
        self, camera: str, t_cam_s: float, rate_change_rps2: float | None, buffer: ImuBuffer | None
    ) -> bool:
        """Whether to use the next image of a camera.

        Args:
            camera: Its name.
            t_cam_s: Stamp, s.
            rate_change_rps2: See `RunningMotion`, rad/s^2; None: not known yet.
            buffer: Inertial readings; None: there are none yet.
        """
        now_s = -np.inf if buffer is None else buffer.newest_s
        if buffer is not None and rate_change_rps2 is not None and now_s >= self._next_look_s:
            self._next_look_s = now_s + EVERY_S
            self._interval_s = interval_s(self._noise, rate_change_rps2, buffer)
        return self._thinning.setdefault(camera, Thinning()).takes(t_cam_s, self._interval_s)


def interval_s(noise: ImuNoise, rate_change_rps2: float, buffer: ImuBuffer) -> float:
    """Interval between images in which the rate changes by `_TIMES` its noise, s.

    Args:
        noise: Densities as configured.
        rate_change_rps2: RMS change of the mean rate from one `RATE_BLOCK_S` to the next, over it, rad/s^2.
        buffer: Inertial readings.
    """
    rows = buffer.rows
    if len(rows) < 2:
        return 0.0
    density = measured_gyro_density(noise, rows) ** 2
    reading_s = float(rows[-1, 0] - rows[0, 0]) / (len(rows) - 1)
    # less the noise of two means, three axes
    change = rate_change_rps2**2 - 6.0 * density / RATE_BLOCK_S**3
    # of two rates, three axes; a cubic between readings has two thirds of their variance on average
    noise_rps = math.sqrt(4.0 * density / reading_s)
    return _LONGEST_S if change <= 0.0 else min(_TIMES * noise_rps / math.sqrt(change), _LONGEST_S)


class Thinning:
    """Takes every n-th image, n by the camera's rate.

    Images are counted. To leave out an image because its stamp comes too soon after the last would be to
    choose by the stamp's error: with 1 ms of jitter, images stamped early went and images stamped late
    stayed, which bent the time shift by 0.1 ms.
    """

    def __init__(self) -> None:
        self._intervals_s: deque[float] = deque(maxlen=LEARN)  # their median is the usual one
        self._before_s: float | None = None
        self._left_out = 0

    def takes(self, t_s: float, least_s: float) -> bool:
        """Whether to use the next image.

        Args:
            t_s: Its stamp, s, any origin, increasing.
            least_s: Least interval between the images that are used, s.
        """
        if self._before_s is not None:
            self._intervals_s.append(t_s - self._before_s)
        self._before_s = t_s
        self._left_out += 1
        if self._left_out < self._every(least_s):
            return False
        self._left_out = 0
        return True

    def _every(self, least_s: float) -> int:
        if not self._intervals_s:
            return 1
        intervals_s = sorted(self._intervals_s)
        last = len(intervals_s) - 1
        median_s = 0.5 * (intervals_s[last // 2] + intervals_s[(last + 1) // 2])
        return max(1, math.ceil(least_s / median_s - 1e-6)) if median_s > 0.0 else 1
