"""Live images that are stamped on arrival get the stamps of their camera's even grid, as in recordings.

The arithmetic is that of `logs.even_images`, over the last images instead of all. A stamp is late by what the
images around it show, so an image waits for those that follow it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vical_daemon.calibrate.stamp_gate import REACH_S
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.logs.even_images import CameraStamps, ImagePoints
from vical_daemon.logs.even_stamps import EvenStamps

_WINDOW = 600
"""Images by which a stamp is judged: 30 s at 20 Hz, as far as `even_stamps.envelope` looks."""
_LOOK = 60
"""Images between two decisions, as many as a recording must have."""
_CERTAIN = 5.0
"""Standard errors for a decision: one chance in 3.5 million, as it is asked for every few seconds."""
_SURE = math.log(1000.0)
"""Log odds by which stamps are late, or late and early alike. The latter stay as they are: the filter allows
for jitter, and the mean of a few images is off by more than what it leaves."""
_LOOKS = 5
"""Decisions after which stamps that were not found to be taken on arrival probably are not."""
_WAIT_NS = 300_000_000
"""An image waits for those that follow within this time: one that is late by up to so much is then seen to
be late."""
_EVERY_NS = 500_000_000
"""Time between two fits of the grid; each takes 10 to 20 ms."""
_NO_IDS, _NO_POINTS = np.zeros(0, np.int64), np.zeros((0, 2))


class ArrivalStamps:
    """Stamps of the images of one camera: as they come, until they are found to be taken on arrival.

    Attributes:
        found: What was found; None: nothing, stamps pass as they come.
        in_doubt: They jitter about an even grid, and there were too few images yet for a decision.

    Args:
        known: Last images of this camera, without points, if its stamps were found to be taken on arrival
            before.
    """

    def __init__(self, known: Sequence[PointsFrame] = ()) -> None:
        self.in_doubt = False
        self._looks = 0
        self._window: deque[PointsFrame] = deque(known, maxlen=_WINDOW)
        self._log_odds = _SURE if known else None  # once decided; None: as each window of images has it
        self.found: EvenStamps | None = self._stamps().on_grid() if known else None
        self._unseen = 0  # images since the last decision
        self._held: deque[PointsFrame] = deque()
        self._fitted_ns = self._last_ns = 0
        self._original_ns: dict[int, int] = {}  # by new stamp

    def push(self, frame: PointsFrame) -> list[PointsFrame]:
        """Take an image; return those that may pass now."""
        passed: list[PointsFrame] = []
        back_ns = self._window[-1].t_cam_ns - frame.t_cam_ns if self._window else -1
        if 0 <= back_ns <= REACH_S * 1e9:  # out of order: of no use where delays are judged
            return [frame] if self.found is None else []
        if back_ns >= 0:  # the clock was set back
            passed = self.flush()
            self._window.clear()
            self._fitted_ns = self._last_ns = 0
        self._window.append(frame)
        if self.found is None:
            self._unseen += 1
            if self._unseen >= _LOOK:
                self._unseen = 0
                self._decide()
            return [*passed, frame]
        self._held.append(frame)
        now_ns = frame.t_cam_ns
        if now_ns - self._held[0].t_cam_ns < _WAIT_NS or now_ns - self._fitted_ns < _EVERY_NS:
            return passed
        self._fitted_ns = now_ns
        return passed + self._even(now_ns - _WAIT_NS)

    def flush(self) -> list[PointsFrame]:
        """Return, at the end of the data, the images that still wait."""
        return self._even(self._held[-1].t_cam_ns) if self._held else []

    def original_ns(self, t_ns: int) -> int:
        """Return the stamp that an image came with, ns; that of an image that did not pass: the same."""
        return self._original_ns.get(t_ns, t_ns)

    def known_ns(self) -> list[int]:
        """Return the last stamps as they came, ns, if they are taken on arrival; else nothing."""
        return [] if self.found is None else self._stamps().first_ns.tolist()

    def _stamps(self, until_ns: int | None = None) -> CameraStamps:
        t_ns = np.array([frame.t_cam_ns for frame in self._window], dtype=np.int64)
        marks = np.array([_mark(frame) for frame in self._window], dtype=np.int64)
        return CameraStamps(t_ns, marks, until_ns, self._log_odds)

    def _decide(self) -> None:
        stamps = self._stamps()
        wanted = stamps.wanted
        for frame in self._window if wanted else ():
            if frame.t_cam_ns in wanted and len(frame.ids):
                ids, first = np.unique(frame.ids, return_index=True)
                stamps.take(frame.t_cam_ns, ImagePoints(ids, np.asarray(frame.uv_px)[first]))
        even = stamps.even(_CERTAIN)
        if even is not None and even.log_odds > _SURE:
            self.found, self._log_odds = even, even.log_odds
        self._looks += bool(wanted)
        open_yet = bool(wanted) and stamps.log_odds > -_SURE
        self.in_doubt = open_yet and self.found is None and self._looks < _LOOKS

    def _even(self, until_ns: int) -> list[PointsFrame]:
        """Take the waiting images up to a stamp; return them with new stamps, if these increase."""
        stamps = self._stamps(until_ns)
        grid = stamps.on_grid()  # None: the stamps are even at present, or the rate has just changed
        new_ns = {} if grid is None else dict(zip(stamps.t_ns.tolist(), grid.t_ns.tolist(), strict=True))
        self.found = grid or self.found
        passed = []
        while self._held and self._held[0].t_cam_ns <= until_ns:
            frame = self._held.popleft()
            t_ns = new_ns.get(frame.t_cam_ns, frame.t_cam_ns)
            if t_ns > self._last_ns:
                self._last_ns = t_ns
                self._original_ns[t_ns] = frame.t_cam_ns
                passed.append(replace(frame, t_cam_ns=t_ns))
        while len(self._original_ns) > _WINDOW:
            del self._original_ns[next(iter(self._original_ns))]
        return passed


class LiveStamps:
    """The stamps of all cameras of a rig.

    Outlives the estimator: a new one gets the stamps that the last one had.

    Args:
        known_ns: What `known_ns` returned in an earlier process.
    """

    def __init__(self, known_ns: Mapping[str, Sequence[int]] | None = None) -> None:
        self._cameras = {
            name: ArrivalStamps([PointsFrame(name, t_ns, _NO_IDS, _NO_POINTS) for t_ns in stamps_ns])
            for name, stamps_ns in (known_ns or {}).items()
        }
        self._announced = {name for name, camera in self._cameras.items() if camera.found}

    def known_ns(self) -> dict[str, list[int]]:
        """Return the last stamps of the cameras that stamp on arrival, ns: another process may go on."""
        return {name: known for name, camera in self._cameras.items() if (known := camera.known_ns())}

    def push(self, frame: PointsFrame) -> list[PointsFrame]:
        """Take an image; return those that may pass now."""
        return self._cameras.setdefault(frame.camera, ArrivalStamps()).push(frame)

    def flush(self) -> list[PointsFrame]:
        """Return, at the end of the data, the images that still wait."""
        return [frame for camera in self._cameras.values() for frame in camera.flush()]

    def news(self) -> list[Event]:
        """Return what was found since the last call: the calibration up to now rests on other stamps."""
        new = {n: c.found for n, c in self._cameras.items() if c.found and n not in self._announced}
        self._announced |= set(new)
        return [Event(EventKind.STAMPED_ON_ARRIVAL, n, found.jitter_s) for n, found in new.items()]

    @property
    def in_doubt(self) -> bool:
        """Whether more images may show that a camera stamps on arrival."""
        return any(camera.in_doubt for camera in self._cameras.values())

    @property
    def sigma_s(self) -> float:
        """How well the earliest arrivals of all cameras are known, s; 0: stamps pass as they come."""
        return math.hypot(*(c.found.sigma_s for c in self._cameras.values() if c.found), 0.0)

    def as_they_came(self, reports: Sequence[Any]) -> Sequence[Any]:
        """Return reports on images with the stamps that these came with."""
        if not self.sigma_s:
            return reports
        return [replace(r, t_ns=self._cameras[r.camera].original_ns(r.t_ns)) for r in reports]


def _mark(frame: PointsFrame) -> int:
    """A number that two images share if they show the same points at the same places."""
    return hash(np.asarray(frame.uv_px).tobytes()) if len(frame.ids) else frame.t_cam_ns
