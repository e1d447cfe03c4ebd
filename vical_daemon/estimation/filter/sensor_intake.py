"""Where the data of a rig enter an estimator: its inertial readings and its images, on one time axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.inertial.imu_buffer import GAP_PERIODS, ImuBuffer
from vical_daemon.estimation.inertial.imu_intake import ImuIntake, Reading
from vical_daemon.estimation.measurements import IMAGE_GAP_S, PointsFrame
from vical_daemon.estimation.plausible import stamp_sigma_problem
from vical_daemon.estimation.result import NEARLY, CalibrationEstimate, Status

SEARCHED_S = 1.5
"""Steps of the time shift up to this size are found from the motion, s; of larger ones, the order in which
images and inertial readings arrive shows the greater part."""
_SHIFT = 6  # place of the time shift in `CameraEstimate.calibration_covariance`
_FOLLOW = 0.1  # by which usual interval and usual lead follow each new image
_SINKS = 1e-3  # share of the difference by which the largest lead sinks at each image with a smaller one
_AGREE = 5  # images in a row that show the same step
_SETTLED = 10  # images after which the usual lead is known; a role may hold back the first three


class SensorIntake:
    """Brings both streams onto one axis without steps (`ImuIntake`, `ImageIntake`), and results back from it.

    Attributes:
        stamp_sigma_s: How well the imu's driver knows its device's clock now, one sigma, s.
        images_ignored: Images that were not used; whoever leaves one out counts it.
    """

    def __init__(self) -> None:
        self.stamp_sigma_s = 0.0
        self.images_ignored = 0
        self._imu = ImuIntake()
        self._images = ImageIntake()
        self._followed_s: dict[str, float] = {}  # by camera: steps of its clock that were reported

    @property
    def buffer(self) -> ImuBuffer | None:
        """The readings, s since the first stamp; None before the first one."""
        return self._imu.buffer

    def longest_s(self, camera: str) -> float:
        """Longest interval between images of a camera that is no gap, s."""
        return self._images.longest_s(camera)

    @property
    def gap_end_s(self) -> float:
        """Where readings resumed after the latest gap, s; -inf: there was none."""
        return self._imu.gap_end_s

    @property
    def imu_stepped_s(self) -> float:
        """By how much all steps of the imu's stamps have moved them, s."""
        return self._imu.stepped_s

    @property
    def takes_images(self) -> bool:
        """Whether readings have come to which images can belong."""
        return self._imu.buffer is not None and not self._imu.between

    def stamps_known_to(self, sigma_s: float) -> bool:
        """Take `stamp_sigma_s`; nonsense is ignored: False."""
        if stamp_sigma_problem(sigma_s):
            return False
        self.stamp_sigma_s = sigma_s
        return True

    @property
    def left_out(self) -> dict[str, int]:
        """Readings and images that were not used, by cause."""
        images = {"images_ignored": self.images_ignored, "images_repeated": self._images.repeated}
        return {**self._imu.left_out, **images}

    def take_imu(
        self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]
    ) -> list[Reading]:
        """Take one reading; return those that were added (see `ImuIntake.take`)."""
        return self._imu.take(t_imu_ns, gyro_rps, specific_force_mps2)

    def take_image(self, frame: PointsFrame) -> float | None:
        """Take one image while `takes_images`.

        Returns:
            Its stamp, s since the first reading's, on an axis without steps; None: it is to be left out.
        """
        assert self._imu.buffer is not None
        stamp_s = (frame.t_cam_ns - self._imu.base_ns) * 1e-9
        jump = (self._imu.gap_end_s, self._imu.gap_s)
        t_cam_s = self._images.take(frame, stamp_s, self._imu.buffer.newest_s, jump)
        self._imu.saw_image(self._images.ahead_s(frame.camera))
        return t_cam_s

    def clock_was_set(self, camera: str) -> bool:
        """Whether the clock of a camera was set by seconds since this was asked last."""
        now_s = self._images.offset_s(camera)
        if now_s == self._followed_s.get(camera, 0.0):
            return False
        self._followed_s[camera] = now_s
        return True

    def imu_news(self) -> list[Event]:
        """What happened to the readings since the last call."""
        return self._imu.news(self.stamp_sigma_s)

    def image_news(self) -> list[Event]:
        """What happened to the images since the last call."""
        return self._images.news()

    def next_recording(self) -> None:
        """What comes from now on is another recording."""
        self._imu.next_recording()
        self._images, self._followed_s = ImageIntake(), {}

    def offset_s(self, camera: str) -> float:
        """Time shift by the stamps as they come now, minus that on the axis without steps, s."""
        return self._imu.shift_s + self._images.offset_s(camera)

    def by_present_stamps(self, estimate: CalibrationEstimate, limit_s: float) -> CalibrationEstimate:
        """Return an estimate made on axes without steps, with time shifts by the stamps as they come now.

        It has not converged while the stamps themselves are known worse than a time shift must be.

        Args:
            estimate: By axes without steps.
            limit_s: Largest sigma of a time shift that has converged, s.
        """
        stamp_sigma_s = self.stamp_sigma_s  # no image can show that
        estimated = any(e.timeshift_sigma_s for e in estimate.cameras.values())
        if estimate.status is Status.CONVERGED and estimated and stamp_sigma_s > limit_s:
            reason = f"stamps are known to {1e3 * stamp_sigma_s:.1f} ms only, by how they arrive"
            progress = min(estimate.progress, NEARLY)
            estimate = replace(estimate, status=Status.CONVERGING, reason=reason, progress=progress)
        cameras = {}
        for name, camera in estimate.cameras.items():
            shift_s, sigma_s = camera.timeshift_cam_imu_s + self.offset_s(name), camera.timeshift_sigma_s
            joint = [row.copy() for row in camera.calibration_covariance]
            if sigma_s:
                sigma_s = math.hypot(sigma_s, stamp_sigma_s)
                if joint:
                    joint[_SHIFT][_SHIFT] += stamp_sigma_s**2
            cameras[name] = replace(
                camera,
                timeshift_cam_imu_s=shift_s,
                timeshift_sigma_s=sigma_s,
                calibration_covariance=joint,
            )
        return replace(estimate, cameras=cameras)


@dataclass(slots=True)
class _Stream:
    """One camera.

    Attributes:
        newest: The last image taken.
        newest_s: Its stamp, s.
        lead_s: How far stamps usually are ahead of the newest inertial reading when an image arrives.
        offset_s: Added to the stamps, for the steps of the clock so far.
        usual_s: Interval between images.
        repeats: Copies of the newest image since.
        stepped_s: Steps that the latest images show.
        heard_s: Newest inertial reading when the last image arrived.
        images: Images so far.
        off_s: Lead of the last image minus the usual one.
        most_s: Largest lead, s: of images that did not have to wait. It sinks slowly, as clocks drift.
        last_s: Lead of the last image that was taken, s.
    """

    newest: PointsFrame
    newest_s: float
    lead_s: float
    offset_s: float = 0.0
    usual_s: float = np.inf
    repeats: int = 0
    stepped_s: list[float] = field(default_factory=list)
    heard_s: float = -np.inf
    images: int = 1
    off_s: float = 0.0
    most_s: float = -np.inf
    last_s: float = 0.0

    @property
    def longest_s(self) -> float:
        """Longest interval between images that is no gap, s; inf: not known yet."""
        return max(IMAGE_GAP_S, GAP_PERIODS * self.usual_s)

    def follow(self, lead_s: float) -> None:
        """Follow the lead of an image that was taken, s."""
        self.lead_s += _FOLLOW * (lead_s - self.lead_s)
        if lead_s > self.most_s - SEARCHED_S:  # else images wait for a busy detector
            self.most_s = max(lead_s, self.most_s + _SINKS * (lead_s - self.most_s))
        self.last_s = lead_s

    def is_set(self, lead_s: float, newest_imu_s: float, imu_jump_s: float) -> bool:
        """Whether an image shows a step of one of the clocks, for the first time or like the image before.

        Args:
            lead_s: Of the image, s.
            newest_imu_s: See `ImageIntake.take`.
            imu_jump_s: How far the stamps of readings jumped forwards since the last image, s: a gap, unless
                those of the images are now as far behind.
        """
        step_s = lead_s - self.last_s
        ahead = lead_s > self.most_s + SEARCHED_S
        back = step_s < -SEARCHED_S and lead_s + newest_imu_s < self.newest_s
        behind = step_s < -max(SEARCHED_S, 0.5 * imu_jump_s) and imu_jump_s > SEARCHED_S
        goes_on = bool(self.stepped_s) and abs(step_s - self.stepped_s[-1]) <= SEARCHED_S < abs(step_s)
        return ahead or back or behind or goes_on


@dataclass(slots=True)
class ImageIntake:
    """Looks at the images of all cameras as they arrive.

    A camera or driver that hangs delivers its last image again under new stamps; measured points never repeat
    to the last bit by themselves. Such images are left out: what remains is a gap like any other.

    A clock that is set by seconds shows in the order of arrival. From one image to the next, stamps are
    further ahead of the inertial readings than ever, or go back, or those of the readings jump. They are
    moved to where they were. Images that only come late are no sign of it: they wait for a busy detector, by
    seconds, and catch up when it drops some.

    Attributes:
        repeated: Images left out because they were the last one again.
    """

    repeated: int = 0
    _streams: dict[str, _Stream] = field(default_factory=dict)
    _news: list[Event] = field(default_factory=list)

    def take(
        self,
        frame: PointsFrame,
        t_cam_s: float,
        newest_imu_s: float,
        imu_jump: tuple[float, float] = (-np.inf, 0.0),
    ) -> float | None:
        """Look at one image.

        Args:
            frame: The image.
            t_cam_s: Its stamp, s.
            newest_imu_s: Stamp of the newest inertial reading, s.
            imu_jump: Where the stamps of readings last jumped forwards, and how far, s.

        Returns:
            Its stamp on an axis without steps, s; None where the image is to be left out.
        """
        stream = self._streams.get(frame.camera)
        if stream is None:
            lead_s = t_cam_s - newest_imu_s
            self._streams[frame.camera] = _Stream(frame, t_cam_s, lead_s, most_s=lead_s, last_s=lead_s)
            return t_cam_s
        if _same(stream.newest, frame):
            stream.repeats += 1
            self.repeated += 1
            return None
        t_s = t_cam_s + stream.offset_s
        jump_s = imu_jump[1] if imu_jump[0] > stream.heard_s else 0.0
        if not self._in_step(stream, frame.camera, t_s - newest_imu_s, newest_imu_s, jump_s):
            return None
        t_s = t_cam_s + stream.offset_s
        self._measure(stream, frame, t_s)
        return t_s

    def ahead_s(self, camera: str) -> float:
        """By how much more the last image was ahead of the newest inertial reading than usual, s."""
        return self._streams[camera].off_s if camera in self._streams else 0.0

    def _in_step(
        self, stream: _Stream, camera: str, lead_s: float, newest_imu_s: float, imu_jump_s: float
    ) -> bool:
        """Whether a stamp is in step with those before; a clock that has been set is followed."""
        heard, stream.heard_s = newest_imu_s > stream.heard_s, newest_imu_s
        stream.off_s = lead_s - stream.lead_s
        stream.images += 1
        if (
            stream.off_s > 0.0 and stream.images < _SETTLED
        ):  # the first ones came late, held back until believed
            stream.lead_s = stream.most_s = stream.last_s = lead_s
        if not stream.is_set(lead_s, newest_imu_s, imu_jump_s):
            if heard:
                stream.follow(lead_s)
            stream.stepped_s.clear()
            return True
        if not heard:  # no inertial data arrive: nothing to compare with
            stream.newest_s = lead_s + newest_imu_s
            return False
        step_s = lead_s - stream.last_s
        if stream.stepped_s and abs(step_s - stream.stepped_s[-1]) > SEARCHED_S:
            stream.stepped_s.clear()
        stream.stepped_s.append(step_s)
        if len(stream.stepped_s) < _AGREE:
            return False
        step_s = float(np.median(stream.stepped_s))
        stream.stepped_s.clear()
        stream.offset_s -= step_s
        stream.newest_s = np.nan
        self._news.append(Event(EventKind.STAMPS_STEPPED, camera, step_s))
        return True

    def _measure(self, stream: _Stream, frame: PointsFrame, t_s: float) -> None:
        """Follow the usual interval; report a gap.

        Where stamps are as much further ahead of the inertial readings, it is the clock, not a gap: a step
        of the time shift, and reported as that.
        """
        gap_s = t_s - stream.newest_s
        set_forwards = stream.off_s > 0.5 * gap_s
        if gap_s > stream.longest_s:  # the status counts single lost images
            kind = EventKind.IMAGE_REPEATED if stream.repeats else EventKind.IMAGE_GAP
            if not set_forwards:
                self._news.append(Event(kind, frame.camera, gap_s))
        elif gap_s > 0.0:
            seen = stream.usual_s
            stream.usual_s = gap_s if np.isinf(seen) else seen + _FOLLOW * (gap_s - seen)
        stream.newest, stream.newest_s, stream.repeats = frame, t_s, 0

    def offset_s(self, camera: str) -> float:
        """Time shift by the stamps as they come now, minus the time shift by the axis without steps, s."""
        return self._streams[camera].offset_s if camera in self._streams else 0.0

    def longest_s(self, camera: str) -> float:
        """Longest interval between images of a camera that is no gap, s; inf: not known yet."""
        return self._streams[camera].longest_s if camera in self._streams else np.inf

    def news(self) -> list[Event]:
        """Gaps and steps since the last call."""
        news, self._news = self._news, []
        return news


def _same(a: PointsFrame, b: PointsFrame) -> bool:
    """Whether two images show the same points at the same places, to the last bit; not for empty ones."""
    return len(a.ids) == len(b.ids) > 0 and bool(
        (a.ids == b.ids).all() and (np.asarray(a.uv_px) == np.asarray(b.uv_px)).all()
    )
