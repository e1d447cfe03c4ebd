"""The online filter over a recording: the roles detect and estimate over a LocalBus, one message at a time.

Everything happens in one thread and in the order of the stamps, so two runs are identical bit for bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.outgoing import publish
from vical_daemon.calibrate.estimators import make_estimator
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.cross_checks import NEEDS_TARGET
from vical_daemon.config.model import CalibrationConfig, CameraConfig, Config, ImuConfig, NoiseConfig
from vical_daemon.config.priors import Initial
from vical_daemon.estimation.events import Event
from vical_daemon.estimation.geometry.camera_model import PLUMB_BOB
from vical_daemon.estimation.measurements import CameraPrior, ImuNoise
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.logs import Recording, Stream
from vical_daemon.logs.recorded_logs import stamp_of, with_stamp
from vical_daemon.offline.errors import InputError, OptionError

if TYPE_CHECKING:
    from vical_daemon.estimation.model.frame_report import FrameReport

Progress = Callable[[float, CalibrationEstimate | None], None]
PUBLISH_EVERY_S = 1.0  # of the data: often enough for a progress bar
_APART_NS = 10_000_000_000  # between one recording and the next: more than any gap that is bridged


@dataclass(slots=True)
class Job:
    """What to calibrate.

    Attributes:
        recording: The data.
        imu: Stream of the IMU.
        cameras: Stream of each camera.
        config: The rig, as the roles want it.
        priors: What is known about each camera.
        skip_s: Seconds of the recording that are left out at its beginning.
        seconds: How many are used then; None: all.
        others: Further recordings of the same rig, in the order in which they are used.
        common_clock: The time shift is the same in all recordings.
    """

    recording: Recording
    imu: Stream
    cameras: dict[str, Stream]
    config: Config
    priors: dict[str, CameraPrior]
    skip_s: float = 0.0
    seconds: float | None = None
    others: list[Job] = field(default_factory=list)
    common_clock: bool = True

    @property
    def duration_s(self) -> float:
        """Seconds of the recording that are used."""
        left_s = self.recording.duration_s - self.skip_s
        return left_s if self.seconds is None else min(self.seconds, left_s)

    @property
    def begin_ns(self) -> int:
        """Stamp from which on it is used."""
        return self.recording.begin_ns + round(self.skip_s * 1e9)

    @property
    def parts(self) -> list[Job]:
        """This recording and the others."""
        return [self, *self.others]

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Yield (key, payload) of the streams and the part of the recording that are used."""
        begin_ns = self.begin_ns
        end_ns = begin_ns + round(self.duration_s * 1e9)
        statuses = [topics.STATUS.key(self.recording.rig, "imu")]  # they say how well stamps are known
        for key, payload in self.recording.messages([self.imu, *self.cameras.values()], statuses):
            stamp_ns = stamp_of(payload)
            if stamp_ns is not None and begin_ns <= stamp_ns <= end_ns:
                yield key, payload


@dataclass(slots=True)
class InputUse:
    """What became of one of several recordings.

    Attributes:
        path: Of the recording.
        begin_s: When it begins on the time axis of trace and events, which runs on over all recordings, s.
        duration_s: Seconds of it that were read.
        frames: Images of it in the result.
        imu: Biases at its end, as in the result; None: it is not in the result.
        timeshifts_s: By camera, at its end.
    """

    path: str
    begin_s: float
    duration_s: float
    frames: int
    imu: dict[str, Any] | None
    timeshifts_s: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return it as `--json` prints it."""
        biases = {key: self.imu[key] for key in ("gyro_bias_rps", "accel_bias_mps2")} if self.imu else {}
        rest = {"begin_s": self.begin_s, "duration_s": self.duration_s, "frames": self.frames}
        shifts = {"timeshift_cam_imu_s": self.timeshifts_s} if self.imu else {}
        return {"path": self.path, "used": self.imu is not None, **rest, **biases, **shifts}


@dataclass(slots=True)
class Outcome:
    """What came out.

    Attributes:
        estimate: The last one.
        traces: How the calibration of each camera developed.
        frames: The verdict on every frame, where it was asked for.
        inputs: What became of each recording, where there are several.
        held_out: How well the IMU alone predicted images before they were used, see `HeldOutCheck`.
    """

    estimate: CalibrationEstimate
    traces: dict[str, list[dict[str, Any]]]
    frames: list[FrameReport] = field(default_factory=list)
    inputs: list[InputUse] = field(default_factory=list)
    held_out: list[dict[str, float]] = field(default_factory=list)


def make_job(
    recording: Recording,
    initial: Initial,
    *,
    target: str | None,
    camera: str | None = None,
    imu: str | None = None,
    fix: Sequence[str] = (),
    estimate: Sequence[str] = (),
    skip_s: float = 0.0,
    seconds: float | None = None,
) -> Job:
    """Choose streams and put what is known into the form of a config.

    Args:
        recording: The data.
        initial: What `--initial` says.
        target: Target file; None: target-free.
        camera: Only this one; None: all.
        imu: Which; None: the only one.
        fix: See `CalibrationOptions`.
        estimate: See `CalibrationOptions`.
        skip_s: See `Job`.
        seconds: See `Job`.

    Raises:
        InputError: No such stream, or something needed is not known.
    """
    if skip_s >= recording.duration_s:
        raise OptionError(f"--skip {skip_s:g}: {recording.path} is only {recording.duration_s:.1f} s long")
    imu_stream = _choose("imu", recording.imus, imu)
    chosen = {camera: _choose("camera", recording.cameras, camera)} if camera else dict(recording.cameras)
    if not chosen:
        raise InputError(
            f"{recording.path} holds no camera, neither images nor points; `vical info` shows what is in it"
        )
    priors = {name: _prior(name, stream, initial, fix) for name, stream in chosen.items()}
    if target is None and any(p.distortion_model == PLUMB_BOB for p in priors.values()):
        raise InputError(f"--initial: {NEEDS_TARGET}")
    config = _config(recording.rig, imu_stream, priors, initial.imu_noise or ImuNoise())
    config = replace(
        config,
        target=target,
        calibration=CalibrationConfig(
            mode="target" if target else "target_free",
            fix=tuple(fix),  # type: ignore[arg-type]
            estimate=tuple(estimate),  # type: ignore[arg-type]
        ),
    )
    return Job(recording, imu_stream, chosen, config, priors, skip_s, seconds)


def add_recordings(job: Job, recordings: Sequence[Recording], imu: str | None = None) -> None:
    """Add further recordings of the same rig to a job.

    Args:
        job: Of the first; its part of the recording is that of each.
        recordings: Further ones, in order.
        imu: Which; None: the only one.

    Raises:
        InputError: A recording is not of the same cameras, or too short.
    """
    for recording in recordings:
        if job.skip_s >= recording.duration_s:
            length = f"{recording.path} is only {recording.duration_s:.1f} s long"
            raise OptionError(f"--skip {job.skip_s:g}: {length}")
        cameras = _same_cameras(job, recording)
        for name, stream in cameras.items():
            size = job.priors[name].resolution
            if stream.resolution not in (None, size):
                given, found = ("{} x {}".format(*r) for r in (size, stream.resolution))
                raise InputError(f"{recording.path}: {name} has images of {found}, those before of {given}")
        imu_stream = _choose("imu", recording.imus, imu)
        part = Job(recording, imu_stream, cameras, job.config, job.priors, job.skip_s, job.seconds)
        job.others.append(part)


def _same_cameras(job: Job, recording: Recording) -> dict[str, Stream]:
    """Streams of the job's cameras in another recording; a single one may have another name there."""
    found = recording.cameras
    if len(job.cameras) == len(found) == 1:
        return dict(zip(job.cameras, found.values(), strict=True))
    cameras = {name: found[name] for name in job.cameras if name in found}
    if not cameras:
        there, here = ", ".join(found) or "none", ", ".join(job.cameras)
        raise InputError(f"{recording.path} has the cameras {there}, and {job.recording.path} has {here}")
    return cameras


def _config(rig: str, imu: Stream, priors: dict[str, CameraPrior], noise: ImuNoise) -> Config:
    """Describe the devices of a recording as a config does."""
    densities = NoiseConfig(noise.gyro_density, noise.gyro_walk, noise.accel_density, noise.accel_walk)
    rate_hz = min(max(imu.rate_hz, 1.0), 1000.0)
    return Config(
        rig=rig,
        imus={imu.name: ImuConfig(port="recording", rate_hz=rate_hz, noise=densities)},
        cameras={name: CameraConfig(uri="recording", size=p.resolution) for name, p in priors.items()},
    )


def run_job(
    job: Job,
    progress: Progress,
    *,
    keep_frames: bool = False,
    only: Sequence[int] | None = None,
    enough: Callable[[CalibrationEstimate], bool] | None = None,
) -> Outcome:
    """Push the recordings through the roles.

    Args:
        job: What to calibrate.
        progress: Called now and then with the share done and the estimate.
        keep_frames: Collect the verdict on every frame.
        only: Numbers of the recordings that are used (`Job.parts`), in this order; None: all.
        enough: Called with each estimate, once a second of data; True: the rest is not needed.
    """
    frames: list[FrameReport] = []
    bus = LocalBus()
    estimator = make_estimator(job.config, job.priors)
    keep = frames.extend if keep_frames else None
    events: list[Event] = []

    stop = False

    def listen(estimate: CalibrationEstimate) -> CalibrationEstimate:
        nonlocal stop
        events.extend(estimate.events)
        stop = stop or (enough is not None and enough(estimate))
        return estimate

    role = EstimateRole(job.config, estimator, PUBLISH_EVERY_S, inspect=listen, keep=keep)
    status_key = topics.STATUS.key(job.config.rig, "imu")
    for key in (job.imu.key, status_key, *(_points_key(job, name) for name in job.cameras)):
        bus.subscribe(key, role.take)
    _attach_detectors(bus, job)
    parts = job.parts if only is None else [job.parts[k] for k in only]
    total = sum(_expected(part) for part in parts)
    t_shown_s, done = time.monotonic(), 0

    def play(part: Job, later_ns: int) -> None:
        nonlocal t_shown_s, done
        keys = _keys(job, part)
        stamp_sigma_s = part.recording.stamp_sigma_s.get(part.imu.name)
        if stamp_sigma_s is not None:
            estimator.stamps_known_to(stamp_sigma_s)
        for key, payload in part.messages():
            if stop:
                break
            key = keys[key]
            bus.publish(key, _later(payload, later_ns) if later_ns else payload)
            done += 1
            if key != job.imu.key:
                publish(bus, role.step())
                if time.monotonic() - t_shown_s > 0.1:
                    t_shown_s = time.monotonic()
                    progress(min(done / total, 1.0), role.latest)
        publish(bus, role.finish())

    inputs = _play_all(parts, role, play, common_clock=job.common_clock)
    assert role.latest is not None
    traces = {name: [asdict(point) for point in estimator.trace(name)] for name in job.cameras}
    checks = [asdict(check) for check in estimator.held_out()]
    used = inputs if len(parts) > 1 else []
    return Outcome(replace(role.latest, events=events), traces, frames, used, checks)


def _play_all(
    parts: Sequence[Job], role: EstimateRole, play: Callable[[Job, int], None], *, common_clock: bool
) -> list[InputUse]:
    """Play one recording after the other on one time axis.

    The calibration goes on from one to the next. Where there is none yet at the end of a recording that could
    go on, the next begins without it, and that recording is tried once more at the end.
    """
    order = list(range(len(parts)))
    uses: dict[int, InputUse] = {}
    free_ns, frames = parts[0].begin_ns, 0
    for turn, number in enumerate(order):  # grows
        part = parts[number]
        later_ns = free_ns - part.begin_ns
        play(part, later_ns)
        assert role.latest is not None
        duration_ns = round(part.duration_s * 1e9)
        begin_s = (free_ns - parts[0].begin_ns) * 1e-9
        of_it, frames = role.latest.frames - frames, role.latest.frames
        free_ns += duration_ns + _APART_NS
        goes_on = role.estimator.can_go_on
        if not goes_on and turn < len(parts) - 1:
            order.append(number)
        ends = turn + 1 == len(order) or (turn + 1 >= len(parts) and not goes_on)
        in_result = of_it > 0 and (goes_on or (ends and bool(role.latest.cameras)))
        imu = asdict(role.latest.imu) if in_result and role.latest.imu is not None else None
        shifts = {name: c.timeshift_cam_imu_s for name, c in role.latest.cameras.items()}
        counted = of_it if imu else 0
        uses[number] = InputUse(str(part.recording.path), begin_s, part.duration_s, counted, imu, shifts)
        if ends:
            break
        role.next_recording(common_clock=common_clock)
    return [uses[number] for number in range(len(parts))]


def _expected(part: Job) -> float:
    """About how many messages a recording gives."""
    count = part.imu.count + sum(stream.count for stream in part.cameras.values())
    return count * part.duration_s / max(part.recording.duration_s, 1e-9)


def _keys(job: Job, part: Job) -> dict[str, str]:
    """Keys of a recording and those of the job that they mean."""
    there, here = (topics.STATUS.key(x.recording.rig, "imu") for x in (part, job))
    keys = {part.imu.key: job.imu.key, there: here}
    if part is job:
        return keys | {stream.key: stream.key for stream in part.cameras.values()}
    return keys | {stream.key: _input_key(job, name, stream) for name, stream in part.cameras.items()}


def _input_key(job: Job, name: str, stream: Stream) -> str:
    """Where the messages of a camera's stream go."""
    if stream.kind in ("points", "tracks"):
        return _points_key(job, name)
    return topics.BY_KIND[stream.kind].key(job.config.rig, name)


def _later(payload: bytes, later_ns: int) -> bytes:
    stamp_ns = stamp_of(payload)
    return payload if stamp_ns is None else with_stamp(payload, stamp_ns + later_ns)


def document(job: Job, outcome: Outcome) -> dict[str, Any]:
    """Return the result as `--json` prints it; `cpu_s` counts from the start of the process."""
    result = outcome.estimate.to_json()
    result["status"] = str(outcome.estimate.status)
    result["fixed"] = sorted(job.config.calibration.fix)
    result["duration_s"] = job.duration_s
    if outcome.inputs:
        result["duration_s"] = sum(use.duration_s for use in outcome.inputs)
        result["inputs"] = [use.to_json() for use in outcome.inputs]
    for name, camera in result["cameras"].items():
        camera["resolution"] = list(job.priors[name].resolution)
    if result["imu"] is not None:
        result["imu"] |= {"name": job.imu.name, "noise": asdict(_noise_of(job))}
    result["warnings"] = [text for part in job.parts for text in part.recording.warnings]
    first = next(iter(job.cameras))
    result["trace"] = outcome.traces[first]
    if len(job.cameras) > 1:
        result["traces"] = outcome.traces
    result["held_out"] = outcome.held_out
    result["cpu_s"] = time.process_time()
    return result


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


def suspects(job: Job) -> str:
    """Name what to check when the motion is not to blame: wrong input looks like poor motion."""
    spans = ", ".join(f"{name} {stream.duration_s:.1f} s" for name, stream in job.cameras.items())
    things = ["the lens in --initial", f"the stamps (imu {job.imu.duration_s:.1f} s, {spans})"]
    if job.config.target:
        things.insert(0, f"the sizes in {job.config.target}")
    return f"if the motion was rich, check {' and '.join((', '.join(things[:-1]), things[-1]))}"


def _attach_detectors(bus: LocalBus, job: Job) -> None:
    """Give a detector to each camera that comes as images; its points go back on the same bus."""
    images: dict[str, set[str]] = {}
    for part in job.parts:
        for name, stream in part.cameras.items():
            if stream.kind in ("image", "compressed"):
                images.setdefault(name, set()).add(_input_key(job, name, stream))
    if not images:
        return
    from vical_daemon.detect.role import DetectRole, attach_aid

    for name, keys in images.items():
        detect = DetectRole(job.config, name, prior=job.priors[name])
        attach_aid(bus, detect)

        def on_image(sample: Sample, detect: DetectRole = detect) -> None:
            publish(bus, detect.points(sample))

        for key in keys:
            bus.subscribe(key, on_image)


def _points_key(job: Job, camera: str) -> str:
    stream = job.cameras[camera]
    if stream.kind in ("points", "tracks"):
        return stream.key
    free = job.config.calibration.mode == "target_free"
    return (topics.TRACKS if free else topics.POINTS).key(job.config.rig, camera)


def _choose(what: str, streams: dict[str, Stream], name: str | None) -> Stream:
    if name is None:
        if len(streams) == 1:
            return next(iter(streams.values()))
        known = ", ".join(streams) or "none"
        raise OptionError(f"the recording has {len(streams)} {what}s ({known}); say which with --{what}")
    if name not in streams:
        raise InputError(
            f"there is no {what} {name!r} in the recording (known: {', '.join(streams) or 'none'})"
        )
    return streams[name]


def _prior(name: str, stream: Stream, initial: Initial, fix: Sequence[str]) -> CameraPrior:
    """Return the prior of one camera; a single camera of another name in the file is meant for it."""
    cameras = initial.cameras
    prior = cameras.get(name)
    if prior is None and len(cameras) == 1:
        prior = next(iter(cameras.values()))
    prior = prior or CameraPrior(resolution=(0, 0))
    if prior.resolution == (0, 0):
        if stream.resolution is None:
            raise OptionError(
                f"{name}: the image size is neither in the recording nor in --initial; "
                f"give a file with `{name}: {{resolution: [width, height]}}`"
            )
        prior = replace(prior, resolution=stream.resolution)
    elif stream.resolution is not None and stream.resolution != prior.resolution:
        given_size, size = ("{} x {}".format(*r) for r in (prior.resolution, stream.resolution))
        raise InputError(f"{name}: --initial is for images of {given_size}, the recording's are {size}")
    given = {
        "intrinsics": prior.intrinsics,
        "extrinsics": prior.T_imu_cam,
        "timeshift": prior.timeshift_cam_imu_s,
    }
    for what in fix:
        if given[what] is None:
            raise OptionError(f"--fix {what}: --initial does not give it for {name}")
    return prior


def _noise_of(job: Job) -> ImuNoise:
    imu = job.config.imus[job.imu.name]
    n = imu.noise
    return ImuNoise(n.gyro_density, n.gyro_walk, n.accel_density, n.accel_walk, imu.rate_hz)
