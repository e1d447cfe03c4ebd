"""What is to be calibrated: recordings, streams, what is known of the cameras, and the rig as a config."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vical_daemon.bus import topics
from vical_daemon.config.model import CalibrationConfig, CameraConfig, Config, ImuConfig, NoiseConfig
from vical_daemon.config.priors import Initial
from vical_daemon.estimation.measurements import CameraPrior, ImuNoise
from vical_daemon.logs import Recording, Stream, meant
from vical_daemon.logs.channel import force_of, negative, stamp_of, with_force
from vical_daemon.logs.what_is_there import whole_recording
from vical_daemon.offline.accel_shift import AccelShift
from vical_daemon.offline.camera_names import priors_meant
from vical_daemon.offline.errors import InputError, OptionError, Warn, ignore, size_unknown

_COPIED = 0.05  # share of the readings; where a log was split, a few may be in both files


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
        accel_late: By how many readings the accelerometer is behind the gyro, see `AccelShift`.
        warn: Takes what is found out about the recordings while they are used.
        negate_force: Use the accelerometer with the opposite sign, to find out whether that is the mistake.
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
    accel_late: int = 0
    negate_force: bool = False
    warn: Warn = ignore

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
    def end_ns(self) -> int:
        """Stamp up to which it is used."""
        return self.begin_ns + round(self.duration_s * 1e9)

    @property
    def parts(self) -> list[Job]:
        """This recording and the others."""
        return [self, *self.others]

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Yield (key, payload) of the streams and the part of the recording that are used."""
        begin_ns, end_ns = self.begin_ns, self.end_ns
        statuses = [topics.STATUS.key(self.recording.rig, "imu")]  # they say how well stamps are known
        shift = AccelShift(self.accel_late)
        for key, payload in self.recording.messages([self.imu, *self.cameras.values()], statuses):
            stamp_ns = stamp_of(payload)
            if stamp_ns is None or not begin_ns <= stamp_ns <= end_ns:
                continue
            complete = shift.take(payload) if key == self.imu.key else payload
            if complete is not None:
                negated = self.negate_force and key == self.imu.key
                yield key, with_force(complete, negative(force_of(complete))) if negated else complete


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
    gravity_mps2: float = 9.80665,
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
        gravity_mps2: Magnitude of gravity at the site.

    Raises:
        InputError: No such stream, or something needed is not known.
    """
    if skip_s >= recording.duration_s:
        raise OptionError(f"--skip {skip_s:g}: {recording.path} is only {recording.duration_s:.1f} s long")
    imu_stream = _choose("imu", recording.imus, imu)
    chosen = dict(recording.cameras)
    if camera:
        stream = _choose("camera", recording.cameras, camera)
        chosen = {stream.name: stream}
    if not chosen:
        reasons = ("unreadable", "no stamps", "no cameras")
        unread = "; ".join(w for w in recording.warnings if any(reason in w for reason in reasons))
        whole = whole_recording(recording.path)
        hint = f"it is part of a recording: give {whole}" if whole else "`vical info` shows what is in it"
        why = f" ({unread})" if unread else f"; {hint}"
        raise InputError(f"{recording.path} holds no camera, neither images nor points{why}")
    cameras = priors_meant(initial, chosen)
    priors = {name: _prior(name, stream, cameras.get(name), fix) for name, stream in chosen.items()}
    config = _config(recording.rig, imu_stream, priors, initial.imu_noise or ImuNoise())
    config = replace(
        config,
        target=target,
        calibration=CalibrationConfig(
            mode="target" if target else "target_free",
            fix=tuple(fix),  # type: ignore[arg-type]
            estimate=tuple(estimate),  # type: ignore[arg-type]
            gravity_mps2=gravity_mps2,
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
        for earlier in job.parts:
            _check_own_readings(part, earlier)
        job.others.append(part)


def _check_own_readings(part: Job, earlier: Job) -> None:
    """Refuse a copy: the same data used twice make sigmas too small, and agree with themselves.

    Recordings whose stamps begin at 0 may have stamps in common, but not readings.
    """
    if part.imu.begin_ns > earlier.imu.end_ns or earlier.imu.begin_ns > part.imu.end_ns:
        return
    one, other = (job.recording.imu_arrays(job.imu.name) for job in (part, earlier))
    _, at, there = np.intersect1d(one.t_ns, other.t_ns, return_indices=True)
    same = np.count_nonzero((one.gyro_rps[at] == other.gyro_rps[there]).all(axis=1))
    if same > _COPIED * len(one.t_ns):
        raise OptionError(
            f"{part.recording.path}: {same} of its {len(one.t_ns)} IMU readings are those of "
            f"{earlier.recording.path}; give data once"
        )


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


def _choose(what: str, streams: dict[str, Stream], name: str | None) -> Stream:
    if name is None:
        if len(streams) == 1:
            return next(iter(streams.values()))
        known = ", ".join(f"{stream.name}: {stream.source}" for stream in streams.values()) or "none"
        raise OptionError(f"the recording has {len(streams)} {what}s ({known}); say which with --{what}")
    name = meant(streams, name)
    if name not in streams:
        raise InputError(
            f"there is no {what} {name!r} in the recording (known: {', '.join(streams) or 'none'})"
        )
    return streams[name]


def _prior(name: str, stream: Stream, prior: CameraPrior | None, fix: Sequence[str]) -> CameraPrior:
    """Return the prior of one camera, with the size of its images."""
    prior = prior or CameraPrior(resolution=(0, 0))
    if prior.resolution == (0, 0):
        if stream.resolution is None:
            raise OptionError(f"{name}: {size_unknown(stream)}")
        prior = replace(prior, resolution=stream.resolution)
    elif stream.resolution is not None and stream.resolution != prior.resolution:
        given_size, size = ("{} x {}".format(*r) for r in (prior.resolution, stream.resolution))
        raise InputError(f"{name}: the given lens is for images of {given_size}, the recording's are {size}")
    if outside := _points_outside(stream.extent_px, prior.resolution):
        raise InputError(f"{name}: {outside}")
    given = {
        "intrinsics": prior.intrinsics,
        "extrinsics": prior.T_imu_cam,
        "timeshift": prior.timeshift_cam_imu_s,
    }
    for what in fix:
        if given[what] is None:
            raise OptionError(f"--fix {what}: --initial does not give it for {name}")
    return prior


def _points_outside(extent_px: tuple[float, float], size: tuple[int, int]) -> str:
    """Say that points lie outside of images of this size; empty: they do not."""
    (u, v), (width, height) = extent_px, size
    if u < width and v < height:
        return ""
    swapped = "; are width and height swapped?" if u < height and v < width else ": correct `resolution`"
    return f"points lie at up to ({u:.0f}, {v:.0f}) px, outside of images of {width} x {height}{swapped}"


def _config(rig: str, imu: Stream, priors: dict[str, CameraPrior], noise: ImuNoise) -> Config:
    """Describe the devices of a recording as a config does."""
    densities = NoiseConfig(noise.gyro_density, noise.gyro_walk, noise.accel_density, noise.accel_walk)
    rate_hz = min(max(imu.rate_hz, 1.0), 1000.0)
    return Config(
        rig=rig,
        imus={imu.name: ImuConfig(port="recording", rate_hz=rate_hz, noise=densities)},
        cameras={name: CameraConfig(uri="recording", size=p.resolution) for name, p in priors.items()},
    )


def noise_of(job: Job) -> ImuNoise:
    """Noise of the imu as the config has it."""
    imu = job.config.imus[job.imu.name]
    n = imu.noise
    return ImuNoise(n.gyro_density, n.gyro_walk, n.accel_density, n.accel_walk, imu.rate_hz)


def points_key(job: Job, camera: str) -> str:
    """Key of the points, or tracks, of a camera."""
    stream = job.cameras[camera]
    if stream.kind in ("points", "tracks"):
        return stream.key
    free = job.config.calibration.mode == "target_free"
    return (topics.TRACKS if free else topics.POINTS).key(job.config.rig, camera)


def input_key(job: Job, name: str, stream: Stream) -> str:
    """Where the messages of a camera's stream go."""
    if stream.kind in ("points", "tracks"):
        return points_key(job, name)
    return topics.BY_KIND[stream.kind].key(job.config.rig, name)


def keys_of(job: Job, part: Job) -> dict[str, str]:
    """Keys of a recording and those of the job that they mean."""
    there, here = (topics.STATUS.key(x.recording.rig, "imu") for x in (part, job))
    keys = {part.imu.key: job.imu.key, there: here}
    if part is job:
        return keys | {stream.key: stream.key for stream in part.cameras.values()}
    return keys | {stream.key: input_key(job, name, stream) for name, stream in part.cameras.items()}


def suspects(job: Job) -> str:
    """Name what to check when the motion is not to blame: wrong input looks like poor motion."""
    spans = ", ".join(f"{name} {stream.duration_s:.1f} s" for name, stream in job.cameras.items())
    things = ["the lens in --initial", f"the stamps (IMU {job.imu.duration_s:.1f} s, {spans})"]
    if job.config.target:
        things.insert(0, f"the sizes in {job.config.target}")
    return (
        f"if the motion was rich, check {' and '.join((', '.join(things[:-1]), things[-1]))}{one_alone(job)}"
    )


def one_alone(job: Job) -> str:
    """What to try where one of several cameras may hold up the others; empty: it cannot be that."""
    if not job.config.target or len(job.cameras) == 1:
        return ""
    return "; all wait for a camera that hardly sees the target: --camera NAME takes one of them alone"
