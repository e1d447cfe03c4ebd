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
from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.config.cross_checks import NEEDS_TARGET
from vical_daemon.config.model import CalibrationConfig, CameraConfig, Config, ImuConfig, NoiseConfig
from vical_daemon.config.priors import Initial
from vical_daemon.estimation.events import Event
from vical_daemon.estimation.geometry.camera_model import PLUMB_BOB
from vical_daemon.estimation.measurements import CameraPrior, ImuNoise
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.logs import Recording, Stream
from vical_daemon.logs.recorded_logs import stamp_of

if TYPE_CHECKING:
    from vical_daemon.estimation.model.frame_report import FrameReport

Progress = Callable[[float, CalibrationEstimate | None], None]
PUBLISH_EVERY_S = 1.0  # of the data: often enough for a progress bar


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
    """

    recording: Recording
    imu: Stream
    cameras: dict[str, Stream]
    config: Config
    priors: dict[str, CameraPrior]
    skip_s: float = 0.0
    seconds: float | None = None

    @property
    def duration_s(self) -> float:
        """Seconds of the recording that are used."""
        left_s = self.recording.duration_s - self.skip_s
        return left_s if self.seconds is None else min(self.seconds, left_s)

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Yield (key, payload) of the streams and the part of the recording that are used."""
        begin_ns = self.recording.begin_ns + round(self.skip_s * 1e9)
        end_ns = begin_ns + round(self.duration_s * 1e9)
        statuses = [topics.STATUS.key(self.recording.rig, "imu")]  # they say how well stamps are known
        for key, payload in self.recording.messages([self.imu, *self.cameras.values()], statuses):
            stamp_ns = stamp_of(payload)
            if stamp_ns is not None and begin_ns <= stamp_ns <= end_ns:
                yield key, payload


@dataclass(slots=True)
class Outcome:
    """What came out: the last estimate, the trace of each camera, and the verdict on every frame."""

    estimate: CalibrationEstimate
    traces: dict[str, list[dict[str, Any]]]
    frames: list[FrameReport] = field(default_factory=list)


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
        CliError: No such stream, or something needed is not known.
    """
    if skip_s >= recording.duration_s:
        raise CliError(
            f"--skip {skip_s:g}: {recording.path} is only {recording.duration_s:.1f} s long", EXIT_USAGE
        )
    imu_stream = _choose("imu", recording.imus, imu)
    chosen = {camera: _choose("camera", recording.cameras, camera)} if camera else dict(recording.cameras)
    if not chosen:
        raise CliError(
            f"{recording.path} holds no camera, neither images nor points; `vical info` shows what is in it"
        )
    priors = {name: _prior(name, stream, initial, fix) for name, stream in chosen.items()}
    if target is None and any(p.distortion_model == PLUMB_BOB for p in priors.values()):
        raise CliError(f"--initial: {NEEDS_TARGET}")
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
    enough: Callable[[CalibrationEstimate], bool] | None = None,
) -> Outcome:
    """Push the recording through the roles.

    Args:
        job: What to calibrate.
        progress: Called now and then with the share done and the estimate.
        keep_frames: Collect the verdict on every frame.
        enough: Called with each estimate, once a second of data; True: the rest is not needed.
    """
    frames: list[FrameReport] = []
    bus = LocalBus()
    estimator = make_estimator(job.config, job.priors)
    stamp_sigma_s = job.recording.stamp_sigma_s.get(job.imu.name)
    if stamp_sigma_s is not None:
        estimator.stamps_known_to(stamp_sigma_s)
    keep = frames.extend if keep_frames else None
    events: list[Event] = []
    done = False

    def listen(estimate: CalibrationEstimate) -> CalibrationEstimate:
        nonlocal done
        events.extend(estimate.events)
        done = done or (enough is not None and enough(estimate))
        return estimate

    role = EstimateRole(job.config, estimator, PUBLISH_EVERY_S, inspect=listen, keep=keep)
    status_key = topics.STATUS.key(job.config.rig, "imu")
    for key in (job.imu.key, status_key, *(_points_key(job, name) for name in job.cameras)):
        bus.subscribe(key, role.take)
    _attach_detectors(bus, job)
    count = job.imu.count + sum(stream.count for stream in job.cameras.values())
    total = count * job.duration_s / max(job.recording.duration_s, 1e-9)
    t_shown_s = time.monotonic()
    for number, (key, payload) in enumerate(job.messages()):
        if done:
            break
        bus.publish(key, payload)
        if key != job.imu.key:
            publish(bus, role.step())
            if time.monotonic() - t_shown_s > 0.1:
                t_shown_s = time.monotonic()
                progress(min(number / total, 1.0), role.latest)
    publish(bus, role.finish())
    assert role.latest is not None
    traces = {name: [asdict(point) for point in estimator.trace(name)] for name in job.cameras}
    return Outcome(replace(role.latest, events=events), traces, frames)


def document(job: Job, outcome: Outcome) -> dict[str, Any]:
    """Return the result as `--json` prints it; `cpu_s` counts from the start of the process."""
    result = outcome.estimate.to_json()
    result["status"] = str(outcome.estimate.status)
    result["duration_s"] = job.duration_s
    result["fixed"] = sorted(job.config.calibration.fix)
    for name, camera in result["cameras"].items():
        camera["resolution"] = list(job.priors[name].resolution)
    if result["imu"] is not None:
        result["imu"] |= {"name": job.imu.name, "noise": asdict(_noise_of(job))}
    result["warnings"] = list(job.recording.warnings)
    first = next(iter(job.cameras))
    result["trace"] = outcome.traces[first]
    if len(job.cameras) > 1:
        result["traces"] = outcome.traces
    result["cpu_s"] = time.process_time()
    return result


def suspects(job: Job) -> str:
    """Name what to check when the motion is not to blame: wrong input looks like poor motion."""
    spans = ", ".join(f"{name} {stream.duration_s:.1f} s" for name, stream in job.cameras.items())
    things = ["the lens in --initial", f"the stamps (imu {job.imu.duration_s:.1f} s, {spans})"]
    if job.config.target:
        things.insert(0, f"the sizes in {job.config.target}")
    return f"if the motion was rich, check {' and '.join((', '.join(things[:-1]), things[-1]))}"


def _attach_detectors(bus: LocalBus, job: Job) -> None:
    """Give a detector to each camera that comes as images; its points go back on the same bus."""
    images = {name for name, stream in job.cameras.items() if stream.kind in ("image", "compressed")}
    if not images:
        return
    from vical_daemon.detect.role import DetectRole, attach_aid

    for name in images:
        detect = DetectRole(job.config, name, prior=job.priors[name])
        attach_aid(bus, detect)

        def on_image(sample: Sample, detect: DetectRole = detect) -> None:
            publish(bus, detect.points(sample))

        bus.subscribe(job.cameras[name].key, on_image)


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
        raise CliError(
            f"the recording has {len(streams)} {what}s ({known}); say which with --{what}", EXIT_USAGE
        )
    if name not in streams:
        raise CliError(
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
            raise CliError(
                f"{name}: the image size is neither in the recording nor in --initial; "
                f"give a file with `{name}: {{resolution: [width, height]}}`",
                EXIT_USAGE,
            )
        prior = replace(prior, resolution=stream.resolution)
    elif stream.resolution is not None and stream.resolution != prior.resolution:
        given_size, size = ("{} x {}".format(*r) for r in (prior.resolution, stream.resolution))
        raise CliError(f"{name}: --initial is for images of {given_size}, the recording's are {size}")
    given = {
        "intrinsics": prior.intrinsics,
        "extrinsics": prior.T_imu_cam,
        "timeshift": prior.timeshift_cam_imu_s,
    }
    for what in fix:
        if given[what] is None:
            raise CliError(f"--fix {what}: --initial does not give it for {name}", EXIT_USAGE)
    return prior


def _noise_of(job: Job) -> ImuNoise:
    imu = job.config.imus[job.imu.name]
    n = imu.noise
    return ImuNoise(n.gyro_density, n.gyro_walk, n.accel_density, n.accel_walk, imu.rate_hz)
