"""The attitude filter of the emulated MIP models: its states in time, and its data fields (set 0x82).

The attitude is that of gravity and magnetic field at each instant; no noise of its own, no bias estimate.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from vical_mocks.gx3_state import G_MPS2, Gx3State
from vical_mocks.mip_models import Model
from vical_mocks.mip_settings import AIDING, AUTO_INIT, MAGNETOMETER, SettingStore

INIT, RUN = 1, 2
"""Filter states of all models; what RUN is called: solution valid (5-series), vertical gyro (7-series)."""
AHRS = 3
"""7-series: the heading is known as well. 5-series: solution error, which is never reached here."""
INIT_S = 3.0
"""Time in INIT after a reset. The vendor's 5-series examples wait to see INIT in a stream of 1 Hz, so a real
device stays there for longer than a second."""
_PORTABLE = 1
"""Dynamics mode."""


class AttitudeFilter:
    """The filter of one device.

    Args:
        state: The device.
        settings: Those that it obeys: whether it initialises itself, and by which aids.
        model: Knows which of them it has.
    """

    def __init__(self, state: Gx3State, settings: SettingStore, model: Model) -> None:
        self._device, self._settings = state, settings
        self._waits = AUTO_INIT[1] in model.filter_commands
        self._aided = AIDING[1] in model.filter_commands
        self.reset()

    def reset(self) -> None:
        """Begin again with the initialisation."""
        self._begin_k: int | None = None
        self._told = False

    def run(self) -> None:
        """It was given an attitude, or a command to begin."""
        self._told = True

    def state(self, k: int) -> int:
        """Return the filter's state at base sample `k` (1 ms each)."""
        if self._begin_k is None or k < self._begin_k:
            self._begin_k = k
        elapsed_s = (k - self._begin_k) / 1000.0
        may_run = self._told or not self._waits or self._settings.get(AUTO_INIT) == b"\x01"
        if not may_run or elapsed_s < INIT_S:
            return INIT
        has_heading = self._aided and self._settings.get(AIDING, MAGNETOMETER) == b"\x01"
        return AHRS if has_heading and elapsed_s >= 2 * INIT_S else RUN

    def euler(self, k: int) -> tuple[float, float, float]:
        """Return roll, pitch, yaw, rad, of the sensor in north, east, down."""
        M = self._device.matrix(k)
        roll, yaw = math.atan2(M[1, 2], M[2, 2]), math.atan2(M[0, 1], M[0, 0])
        return roll, math.asin(min(1.0, max(-1.0, -float(M[0, 2])))), yaw

    def field(self, descriptor: int, k: int) -> bytes:
        """Return the data of one field; the valid flag at its end says whether the filter runs."""
        state = self.state(k)
        if descriptor == 0x10:
            return struct.pack(">HHH", state, _PORTABLE, 0)
        if descriptor == 0x11:
            return struct.pack(">dHH", k / 1000.0, 0, 0)
        values = [float(v) for v in self._vectors()[descriptor](k)]  # type: ignore[attr-defined]
        return struct.pack(f">{len(values)}fH", *values, int(state != INIT))

    def _vectors(self) -> dict[int, Callable[[int], object]]:
        s = self._device
        return {
            0x04: lambda k: s.matrix(k).ravel(),
            0x05: self.euler,
            0x06: lambda _: (0.0, 0.0, 0.0),  # gyro bias
            0x0A: lambda _: (0.01, 0.01, 0.05),  # sigma of the angles, rad
            0x0B: lambda _: (1e-3, 1e-3, 1e-3),  # sigma of the gyro bias, rad/s
            0x0D: lambda k: G_MPS2 * (s.accel_g(k) + s.matrix(k)[:, 2]),  # without gravity
            0x0E: s.gyro_rps,
            0x13: lambda k: G_MPS2 * s.matrix(k)[:, 2],
            0x1C: lambda k: G_MPS2 * s.accel_g(k),
        }
