"""Several cameras without a target: each calibrated by itself against the one IMU, and one answer of all.

Cameras that see the same scene could share its points, but need not see any of it together; what ties them
is the IMU. So the answers are those of one camera at a time, sigmas included, and go on while another camera
is blind, dark or unplugged; `converged` is the rig when all of them are. [docs/math/target_free.md]
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.guidance import Guidance
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.result import CalibrationEstimate, HeldOutCheck, ImuEstimate, Status
from vical_daemon.estimation.target_free import TargetFreeCalibrator
from vical_daemon.estimation.wording import guidance_text

# What the rig as a whole is: the first of these that any camera is.
_ORDER = (
    Status.INCONSISTENT,
    Status.DEGENERATE,
    Status.WAITING,
    Status.INITIALISING,
    Status.CONVERGING,
    Status.CONVERGED,
)

# About the imu, but estimated by each camera: the figures differ.
_EACH_BY_ITSELF = {EventKind.IMU_INTRINSICS, EventKind.ACCEL_LAG, EventKind.ACCEL_POSITIONS}


class TargetFreeRig:
    """Calibrates several cameras against one IMU, online, from feature tracks; see `TargetFreeCalibrator`.

    Args:
        options: Switches and noise.
        cameras: What is known about each, at least one.

    Raises:
        ValueError: No camera, or the size of a target to be found.
    """

    def __init__(self, options: CalibrationOptions, cameras: dict[str, CameraPrior]) -> None:
        if not cameras:
            raise ValueError("no camera to calibrate")
        self.parts = {name: TargetFreeCalibrator(options, {name: prior}) for name, prior in cameras.items()}
        self._strangers = 0  # images of cameras that nobody asked for
        self._silent: frozenset[str] = frozenset()  # cameras from which nothing comes now

    def stamps_known_to(self, sigma_s: float) -> None:
        """Take how well the imu's driver knows its device's clock now, one sigma, s."""
        for part in self.parts.values():
            part.stamps_known_to(sigma_s)

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> None:
        """Take one reading (imu clock, ns; rad/s; m/s^2)."""
        for part in self.parts.values():
            part.add_imu(t_imu_ns, gyro_rps, specific_force_mps2)

    def add_points(self, frame: PointsFrame) -> None:
        """Take the tracks of one image; those of unknown cameras are only counted."""
        part = self.parts.get(frame.camera)
        if part is None:
            self._strangers += 1
        else:
            part.add_points(frame)

    def do_without(self, cameras: frozenset[str]) -> None:
        """Wait for none of these cameras: nothing comes from them now."""
        self._silent = cameras

    @property
    def waiting(self) -> int:
        """Images that wait for inertial data."""
        return sum(part.waiting for part in self.parts.values())

    @property
    def left_out(self) -> dict[str, int]:
        """Readings (all cameras take the same) and images that were not used, by cause."""
        counts = [part.left_out for part in self.parts.values()]
        images = {name: sum(c[name] for c in counts) for name in ("images_ignored", "images_repeated")}
        images["images_ignored"] += self._strangers
        return counts[0] | images

    def process(self) -> list[FrameReport]:
        """Do what can be done with what has arrived; reports on the images of windows that are complete."""
        return _in_order(part.process() for part in self.parts.values())

    def finish(self) -> list[FrameReport]:
        """End of the data: everything that inertial data cover."""
        return _in_order(part.finish() for part in self.parts.values())

    @property
    def can_go_on(self) -> bool:
        """Whether another recording can go on with what is known of any camera."""
        return any(part.can_go_on for part in self.parts.values())

    def next_recording(self, *, common_clock: bool = True) -> None:
        """What comes from now on is another recording of the same rig."""
        for part in self.parts.values():
            part.next_recording(common_clock=common_clock)

    def estimate(self) -> CalibrationEstimate:
        """Return what is known now; takes the events since the last call along."""
        each = {name: part.estimate() for name, part in self.parts.items()}
        known = {name: e for name, e in each.items() if e.cameras or name not in self._silent}
        return together(known or each)

    def held_out(self) -> list[HeldOutCheck]:
        """Return nothing: there is no such check without a target."""
        return []


def together(estimates: dict[str, CalibrationEstimate]) -> CalibrationEstimate:
    """One answer of several cameras'.

    Args:
        estimates: By camera, at least one.

    Returns:
        All cameras; the status of the one that is behind, with its name before the reason; biases and
        matrices from the camera that knows them best.
    """
    all_ = list(estimates.values())
    status = min((e.status for e in all_), key=_ORDER.index)
    behind = {name: e for name, e in estimates.items() if e.status == status}
    asked = ((name, e.next_motion) for name, e in behind.items() if e.next_motion)
    camera, next_motion = next(asked, ("", Guidance()))
    if len(estimates) > 1:
        next_motion = replace(next_motion, camera=camera)
    longest = max(all_, key=lambda e: e.imu_samples)
    frames = np.array([max(e.frames, 1) for e in all_], np.float64)
    return CalibrationEstimate(
        t_ns=max(e.t_ns for e in all_),
        status=status,
        reason="; ".join(f"{name}: {e.reason}" for name, e in behind.items() if e.reason),
        progress=min(e.progress for e in all_),
        guidance=guidance_text(next_motion),
        duration_s=max(e.duration_s for e in all_),
        frames=sum(e.frames for e in all_),
        imu_samples=longest.imu_samples,
        cameras={name: camera for e in all_ for name, camera in e.cameras.items()},
        imu=_best_known([e.imu for e in all_ if e.imu is not None]),
        gravity_world_mps2=next((e.gravity_world_mps2 for e in all_ if e.gravity_world_mps2), []),
        nis_per_dof=float(np.average([e.nis_per_dof for e in all_], weights=frames)),
        rejected_fraction=float(np.average([e.rejected_fraction for e in all_], weights=frames)),
        events=_events(estimates),
        next_motion=next_motion,
        reading_hashes=longest.reading_hashes,
    )


def _best_known(imus: list[ImuEstimate]) -> ImuEstimate | None:
    return min(imus, key=lambda imu: sum(imu.gyro_bias_sigma_rps), default=None)


def _events(estimates: dict[str, CalibrationEstimate]) -> list[Event]:
    """All announcements; what concerns the imu is announced by each camera's part, and once is enough."""
    found: list[Event] = []
    for name, estimate in estimates.items():
        for event in estimate.events:
            alike = (replace(event, t_s=None) == replace(other, t_s=None) for other in found)
            if not event.camera and any(alike):
                continue
            found.append(event)
            if not event.camera and event.kind in _EACH_BY_ITSELF and len(estimates) > 1:
                found[-1] = replace(event, camera=name)
    return found


def _in_order(reports: Iterable[list[FrameReport]]) -> list[FrameReport]:
    return sorted((r for part in reports for r in part), key=lambda r: r.t_ns)
