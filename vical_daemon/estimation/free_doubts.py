"""What a target-free calibration asks beside: do clocks drift, is the imu off, does the shutter roll?"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation import hypotheses
from vical_daemon.estimation.beyond_doubt import KNOWN_OFF_SIGMA, imu_told
from vical_daemon.estimation.clock_drift import (
    CLOCKS_APART,
    CLOCKS_IN_DOUBT,
    SURE,
    drift_told,
    evidence,
    probability,
)
from vical_daemon.estimation.free_carry import DRIFT, IMU, READOUT, Carry
from vical_daemon.estimation.free_snapshot import Doubts

_SURELY_ROLLING = 5.0  # sigmas
_SHORTEST_S = 1e-3  # of a readout that is worth a word


def rolling_told(camera: str, readout_s: float, sigma_s: float) -> str:
    """The announcement of a rolling shutter of which nothing was said."""
    told = f"{1e3 * readout_s:.1f} +- {1e3 * sigma_s:.1f} ms"
    return f"{camera}: a rolling shutter, by how features move: its readout takes {told}, and is allowed for"


class FreeDoubts:
    """Follows what the windows say about clocks and imu.

    Args:
        camera: Name of the camera.
        imu_asked: The imu's matrices are asked for: they are estimated whatever the evidence.
        rolling: The shutter is said to be a rolling one, or its readout is asked for.

    Attributes:
        drifting: The camera's clock is known to run apart from the imu's.
        imu_sigma: Prior of the entries of the imu's matrices.
        rolling: The shutter is known to be a rolling one.
    """

    def __init__(self, camera: str, *, imu_asked: bool, rolling: bool) -> None:
        self._camera = camera
        self.imu_asked = self._imu_off = imu_asked
        self.imu_sigma = KNOWN_OFF_SIGMA if imu_asked else hypotheses.ENTRY_SIGMA
        self.drifting = False
        self.rolling = rolling

    def watch(self, carry: Carry, factor: float, compared: bool) -> list[str]:
        """Announce what has got beyond doubt.

        Args:
            carry: What is known.
            factor: Measured variance over the stated one.
            compared: Windows could be compared; before, what looks like the imu may as well be the images.
        """
        events = []
        if not self.drifting and probability(self._drift(carry, factor)) >= SURE:
            self.drifting = True
            sigma = float(np.sqrt(carry.calibration()[DRIFT, DRIFT]))
            events.append(drift_told(self._camera, CLOCKS_APART, carry.camera.skew, sigma))
        if not self._imu_off and compared and hypotheses.is_sure(self._imu(carry, factor)):
            self._imu_off = True
            sigmas = np.sqrt(factor * np.diag(carry.calibration())[IMU])
            events.append(imu_told(carry.imu, sigmas))
        if not self.rolling:
            sigma_s = float(np.sqrt(factor * carry.calibration()[READOUT, READOUT]))
            self.rolling = abs(carry.camera.readout_s) > max(_SURELY_ROLLING * sigma_s, _SHORTEST_S)
            if self.rolling:
                events.append(rolling_told(self._camera, carry.camera.readout_s, sigma_s))
        return events

    def reason(self, carry: Carry, factor: float) -> str:
        """What may not be as it is taken to be, in words; empty where nothing speaks for it."""
        if not self._imu_off and self._imu(carry, factor) > 0.0:
            return hypotheses.IN_DOUBT[hypotheses.IMU]
        if not self.drifting and self._drift(carry, factor) > 1.0:
            return CLOCKS_IN_DOUBT
        return ""

    def weighed(self, carry: Carry, factor: float, compared: bool) -> Doubts:
        """How likely each is, for what is told; arguments as for `watch`."""
        off = 1.0
        if not self._imu_off:
            off = hypotheses.probability(self._imu(carry, factor))
            off = off if compared else min(off, 0.5)
        return Doubts(factor, self.drifting, off, gyro_frame=not self.imu_asked, rolling=self.rolling)

    @staticmethod
    def _drift(carry: Carry, factor: float) -> float:
        """How much more likely a drift of the clocks is than none (Bayes factor); 0: not estimated."""
        if not carry.active[DRIFT]:
            return 0.0
        return evidence(carry.camera.skew, factor * float(carry.calibration()[DRIFT, DRIFT]))

    @staticmethod
    def _imu(carry: Carry, factor: float) -> float:
        """By how much an imu that is off is likelier (logarithm of Bayes' factor).

        Where windows disagree although the entries are free, it is the images, and what they say about the
        imu is worth less by as much again.
        """
        sigma = hypotheses.ENTRY_SIGMA
        return hypotheses.log_bayes_factor(
            carry.imu / sigma, carry.calibration()[IMU, IMU] / sigma**2, factor**2
        )
