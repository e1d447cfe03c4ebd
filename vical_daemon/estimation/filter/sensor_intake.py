"""Where the data of a rig enter an estimator: its inertial readings and its images, on one time axis."""

from __future__ import annotations

from collections.abc import Sequence

from vical_daemon.estimation.events import Event
from vical_daemon.estimation.filter.image_intake import ImageIntake, by_present_stamps
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_intake import ImuIntake, Reading
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.plausible import stamp_sigma_problem
from vical_daemon.estimation.result import CalibrationEstimate


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
        """Return an estimate with time shifts by the stamps as they come now; `limit_s`: see there."""
        offsets = {name: self.offset_s(name) for name in estimate.cameras}
        return by_present_stamps(estimate, offsets, self.stamp_sigma_s, limit_s)
