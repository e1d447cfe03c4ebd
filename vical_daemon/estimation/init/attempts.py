"""When to try to start: at once when there are enough data, then less and less often, and not at rest."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import LEAST_POINTS, PointsFrame
from vical_daemon.estimation.temporal.td_icp_refusals import ONLY_IMU_TURNS, turns_clearly

LONG_S = 8.0  # of data: much for a start; more of them would not make it better
_GROWTH, _MOST_S = 1.25, 4.0  # each pause over the one before; the longest
MOVED_PX = 1.0  # at 500 px of focal length 0.1 deg, a tenth of the rotation that a start must know
_REST_S = 1.0  # so long without moving that far is rest: slower than any rotation that shows a time shift


class Attempts:
    """Schedule of the attempts to start, with a target or without.

    Args:
        first_s: Pause after the first attempt, s.
    """

    def __init__(self, first_s: float) -> None:
        self._first_s = first_s
        self.anew()

    def anew(self) -> None:
        """Try at once, and often again."""
        self._next_s, self._pause_s, self.count = -np.inf, self._first_s, 0

    def due(self, t_s: float) -> bool:
        """Whether it is time for the next one, by the newest data (s)."""
        return t_s >= self._next_s

    def tried(self, t_s: float) -> None:
        """Note an attempt; `count` is the number of them since `anew`."""
        self._next_s = t_s + self._pause_s
        self._pause_s = min(_GROWTH * self._pause_s, _MOST_S)
        self.count += 1


class RestDetector:
    """Follows one camera: since when its images show no motion."""

    def __init__(self) -> None:
        self._since: tuple[float, PointsFrame] | None = None
        self._newest_s = -np.inf

    def take(self, t_cam_s: float, frame: PointsFrame) -> None:
        """Compare an image (stamp in the camera's clock, s) with the one since which nothing moved."""
        self._newest_s = t_cam_s
        if self._since is None or _moved_px(self._since[1], frame) > MOVED_PX:
            self._since = (t_cam_s, frame)

    @property
    def seen(self) -> bool:
        """Whether there was an image at all."""
        return self._since is not None

    @property
    def rests(self) -> bool:
        """Whether the images show no motion by now."""
        return self._since is not None and bool(self._newest_s - self._since[0] > _REST_S)

    def rests_since(self, t_cam_s: float) -> bool:
        """Whether the images show no motion since a stamp, s."""
        return self.rests and self._since is not None and self._since[0] <= t_cam_s


def rest_in_words(buffer: ImuBuffer, advice: str) -> str:
    """What images without motion mean, with the readings meanwhile; `advice`: how to move."""
    meanwhile = buffer.rows[buffer.rows[:, 0] > buffer.newest_s - _REST_S]
    if len(meanwhile) > 1 and turns_clearly(meanwhile[:, 0], meanwhile[:, 1:4]):
        return ONLY_IMU_TURNS
    return f"the rig is at rest: {advice}"


def _moved_px(before: PointsFrame, after: PointsFrame) -> float:
    """RMS of the affine motion of the corners that both images show, px; infinite where they are too few.

    The affine part, and not the corners themselves: their noise averages out.
    """
    _, k_before, k_after = np.intersect1d(before.ids, after.ids, return_indices=True)
    if len(k_before) < LEAST_POINTS:
        return np.inf
    uv_px = before.uv_px[k_before]
    basis = np.linalg.qr(np.column_stack([uv_px - uv_px.mean(axis=0), np.ones(len(uv_px))]))[0]
    motion = basis @ (basis.T @ (after.uv_px[k_after] - uv_px))
    return float(np.sqrt((motion**2).sum(axis=1).mean()))
