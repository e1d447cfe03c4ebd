"""Where images enter an estimator: repeated ones left out, gaps reported."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.measurements import PointsFrame

_REPORTED_S = 0.5  # shorter gaps are lost images, which every camera has and the device's status counts
_GAP_PERIODS = 4.0  # and than this many usual intervals: a slow camera has no gap at every image
_FOLLOW = 0.1  # by which the usual interval follows each new one


@dataclass(slots=True)
class _Stream:
    """One camera: its newest image that was taken, and its usual interval, s."""

    newest: PointsFrame
    newest_s: float
    usual_s: float = np.inf
    repeats: int = 0


@dataclass(slots=True)
class ImageIntake:
    """Looks at the images of all cameras in order.

    A camera or driver that hangs delivers its last image again under new stamps; measured points are never the
    same to the last bit by themselves. Such images are left out: what remains is a gap like any other.

    Attributes:
        repeated: Images left out because their points repeat those of the one before, bit by bit.
    """

    repeated: int = 0
    _streams: dict[str, _Stream] = field(default_factory=dict)
    _news: list[str] = field(default_factory=list)

    def takes(self, frame: PointsFrame, t_cam_s: float) -> bool:
        """Whether an image, stamped `t_cam_s`, is a new one."""
        stream = self._streams.get(frame.camera)
        if stream is None:
            self._streams[frame.camera] = _Stream(frame, t_cam_s)
            return True
        if _same(stream.newest, frame):
            self.repeated += 1
            stream.repeats += 1
            return False
        gap_s = t_cam_s - stream.newest_s
        if gap_s > max(_REPORTED_S, _GAP_PERIODS * stream.usual_s):
            what = "in which {} repeated one image" if stream.repeats else "without images from {}"
            self._news.append(f"{gap_s:.1f} s {what.format(frame.camera)}")
        elif gap_s > 0.0:
            seen = stream.usual_s
            stream.usual_s = gap_s if np.isinf(seen) else seen + _FOLLOW * (gap_s - seen)
        stream.newest, stream.newest_s, stream.repeats = frame, t_cam_s, 0
        return True

    def news(self) -> list[str]:
        """Gaps since the last call, in words."""
        news, self._news = self._news, []
        return news


def _same(a: PointsFrame, b: PointsFrame) -> bool:
    """Whether two images show the same points at the same places, to the last bit; empty ones do not count."""
    return len(a.ids) == len(b.ids) > 0 and bool(
        (a.ids == b.ids).all() and (np.asarray(a.uv_px) == np.asarray(b.uv_px)).all()
    )
