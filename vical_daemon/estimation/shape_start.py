"""A second start, with the target's shape among the unknowns, once it has turned out not to be as stated."""

from __future__ import annotations

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
        end_s = self.oldest_s + _BEGIN_S
        # in order of the imu's time: stamps of several cameras need not be
        n = next((i for i, (t_cam_s, _) in enumerate(self._kept) if t_cam_s >= end_s), len(self._kept))
        starting.take(self._kept[:n])
        found = starting.attempt(buffer, priors, may_be_partial=False)
        if found.filter is None:
            return None
        for t_cam_s, frame in [*found.frames, *self._kept[n:]]:
            self._step(found.filter, frame, t_cam_s)
        return found.filter
