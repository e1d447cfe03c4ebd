"""Feed a simulated recording to an estimator as the daemon would, and note errors and sigmas as it goes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.events import Event
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.wording import event_document
from vical_mocks.points import SimulatedFrame, SimulatedRun
from vical_mocks.rotations import exp_so3, log_so3

FloatArray = npt.NDArray[np.float64]
CAMERA = "cam0"
# Order of errors: lever arm (m), mounting (rad, local), time shift (s), fx fy cx cy (px), distortion.
PARAMETERS = ("px", "py", "pz", "rx", "ry", "rz", "td", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class Snapshot:
    """What an estimator reported at one time, and the truth.

    Attributes:
        t_s: When (imu time since the start).
        status: Its own word.
        error: Estimate minus truth, order `PARAMETERS`; only the estimated ones have meaning.
        covariance: What it claims, (15, 15); zero rows where a parameter is held fixed.
        extra: Other figures of interest (NIS, corner noise ...).
    """

    t_s: float
    status: str
    error: FloatArray
    covariance: FloatArray
    extra: dict[str, float] = field(default_factory=dict)


@dataclass
class Record:
    """One trial: its snapshots, announcements and costs."""

    snapshots: list[Snapshot] = field(default_factory=list)
    events: list[tuple[float, Event]] = field(default_factory=list)
    statuses: list[tuple[float, str, str]] = field(default_factory=list)  # (t_s, status, reason) at changes
    unobservable: list[str] = field(default_factory=list)
    guidance: str = ""
    cpu_s: float = 0.0
    frames: int = 0

    @property
    def event_documents(self) -> list[tuple[float, dict[str, Any]]]:
        """The announcements as JSON, each with the time at which it came."""
        return [(t_s, event_document(event)) for t_s, event in self.events]

    def started_s(self) -> float:
        """Time of the first answer, s; infinite when there was none."""
        return self.snapshots[0].t_s if self.snapshots else float("inf")

    def at(self, t_s: float) -> Snapshot | None:
        """The last answer given by `t_s`; None before the first."""
        before = [s for s in self.snapshots if s.t_s <= t_s + 1e-6]
        return before[-1] if before else None


class Subject(Protocol):
    """An estimator under test."""

    def add_imu(self, t_ns: int, gyro: FloatArray, force: FloatArray) -> None:
        """Take one inertial sample."""
        ...

    def add_points(self, frame: PointsFrame) -> None:
        """Take one frame and do the work that it makes possible."""
        ...

    def finish(self) -> None:
        """End of the data."""
        ...

    def look(self, run: SimulatedRun, t_s: float, record: Record) -> Snapshot | None:
        """Note status and events in the record; return the answer at t_s, if there is one."""
        ...


def events_in_order(run: SimulatedRun) -> Iterator[tuple[float, int | SimulatedFrame]]:
    """Inertial samples (as indices) and frames by the time at which they happen."""
    t_imu_s = (run.t_imu_ns - run.options.epoch_ns) * 1e-9
    waiting = iter(run.frames)
    frame = next(waiting, None)
    for i, t_s in enumerate(t_imu_s):
        while frame is not None and frame.t_s <= t_s:
            yield frame.t_s, frame
            frame = next(waiting, None)
        yield float(t_s), i
    while frame is not None:
        yield frame.t_s, frame
        frame = next(waiting, None)


def points_frame(frame: SimulatedFrame, camera: str = CAMERA) -> PointsFrame:
    """A simulated frame as the detect role would send it (the detector states no sigma)."""
    return PointsFrame(camera, frame.t_cam_ns, frame.ids, frame.uv_px)


def feed(run: SimulatedRun, subject: Subject, every_s: float = 1.0, until_s: float = np.inf) -> Record:
    """Run a recording through a subject and look at it every `every_s` seconds and at the end."""
    record = Record()
    follow(run, subject, record, every_s, until_s=until_s)
    finish(run, subject, record, until_s)
    return record


def follow(
    run: SimulatedRun,
    subject: Subject,
    record: Record,
    every_s: float,
    *,
    after_s: float = -np.inf,
    until_s: float = np.inf,
) -> None:
    """Feed what happens after `after_s` up to `until_s`, and look at the subject every `every_s` seconds."""
    next_look_s = every_s * (np.floor(max(after_s, 0.0) / every_s) + 1.0)
    begin = time.process_time()  # 0.1 ms on some computers: not for each sample
    for t_s, event in events_in_order(run):
        if t_s > until_s:
            break
        if t_s <= after_s:
            continue
        if isinstance(event, SimulatedFrame):
            subject.add_points(points_frame(event))
            record.frames += 1
        else:
            subject.add_imu(int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])
        if t_s >= next_look_s:
            record.cpu_s += time.process_time() - begin
            _look(run, subject, next_look_s, record)
            next_look_s += every_s
            begin = time.process_time()
    record.cpu_s += time.process_time() - begin


def finish(run: SimulatedRun, subject: Subject, record: Record, until_s: float = np.inf) -> None:
    """End the data of a subject and look at it once more."""
    begin = time.process_time()
    subject.finish()
    record.cpu_s += time.process_time() - begin
    _look(run, subject, min(run.duration_s, until_s) + 1e-3, record)


def _look(run: SimulatedRun, subject: Subject, t_s: float, record: Record) -> None:
    answer = subject.look(run, t_s, record)
    if answer is not None:
        record.snapshots.append(answer)


def error_against_truth(
    run: SimulatedRun,
    t_s: float,
    p_imu_cam: Sequence[float] | FloatArray,
    R_imu_cam: FloatArray,
    timeshift_s: float,
    intrinsics: Sequence[float] | FloatArray,
    distortion: Sequence[float] | FloatArray,
) -> FloatArray:
    """Estimate minus truth in the order of `PARAMETERS`; rotation: log(R_true^T R_estimate)."""
    R_true, p_true = run.rig.extrinsics_at(t_s)
    lens = run.rig.lens
    coefficients = np.array([*lens.distortion, lens.sixth_power])[: len(distortion)]  # plumb_bob has k3
    return np.concatenate(
        [
            np.asarray(p_imu_cam) - p_true,
            log_so3(R_true.T @ R_imu_cam),
            [timeshift_s - float(run.rig.timeshift_at(t_s))],
            np.asarray(intrinsics) - np.asarray(lens.intrinsics),
            np.asarray(distortion) - coefficients,
        ]
    )


class CalibratorSubject:
    """The product: `vical_daemon.estimation.calibrator.Calibrator`."""

    def __init__(self, options: CalibrationOptions, prior: CameraPrior, points_m: FloatArray | None) -> None:
        self.calibrator = _make_calibrator(options, prior, points_m)

    def add_imu(self, t_ns: int, gyro: FloatArray, force: FloatArray) -> None:
        """See `Subject`."""
        self.calibrator.add_imu(t_ns, gyro, force)

    def add_points(self, frame: PointsFrame) -> None:
        """See `Subject`."""
        self.calibrator.add_points(frame)
        self.calibrator.process()

    def finish(self) -> None:
        """See `Subject`."""
        self.calibrator.finish()

    def look(self, run: SimulatedRun, t_s: float, record: Record) -> Snapshot | None:
        """See `Subject`."""
        estimate = self.calibrator.estimate()
        status = str(estimate.status)
        record.events += [(t_s, event) for event in estimate.events]
        if not record.statuses or record.statuses[-1][1:] != (status, estimate.reason):
            record.statuses.append((t_s, status, estimate.reason))
        record.guidance = estimate.guidance
        if not estimate.cameras:
            return None
        camera = estimate.cameras[CAMERA]
        record.unobservable = list(camera.unobservable)
        pose = camera.T_imu_cam
        error = error_against_truth(
            run,
            t_s,
            pose.p_m,
            matrix_of_quaternion(pose.q_wxyz),
            camera.timeshift_cam_imu_s,
            camera.intrinsics,
            camera.distortion,
        )
        covariance = np.asarray(camera.calibration_covariance)
        extra = {
            "nis_per_dof": estimate.nis_per_dof,
            "rejected": estimate.rejected_fraction,
            "corner_sigma_px": camera.corner_sigma_px,
        }
        if not self.calibrator.options.target_free:  # there the world is a frame of its own
            gravity = np.asarray(estimate.gravity_world_mps2) - run.rig.gravity_world_mps2
            extra["gravity_error"] = float(np.linalg.norm(gravity))
        return Snapshot(t_s, status, error, covariance, extra)


def _make_calibrator(options: CalibrationOptions, prior: CameraPrior, points_m: FloatArray | None) -> Any:
    if options.target_free:
        from vical_daemon.estimation.target_free import TargetFreeCalibrator

        return TargetFreeCalibrator(options, {CAMERA: prior})
    from vical_daemon.estimation.calibrator import Calibrator

    return Calibrator(options, {CAMERA: prior}, points_m)


def matrix_of_quaternion(q_wxyz: Sequence[float]) -> FloatArray:
    """Rotation matrix of a Hamilton quaternion."""
    w, v = q_wxyz[0], np.asarray(q_wxyz[1:])
    angle = 2 * np.arctan2(np.linalg.norm(v), w)
    return exp_so3(v / max(float(np.linalg.norm(v)), 1e-300) * angle)


@dataclass(frozen=True)
class StartErrors:
    """How wrong the starting values are.

    Attributes:
        focal_relative: Of the focal length, one-sigma.
        centre_px: Of the image centre, one-sigma.
        extrinsics: (angle rad, distance m), exact sizes in random directions; None: no mounting given.
        timeshift_s: Size, of random sign; None: no time shift given.
    """

    focal_relative: float = 0.02
    centre_px: float = 5.0
    extrinsics: tuple[float, float] | None = None
    timeshift_s: float | None = None


def camera_prior(run: SimulatedRun, seed: int, errors: StartErrors, *, exact_lens: bool) -> CameraPrior:
    """Starting values: the truth with errors."""
    rng = np.random.default_rng([seed, 51])
    lens = run.rig.lens
    intrinsics, distortion = np.array(lens.intrinsics), lens.distortion
    if not exact_lens:
        intrinsics[:2] *= 1 + errors.focal_relative * rng.standard_normal()
        intrinsics[2:] += errors.centre_px * rng.standard_normal(2)
        distortion = (0.0, 0.0, 0.0, 0.0)
    extrinsics = None
    if errors.extrinsics is not None:
        axis, offset = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        angle_rad, distance_m = errors.extrinsics
        extrinsics = (run.rig.R_imu_cam @ exp_so3(angle_rad * axis), run.rig.p_imu_cam + distance_m * offset)
    shift = None
    if errors.timeshift_s is not None:
        shift = run.rig.timeshift_cam_imu_s + errors.timeshift_s * float(rng.choice([-1.0, 1.0]))
    f = tuple(float(x) for x in intrinsics)
    return CameraPrior(
        lens.resolution,
        (f[0], f[1], f[2], f[3]),
        lens.model,
        distortion,
        extrinsics,
        shift,
        run.rig.readout_s,
        run.rig.readout_axis if run.rig.readout_s else "",
    )


def assumed_gravity_mps2(seed: int) -> float:
    """Magnitude of gravity that an estimator assumes, as far from the true one as its prior says."""
    known = CalibrationOptions()
    rng = np.random.default_rng([seed, 980665])
    return known.gravity_mps2 + known.gravity_sigma_mps2 * float(rng.standard_normal())


def imu_noise(run: SimulatedRun) -> ImuNoise:
    """The densities that the data were made with."""
    d = run.rig.densities
    return ImuNoise(d.gyro, d.gyro_walk, d.accel, d.accel_walk, run.options.imu_rate_hz)


def nees(error: FloatArray, covariance: FloatArray, size: int) -> float:
    """Normalised squared error of the first `size` parameters; NaN where the covariance is not positive."""
    block = covariance[:size, :size]
    scale = np.sqrt(np.diag(block))
    if not np.all(scale > 0):
        return float("nan")
    e = error[:size] / scale
    try:
        return float(e @ np.linalg.solve(block / np.outer(scale, scale), e))
    except np.linalg.LinAlgError:
        return float("nan")
