"""A second start, with the target's shape among the unknowns, once it has turned out not to be as stated."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from vical_daemon.estimation.calibration_filter import CalibrationFilter
from vical_daemon.estimation.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import CameraPrior, PointsFrame
from vical_daemon.estimation.rehearsal import Frames, Step
from vical_daemon.estimation.starting import Starting

_MOST = 1200  # images kept; of too many the older half goes
_BEGIN_S = 6.0  # of them a start is made of; the others are filtered once


class ShapeStart:
    """Keeps the images since the first start, so that nothing they tell is lost.

    Args:
        step: Propagates a filter to an image and corrects it.
    """

    def __init__(self, step: Step) -> None:
        self._step = step
        self._kept: Frames = []

    def take(self, t_cam_s: float, frame: PointsFrame) -> None:
        """Keep an image."""
        self._kept.append((t_cam_s, frame))
        if len(self._kept) > _MOST:
            del self._kept[: len(self._kept) // 2]

    def forget(self) -> None:
        """Drop what was kept."""
        self._kept.clear()

    @property
    def oldest_s(self) -> float:
        """Stamp of the oldest image kept, s; infinite when there is none."""
        return self._kept[0][0] if self._kept else np.inf

    def attempt(
        self, starting: Starting, buffer: ImuBuffer, priors: dict[str, CameraPrior]
    ) -> CalibrationFilter | None:
        """Start anew and filter everything kept.

        Args:
            starting: Empty, with the shape in its layout.
            buffer: Inertial readings.
            priors: By camera.

        Returns:
            A filter at the last image, or None where there is no start.
        """
        begin_s = self.oldest_s
        starting.take([item for item in self._kept if item[0] < begin_s + _BEGIN_S])
        found = starting.attempt(buffer, priors, may_be_partial=False)
        if found.filter is None:
            return None
        last = bisect_right(self._kept, found.frames[-1][0], key=lambda item: item[0])
        for t_cam_s, frame in [*found.frames, *self._kept[last:]]:
            self._step(found.filter, frame, t_cam_s)
        return found.filter
