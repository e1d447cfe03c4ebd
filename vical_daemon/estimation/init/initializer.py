"""The first seconds: images are kept, and starts are tried from them, less and less often, never at rest."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from vical_daemon.estimation.events import ROLLING, Event, EventKind
from vical_daemon.estimation.filter.linearised_filter import LinearisedFilter
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.white_noise import measured_noise
from vical_daemon.estimation.init import closed_form as start
from vical_daemon.estimation.init.accelerometer_check import mistaken_axes
from vical_daemon.estimation.init.attempts import LONG_S, Attempts, RestDetector, rest_in_words
from vical_daemon.estimation.init.board_window import LATE_S
from vical_daemon.estimation.init.camera_start import starting_camera
from vical_daemon.estimation.init.initial_filter import initial_filter
from vical_daemon.estimation.init.rig_model import RigModel
from vical_daemon.estimation.init.window_start import Step, window_start
from vical_daemon.estimation.measurements import CalibrationOptions, Frames, PointsFrame
from vical_daemon.estimation.model.state import State
from vical_daemon.estimation.selection import model_selection
from vical_daemon.estimation.wording import not_in_view

MIN_SPAN_S = 3.0  # of images of one camera before the first attempt
_WAIT_S = 2.0 * MIN_SPAN_S  # of images of one camera, for others that have not seen the target
_MAX_FRAMES = 500  # of each camera
_KEEP_S = 1.25 * LONG_S  # of images, however many they are
_MOST_CHANGES = 5  # attempts with another model of the rig: rolling shutters, targets of another size
_LOOK_S = 2.0  # the same images over and over would look like a rolling shutter by chance
_NO_FIT = "the first seconds do not fit together yet: fix the board in the room, move the rig"


@dataclass(frozen=True, slots=True)
class Attempt:
    """What an attempt gave.

    Attributes:
        filter: Ready to take `frames`, or None.
        frames: Those it begins with, in order of the imu's time.
        reason: Why there is none, or what the motion does not show.
        motion_missing: It is motion that is missing, not time.
        rolling: See `StartResult`.
        size: The target seems to be so many times as large as in its file, and is to be taken as that large.
        ratio: See `StartResult`.
        half_turned: See `StartResult`, where the target looks the same then.
        news: What was found to be not as specified.
    """

    filter: LinearisedFilter | None = None
    frames: Frames = field(default_factory=list)
    reason: str = ""
    motion_missing: bool = False
    rolling: tuple[str, str] | None = None
    size: float | None = None
    ratio: float = 1.0
    half_turned: str = ""
    news: list[Event] = field(default_factory=list)


class Initializer:
    """Collects the images of the first seconds and tries to start from them.

    Args:
        options: Switches.
        rig: Its model, which is changed where the data contradict it.
        step: Propagates a filter to an image and corrects it.
        off: What is known to be not as specified, see `CalibrationFilter.off`.
    """

    def __init__(
        self, options: CalibrationOptions, rig: RigModel, step: Step, off: Collection[str] = ()
    ) -> None:
        self._options = replace(options, estimate=options.estimate | set(off))
        self._rig, self._step, self._attempts = rig, step, Attempts(first_s=0.5)
        self._frames: dict[str, Frames] = {name: [] for name in rig.layout.cameras}
        self.anew()

    def anew(self) -> None:
        """Forget what was seen and try often again."""
        self._attempts.anew()
        self._newest_s = self._next_look_s = -np.inf
        self._rest = {name: RestDetector() for name in self._frames}
        for frames in self._frames.values():
            frames.clear()

    def take(self, items: Sequence[tuple[float, PointsFrame]]) -> None:
        """Keep images (stamp in the camera's clock in s, points) in which some of the target is seen.

        Of too many, those are dropped that are older than a start needs; of a rest before any motion, all but
        the last image.
        """
        for t_cam_s, frame in items:
            if not len(frame.ids):
                continue
            frames, rest = self._frames[frame.camera], self._rest[frame.camera]
            frames.append((t_cam_s, frame))
            rest.take(t_cam_s, frame)
            while len(frames) > _MAX_FRAMES and t_cam_s - frames[0][0] > _KEEP_S:
                del frames[0]
            if rest.rests_since(frames[0][0]):
                for name, kept in self._frames.items():
                    self._frames[name] = [x for x in kept if x[0] >= t_cam_s]

    @property
    def oldest_s(self) -> float:
        """Stamp of the oldest image kept, s; infinite when there is none."""
        return min((f[0][0] for f in self._frames.values() if f), default=np.inf)

    @property
    def _rests(self) -> bool:
        """Whether some camera shows a rig at rest by now, and none that it moves."""
        seen = [r for r in self._rest.values() if r.seen]
        return bool(seen) and all(r.rests for r in seen)

    def due(self, newest_s: float) -> bool:
        """Whether it is time for another attempt; a rig at rest adds nothing to the last one."""
        self._newest_s = newest_s
        return self._attempts.due(newest_s) and not (self._attempts.count and self._rests)

    def attempt(self, buffer: ImuBuffer, *, may_be_partial: bool, at_end: bool = False) -> Attempt:
        """Try to start; where the data contradict the model of the rig, change that and try again.

        Args:
            buffer: Inertial readings.
            may_be_partial: A start with guesses is welcome where the motion shows no more.
            at_end: No more images will come: do not wait for cameras that have not seen the target.
        """
        rig, news, may_resize = self._rig, list[Event](), True
        size = rig.size
        for _ in range(_MOST_CHANGES):
            found = self._once(
                buffer,
                may_be_partial=may_be_partial,
                may_resize=may_resize,
                wait_s=0.0 if at_end else _WAIT_S,
            )
            if found.ratio != 1.0:
                rig.stretch(found.ratio)
                news.append(Event(EventKind.TARGET_RATIO, value=rig.ratio - 1.0))
            if found.rolling is not None:  # its readout is one more unknown from now on
                camera, axis = found.rolling
                rig.estimate_readout(camera, axis)
                news.append(Event(ROLLING[axis], camera))
            elif found.size is not None:  # where that is far off, it is estimated
                rig.resize(found.size)
                may_resize &= rig.size != 1.0  # the size in the file was found to fit
            elif found.half_turned:
                camera = found.half_turned
                self._frames[camera] = rig.turns.from_the_other_end(camera, self._frames[camera])
            elif found.ratio == 1.0:
                break
        if found.filter is None and rig.size != size:
            rig.resize(size)
        return replace(found, news=news)

    def _once(self, buffer: ImuBuffer, *, may_be_partial: bool, may_resize: bool, wait_s: float) -> Attempt:
        """Try to start with the model of the rig as it is.

        Args:
            buffer: Inertial readings.
            may_be_partial: See `attempt`.
            may_resize: Another size may be suggested.
            wait_s: So many seconds of images of one camera are waited for the others.
        """
        rig, size = self._rig, self._rig.size
        spans_s = {name: f[-1][0] - f[0][0] if f else 0.0 for name, f in self._frames.items()}
        ready = [name for name, span_s in spans_s.items() if span_s >= MIN_SPAN_S]
        short = [name for name in spans_s if name not in ready]
        waited_for = [name for name in short if name not in rig.silent]
        if not ready or (waited_for and max(spans_s.values()) < max(wait_s, MIN_SPAN_S)):
            if self._rests:
                return _none(rest_in_words(buffer, "turn it about two axes, keep the target in view"), True)
            if ready:
                return _none(not_in_view(waited_for))
            return _none("collecting the first seconds: move the rig, keep the target in view")
        if self._attempts.due(self._newest_s):  # not again for another model of the rig
            self._attempts.tried(self._newest_s)
        options = self._options
        if size != 1.0:
            options = replace(options, estimate=options.estimate | {model_selection.SIZE})
        if rig.ratio != 1.0:  # by images of a few seconds; the rest is the first mode of its shape
            options = replace(options, estimate=options.estimate | {model_selection.TARGET})
        options = replace(options, imu_noise=measured_noise(options.imu_noise, buffer.rows))
        frames, priors = {n: self._frames[n] for n in ready}, {n: rig.priors[n] for n in ready}
        data = start.StartData(
            buffer, frames, priors, options, rig.layout, rig.target, may_resize, self._may_look()
        )
        result = start.attempt(data, may_be_partial=may_be_partial)
        if result.half_turned and rig.turns.alike:
            return Attempt(reason=result.reason, half_turned=result.half_turned)
        if result.rolling is not None or result.ratio != 1.0:
            return Attempt(rolling=result.rolling, ratio=result.ratio)
        other = None if result.size is None else Attempt(size=size * result.size)
        if result.state is None:
            return other or _none(result.reason, result.motion_missing)
        images = frames_from([x for kept in frames.values() for x in kept], result.state)
        others = {name: starting_camera(rig.priors[name]) for name in short}
        state = replace(result.state, cameras={**result.state.cameras, **others})
        make = partial(
            initial_filter,
            layout=rig.layout,
            options=options,
            still_axes=result.still_axes,
            turn_axis_cam=result.turn_axis_cam,
            absent=short,
        )
        poses, stated = result.poses, 1.0 / size
        found = window_start(state, poses, images, make, self._step, buffer, rig.target, stated=stated)
        if found is None:
            why = result.reason or mistaken_axes(poses, state.cameras, buffer) or _NO_FIT
            return other or _none(why, result.still_axes is not None)
        if found.size is not None:
            return Attempt(size=1.0 if found.size == stated else size * found.size)
        found.filter.began_s = found.filter.state.t_s
        return Attempt(found.filter, images, result.reason)

    def _may_look(self) -> bool:
        """Whether enough is new to look for a rolling shutter once more."""
        look = self._newest_s >= self._next_look_s
        if look:
            self._next_look_s = self._newest_s + _LOOK_S
        return look


def frames_from(frames: Frames, state: State) -> Frames:
    """Images from the time of the state on, with their stamps, s; in the order of IMU time."""

    def t_imu_s(item: tuple[float, PointsFrame]) -> float:
        return item[0] + state.cameras[item[1].camera].timeshift_s

    return sorted((x for x in frames if t_imu_s(x) > state.t_s - LATE_S), key=t_imu_s)


def _none(reason: str, motion_missing: bool = False) -> Attempt:
    return Attempt(reason=reason, motion_missing=motion_missing)
