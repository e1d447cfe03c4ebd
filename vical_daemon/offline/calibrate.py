"""The online filter over a recording: the roles detect and estimate over a LocalBus, one message at a time.

Everything happens in one thread and in the order of the stamps, so two runs are identical bit for bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.outgoing import publish
from vical_daemon.calibrate.estimators import make_estimator
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.logs.channel import stamp_of, with_stamp
from vical_daemon.offline.accel_shift import STRAIGHT_S
from vical_daemon.offline.calibration_job import Job, input_key, keys_of, noise_of, points_key
from vical_daemon.offline.errors import OptionError
from vical_daemon.offline.td_icp.own_clock import placed
from vical_daemon.offline.trace import Trace

if TYPE_CHECKING:
    from vical_daemon.detect.role import DetectRole
    from vical_daemon.estimation.model.frame_report import FrameReport
    from vical_daemon.estimation.smoother.bundle import Fit
    from vical_daemon.estimation.smoother.window import Window

Progress = Callable[[float, CalibrationEstimate | None], None]
PUBLISH_EVERY_S = 1.0  # of the data: often enough for a progress bar
_PASSES = 3
"""A long lag of the accelerometer is found too short at first; the second time it is within an interval."""
_APART_NS = 10_000_000_000  # between one recording and the next: more than any gap that is bridged
_SPLIT_NS = 1_000_000_000
"""Between two files of one recording, less: a recorder closes one and opens the next. Nobody who stops a
recording and starts another is as quick."""


@dataclass(slots=True)
class InputUse:
    """What became of one of several recordings.

    Attributes:
        path: Of the recording.
        begin_s: When it begins on the time axis of trace and events, which runs on over all recordings, s.
        duration_s: Seconds of it that were read.
        frames: Images of it in the result.
        imu: Biases at its end, as in the result, or, of a split recording, at the end of its last file; None:
            it is not in the result.
        timeshifts_s: By camera, at its end.
        added_s: By camera, what was added to its stamps before that (videos), s.
    """

    path: str
    begin_s: float
    duration_s: float
    frames: int
    imu: dict[str, Any] | None
    timeshifts_s: dict[str, float] = field(default_factory=dict)
    added_s: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return it as `--json` prints it."""
        biases = {key: self.imu[key] for key in ("gyro_bias_rps", "accel_bias_mps2")} if self.imu else {}
        rest = {"begin_s": self.begin_s, "duration_s": self.duration_s, "frames": self.frames}
        shifts = {"timeshift_cam_imu_s": self.timeshifts_s} if self.imu else {}
        added = {"added_to_stamps_s": self.added_s} if self.added_s else {}
        return {"path": self.path, "used": self.imu is not None, **rest, **biases, **shifts, **added}


@dataclass(slots=True)
class Outcome:
    """What came out.

    Attributes:
        estimate: The last one.
        traces: How the calibration of each camera developed.
        frames: The verdict on every frame, where it was asked for.
        inputs: What became of each recording, where there are several.
        held_out: How well the IMU alone predicted images before they were used, see `HeldOutCheck`.
        left_out: Readings and images that were not used, by cause, see `Estimator.left_out`.
        wrong_target: What the images contradict in the target file, one line; "": nothing is known.
    """

    estimate: CalibrationEstimate
    traces: dict[str, list[dict[str, Any]]]
    frames: list[FrameReport] = field(default_factory=list)
    inputs: list[InputUse] = field(default_factory=list)
    held_out: list[dict[str, float]] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    wrong_target: str = ""


def run_job(
    job: Job,
    progress: Progress,
    *,
    keep_frames: bool = False,
    only: Sequence[int] | None = None,
    enough: Callable[[CalibrationEstimate], bool] | None = None,
    closed: Callable[[Window, Fit], None] | None = None,
) -> Outcome:
    """Push the recordings through the roles.

    Args:
        job: What to calibrate.
        progress: Called now and then with the share done and the estimate.
        keep_frames: Collect the verdict on every frame.
        only: Numbers of the recordings that are used (`Job.parts`), in this order; None: all.
        enough: Called with each estimate, once a second of data; True: the rest is not needed.
        closed: Called with each complete window, of one camera without a target.
    """
    _place(job)
    passes = _PASSES if enough is None and closed is None else 1  # those would see some data twice
    while True:
        frames: list[FrameReport] = []
        player = _Player(job, progress, frames.extend if keep_frames else None, enough)
        player.may_shift = passes > 1
        parts = job.parts if only is None else [job.parts[k] for k in only]
        player.expected = sum(_expected(part) for part in parts)
        role, estimator = player.role, player.estimator
        if closed is not None:
            from vical_daemon.estimation.target_free import TargetFreeCalibrator

            assert isinstance(estimator, TargetFreeCalibrator)
            estimator.window_closed = closed
        inputs = _play_all(parts, role, player.play, common_clock=job.common_clock)
        if not player.accel_late:
            break
        for part in job.parts:
            part.accel_late += player.accel_late
        passes -= 1
    assert role.latest is not None
    checks = [asdict(check) for check in estimator.held_out()]
    used = inputs if len(parts) > 1 else []
    wrong = "; ".join(f"{d.camera}: {d.wrong_target}" for d in player.detectors if d.wrong_target)
    left_out = estimator.left_out | {
        "images_of_another_size": sum(d.refused for d in player.detectors),
        "images_unreadable": sum(d.malformed for d in player.detectors),
    }
    return Outcome(
        replace(role.latest, events=player.events), player.trace.points, frames, used, checks, left_out, wrong
    )


def _place(job: Job) -> None:
    """Find when videos begin; from then on each has a time shift of its own, and a given one says nothing."""
    for part in job.parts:
        for name, stream in part.cameras.items():
            if stream.name not in part.recording.unplaced:
                continue
            if "timeshift" in job.config.calibration.fix:
                raise OptionError(f"--fix timeshift: {name} is a video with a clock of its own; leave it out")
            prior = replace(job.priors[name], timeshift_cam_imu_s=None)
            job.priors[name] = prior
            target = job.config.target
            place = part.recording, part.imu.name, stream, prior, target
            part.cameras[name] = placed(*place, job.warn)
            job.common_clock = False
        _check_images(part)


def _check_images(part: Job) -> None:
    """Refuse a part of a recording without images: nothing would be seen, and the motion be blamed.

    Raises:
        OptionError: There are none between --skip and --seconds.
    """
    seen = [(stream.begin_ns, stream.end_ns) for stream in part.cameras.values()]
    if any(begin_ns <= part.end_ns and end_ns >= part.begin_ns for begin_ns, end_ns in seen):
        return
    zero_ns = part.recording.begin_ns
    begin_s, end_s = ((t - zero_ns) * 1e-9 for t in (min(s[0] for s in seen), max(s[1] for s in seen)))
    raise OptionError(
        f"{part.recording.path}: the part that --skip and --seconds name has no images; they are from "
        f"{begin_s:.1f} to {end_s:.1f} s"
    )


class _Player:
    """The roles detect and estimate on a bus of their own, and what is published to them.

    Args:
        job: What to calibrate.
        progress: See `run_job`.
        keep: Takes the verdicts on frames; None: they are not wanted.
        enough: See `run_job`.

    Attributes:
        role: Estimates.
        estimator: Its estimator.
        events: What it announced so far.
        trace: How its estimates developed.
        expected: About how many messages are played in all.
        may_shift: A long lag of the accelerometer ends the pass, to be taken off before the next.
        accel_late: By how many readings, then.
    """

    def __init__(
        self,
        job: Job,
        progress: Progress,
        keep: Callable[[Sequence[FrameReport]], None] | None,
        enough: Callable[[CalibrationEstimate], bool] | None,
    ) -> None:
        self._job, self._progress, self._enough = job, progress, enough
        self._bus = LocalBus()
        self.estimator = make_estimator(job.config, job.priors)
        self.role = EstimateRole(
            job.config, self.estimator, PUBLISH_EVERY_S, inspect=self._inspect, keep=keep
        )
        self.events: list[Event] = []
        self.trace = Trace(job.cameras)
        self.expected = 0.0
        self.may_shift, self.accel_late = False, 0
        self._stop, self._done, self._shown_s = False, 0, time.monotonic()
        status_key = topics.STATUS.key(job.config.rig, "imu")
        for key in (job.imu.key, status_key, *(points_key(job, name) for name in job.cameras)):
            self._bus.subscribe(key, self.role.take)
        self.detectors = _attach_detectors(self._bus, job)

    def _inspect(self, estimate: CalibrationEstimate) -> CalibrationEstimate:
        self.events.extend(self._in_all(event) for event in estimate.events)
        self.trace.take(estimate)
        self._stop = self._stop or (self._enough is not None and self._enough(estimate))
        return estimate

    def _in_all(self, event: Event) -> Event:
        """Return an event; a lag of the accelerometer with what was taken off before."""
        if event.kind is not EventKind.ACCEL_LAG or event.value is None:
            return event
        rate_hz = self._job.imu.rate_hz
        readings = round(event.value * rate_hz)
        if self.may_shift and readings and abs(event.value) > STRAIGHT_S:
            self.accel_late, self._stop = readings, True
        return replace(event, value=event.value + self._job.accel_late / rate_hz)

    def play(self, part: Job, later_ns: int, *, ends: bool) -> None:
        """Publish one file, its stamps moved by `later_ns`; `ends`: the recording does not go on after it."""
        keys = keys_of(self._job, part)
        sigma_s = part.recording.stamp_sigma_s
        moved = [sigma_s[x.name] for x in (part.imu, *part.cameras.values()) if x.name in sigma_s]
        if moved:
            self.estimator.stamps_known_to(math.hypot(*moved))
        for key, payload in part.messages():
            if self._stop:
                break
            key = keys[key]
            self._bus.publish(key, _later(payload, later_ns) if later_ns else payload)
            self._done += 1
            if key != self._job.imu.key:
                publish(self._bus, self.role.step())
                self._show()
        if ends:
            publish(self._bus, self.role.finish())

    def _show(self) -> None:
        """Report the progress, ten times a second at most."""
        if time.monotonic() - self._shown_s > 0.1:
            self._shown_s = time.monotonic()
            self._progress(min(self._done / self.expected, 1.0), self.role.latest)


def _play_all(
    parts: Sequence[Job], role: EstimateRole, play: Callable[..., None], *, common_clock: bool
) -> list[InputUse]:
    """Play one recording after the other on one time axis.

    The calibration goes on from one to the next. Where there is none yet at the end of a recording that could
    go on, the next begins without it, and that recording is tried once more at the end. Files that continue
    one another are one recording: nothing is found anew between them.
    """
    order = continuous(parts)
    count = len(order)
    uses: dict[int, InputUse] = {}
    free_ns, frames = parts[0].begin_ns, 0
    for turn, files in enumerate(order):  # grows
        later_ns, of_it = free_ns - parts[files[0]].begin_ns, dict[int, int]()
        for number in files:
            play(parts[number], later_ns, ends=number == files[-1])
            seen = role.latest.frames if role.latest is not None else 0
            of_it[number], frames = seen - frames, seen
        latest, goes_on = role.latest, role.estimator.can_go_on
        assert latest is not None
        if not goes_on and turn < count - 1:
            order.append(files)
        ends = turn + 1 == len(order) or (turn + 1 >= count and not goes_on)
        in_result = sum(of_it.values()) > 0 and (goes_on or (ends and bool(latest.cameras)))
        imu = asdict(latest.imu) if in_result and latest.imu is not None else None
        shifts = {name: c.timeshift_cam_imu_s for name, c in latest.cameras.items()}
        for number in files:
            part, counted = parts[number], of_it[number] if imu else 0
            begin_s = (part.begin_ns + later_ns - parts[0].begin_ns) * 1e-9
            added = {x: ns * 1e-9 for x, ns in part.recording.added_ns.items()}
            path = str(part.recording.path)
            uses[number] = InputUse(path, begin_s, part.duration_s, counted, imu, shifts, added)
        if ends:
            break
        free_ns = parts[files[-1]].end_ns + later_ns + _APART_NS
        role.next_recording(common_clock=common_clock)
    return [uses[number] for number in range(len(parts))]


def continuous(parts: Sequence[Job]) -> list[list[int]]:
    """Return the numbers of some parts; those of files into which one recording was split are together."""
    out = [[0]]
    for number in range(1, len(parts)):
        if abs(parts[number].begin_ns - parts[number - 1].end_ns) < _SPLIT_NS:
            out[-1].append(number)
        else:
            out.append([number])
    return out


def _expected(part: Job) -> float:
    """About how many messages a recording gives."""
    count = part.imu.count + sum(stream.count for stream in part.cameras.values())
    return count * part.duration_s / max(part.recording.duration_s, 1e-9)


def _later(payload: bytes, later_ns: int) -> bytes:
    stamp_ns = stamp_of(payload)
    return payload if stamp_ns is None else with_stamp(payload, stamp_ns + later_ns)


def document(job: Job, outcome: Outcome) -> dict[str, Any]:
    """Return the result as `--json` prints it; `cpu_s` counts from the start of the process."""
    result = outcome.estimate.to_json()
    result["status"] = str(outcome.estimate.status)
    result["mode"] = job.config.calibration.mode
    result["fixed"] = sorted(job.config.calibration.fix)
    result["duration_s"] = job.duration_s
    if outcome.inputs:
        result["duration_s"] = sum(use.duration_s for use in outcome.inputs)
        result["inputs"] = [use.to_json() for use in outcome.inputs]
    for name, camera in result["cameras"].items():
        camera["resolution"] = list(job.priors[name].resolution)
        if job.cameras[name].topic:
            camera["topic"] = job.cameras[name].topic
        added_ns = job.recording.added_ns.get(job.cameras[name].name)
        if added_ns is not None and not outcome.inputs:  # of several recordings each has its own
            camera["added_to_stamps_s"] = added_ns * 1e-9
    if result["imu"] is not None:
        result["imu"] |= {"name": job.imu.name, "noise": asdict(noise_of(job))}
    result["warnings"] = [text for part in job.parts for text in part.recording.warnings]
    if job.accel_late:
        result["warnings"].append(accel_moved(job))
    first = next(iter(job.cameras))
    result["trace"] = outcome.traces[first]
    if len(job.cameras) > 1:
        result["traces"] = outcome.traces
    result["held_out"] = outcome.held_out
    result["left_out"] = outcome.left_out
    result["cpu_s"] = time.process_time()
    return result


def accel_moved(job: Job) -> str:
    """One line on the accelerometer's readings that were moved."""
    moved_ms = 1e3 * job.accel_late / job.imu.rate_hz
    where = "behind" if moved_ms > 0.0 else "ahead of"
    return (
        f"{job.imu.name}: the accelerometer is {where} the gyro: its readings were moved by "
        f"{abs(moved_ms):.3g} ms; set both sensors to the same filter"
    )


def images_at(job: Job, camera: str, stamps_ns: Sequence[int]) -> dict[int, bytes]:
    """Return the images of one camera with these stamps as JPEG files, small enough for a page.

    Empty where the recording holds no images, only points.
    """
    shown = job.cameras[camera].name
    streams = [s for s in job.recording.streams if s.name == shown and s.kind in ("image", "compressed")]
    if not streams:
        return {}
    from vical_daemon.vision.image_codec import encode_image
    from vical_daemon.web.images import QUALITY, pixels_of, thinned

    wanted, found = set(stamps_ns), {}
    for key, payload in job.recording.messages(streams[:1]):
        stamp_ns = stamp_of(payload)
        if stamp_ns in wanted:
            small, _ = thinned(pixels_of(Sample(key, payload, 0)))
            found[stamp_ns] = encode_image(small, "jpeg", quality=QUALITY)
            if len(found) == len(wanted):
                break
    return found


def _attach_detectors(bus: LocalBus, job: Job) -> list[DetectRole]:
    """Give a detector to each camera that comes as images; its points go back on the same bus."""
    images: dict[str, set[str]] = {}
    for part in job.parts:
        for name, stream in part.cameras.items():
            if stream.kind in ("image", "compressed"):
                images.setdefault(name, set()).add(input_key(job, name, stream))
    if not images:
        return []
    from vical_daemon.detect.role import DetectRole, attach_aid

    detectors = []
    for name, keys in images.items():
        detect = DetectRole(job.config, name, prior=job.priors[name])
        attach_aid(bus, detect)
        detectors.append(detect)

        def on_image(sample: Sample, detect: DetectRole = detect) -> None:
            publish(bus, detect.points(sample))

        for key in keys:
            bus.subscribe(key, on_image)
    return detectors
