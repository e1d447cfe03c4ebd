"""The held-back check: now and then a copy of the filter predicts an image by the IMU alone.

What the filter learnt from its images is tested on one it has not used, some tenths of a second ahead: a
calibration that only explains its own data fails here.
"""

from __future__ import annotations

from dataclasses import dataclass

from vical_daemon.estimation.calibration_filter import CalibrationFilter
from vical_daemon.estimation.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import FloatArray, PointsFrame

_EVERY_S = 1.5
_AHEAD_S = 0.3


@dataclass(slots=True)
class HeldBack:
    """Takes a copy of the filter every 1.5 s and asks it 0.3 s later what it would have expected."""

    _copy: CalibrationFilter | None = None
    _next_s: float = float("-inf")

    def follow(
        self, f: CalibrationFilter, frame: PointsFrame, t_cam_s: float, target: FloatArray, buffer: ImuBuffer
    ) -> float | None:
        """Look at one image after the filter has used it.

        Returns:
            Mean squared error of the prediction over its predicted variance, when one was due; else None.
        """
        if self._copy is None:
            if f.state.t_s >= self._next_s:
                self._copy = f.copy()
            return None
        held = self._copy
        t_s = t_cam_s + held.state.cameras[frame.camera].timeshift_s
        if t_s < held.state.t_s + _AHEAD_S or len(frame.ids) < 8:
            return None
        self._copy, self._next_s = None, t_s + _EVERY_S
        segment = buffer.segment(held.state.t_s, t_s)
        if segment is None or t_s > held.state.t_s + 2.0 * _AHEAD_S:
            return None
        held.predict(segment)
        return held.surprise(held.image(frame, t_cam_s, target[frame.ids]))
