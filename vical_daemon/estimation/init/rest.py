"""Whether the board stands still in a camera's images: a rig at rest has nothing to start from."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import LEAST_POINTS, PointsFrame

MOVED_PX = 1.0  # at 500 px of focal length 0.1 deg, a tenth of the rotation that a start must know
_REST_S = 1.0  # so long without moving that far is rest: slower than any rotation that shows a time shift


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
