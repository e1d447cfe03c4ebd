"""Images that wait for the filter, in the order of the imu's clock whatever each camera's delay is."""

from __future__ import annotations

from collections import deque

from vical_daemon.estimation.measurements import Frames, PointsFrame

_WAIT_S = 0.3  # for a camera that lags behind the others
_MOST = 2000  # images per camera; the oldest go first


class FrameQueue:
    """One queue per camera, merged by `stamp + time shift`.

    Args:
        cameras: Names.
    """

    def __init__(self, cameras: list[str]) -> None:
        self._queues: dict[str, deque[tuple[float, PointsFrame]]] = {
            name: deque(maxlen=_MOST) for name in cameras
        }

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))

    def push(self, t_cam_s: float, frame: PointsFrame) -> None:
        """Append an image; those of one camera whose stamps go backwards are dropped."""
        queue = self._queues[frame.camera]
        if not queue or t_cam_s > queue[-1][0]:
            queue.append((t_cam_s, frame))

    def pop(
        self, shifts_s: dict[str, float], newest_imu_s: float, *, flush: bool
    ) -> tuple[float, PointsFrame] | None:
        """Return the next image that inertial data bracket; None while there is none.

        Args:
            shifts_s: Present time shift of each camera.
            newest_imu_s: Time up to which inertial readings are complete.
            flush: No more data will come: do not wait for the other cameras.
        """
        heads = {name: q[0][0] + shifts_s[name] for name, q in self._queues.items() if q}
        if not heads:
            return None
        first = min(heads, key=lambda name: heads[name])
        if heads[first] > newest_imu_s:
            return None
        waits = len(heads) < len(self._queues) and newest_imu_s < heads[first] + _WAIT_S
        if waits and not flush:
            return None
        return self._queues[first].popleft()

    def take_all(self) -> Frames:
        """Empty the queues."""
        out = [item for q in self._queues.values() for item in q]
        for q in self._queues.values():
            q.clear()
        return sorted(out, key=lambda item: item[0])
