"""The held-back check: now and then a copy of the filter predicts an image by the IMU alone.

The filter is tested on an image it has not used, some tenths of a second ahead. A calibration that only
explains its own data fails here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import FloatArray, MeasuredNoise, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.robust import median

_AHEAD_S = 0.3  # of a prediction: noise of the readings then exceeds that of the corners
HELD_BACK_EVERY_S = 5.0 * _AHEAD_S  # between two predictions, so that they share nothing
_ENOUGH = 20  # predictions before the imu's noise is judged by them
_WORSE, _BETTER = 1.5, 0.55  # mean squared error over its prediction: 4 standard deviations of chance
_CLIP = 10.0  # that one prediction counts


@dataclass(slots=True)
class HoldoutCheck:
    """Takes a copy of the filter every 1.5 s and asks it 0.3 s later what it would have expected."""

    _copy: CalibrationFilter | None = None
    _earlier: CalibrationFilter | None = None
    _next_s: float = float("-inf")

    def follow(
        self,
        f: CalibrationFilter,
        report: FrameReport,
        frame: PointsFrame,
        t_cam_s: float,
        target: FloatArray,
        buffer: ImuBuffer,
    ) -> float | None:
        """Look at one image after the filter has used it.

        Args:
            f: The filter.
            report: Its verdict on the image.
            frame: The image.
            t_cam_s: Its stamp, s.
            target: Points of the target, m, shape (n, 3).
            buffer: Inertial readings.

        Returns:
            Mean squared error of the prediction over its predicted variance, when one was due; else None.
        """
        if self._copy is None:
            if f.state.t_s >= self._next_s:
                self._copy = self._earlier = f.copy(self._earlier)
            return None
        held = self._copy
        t_s = t_cam_s + held.state.cameras[frame.camera].timeshift_s
        if t_s < held.state.t_s + _AHEAD_S or len(frame.ids) < 8:
            return None
        self._copy, self._next_s = None, t_s + HELD_BACK_EVERY_S
        segment = buffer.segment(held.state.t_s, t_s)
        if segment is None or segment.clipping_sigma is not None or t_s > held.state.t_s + 2.0 * _AHEAD_S:
            return None
        held.predict(segment)
        image = held.image(frame, t_cam_s, target[frame.ids])
        if report.used:  # then the noise of its corners is known
            own = report.sigma_px / median(image.sigma_px)
            image = replace(image, sigma_px=own * image.sigma_px)
        return held.prediction_nis(image)


def imu_noise_error(ratios: Sequence[float], f: CalibrationFilter, camera: str) -> float | None:
    """What held-back predictions say about the imu's noise densities; None: they agree.

    Args:
        ratios: What `HoldoutCheck.follow` returned lately.
        f: The filter. Where errors of its images last, predictions may be off by these, too: on EuRoC by 1.6
            times. White noise that the readings show is then not in doubt.
        camera: Which showed the last of them.

    Returns:
        Errors of the predictions over the expected ones (1: as expected), where they differ.
    """
    known, lasting = isinstance(f.imu_noise, MeasuredNoise), f.consistency[camera].factor > 1.0
    if len(ratios) < _ENOUGH or (known and lasting):
        return None
    mean = float(np.mean(np.minimum(ratios, _CLIP)))
    if _BETTER <= mean <= _WORSE:
        return None
    return float(np.sqrt(mean))
