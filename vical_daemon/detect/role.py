"""Role detect: images in, target points or feature tracks out. What a slow detector drops: `image_queue`."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample, Subscription
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    MessageError,
    admit_image,
    decode_compressed_image,
    encode_points,
)
from vical_daemon.bus.outgoing import Message, publish
from vical_daemon.config.model import Config
from vical_daemon.config.priors import camera_prior
from vical_daemon.detect.detectors import Detect, board_words, make_detector
from vical_daemon.detect.flow_aid import GyroAid
from vical_daemon.detect.image_queue import ImageQueue
from vical_daemon.detect.wanted import WantedImages
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.service import notify
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import WallClock, service_clock

_NO_IDS, _NO_POINTS = np.zeros(0, np.int64), np.zeros((0, 2))
JOIN_S = 3.0
STUCK_S = 20.0
"""A detector that works on one image for this long, s, is stuck. A detection takes 0.1 s; on a slow card
loading OpenCV takes some seconds."""
_SET_BACK_NS = 2e9  # longer than any queue delays an image
_log = logging.getLogger(__name__)


class DetectRole:
    """Finds the points in the images of one camera. No I/O.

    Args:
        config: The rig.
        camera: Name of the camera.
        detector: Finds points in one image; None: that of the config.
        prior: Prior of the camera; None: that of the config.

    Attributes:
        wrong_target: What the images contradict in the target file, one line; "": nothing is known.
        refused: Number of images of another size than that of the config.
        malformed: Number of images that cannot be read.
    """

    def __init__(
        self,
        config: Config,
        camera: str,
        detector: Detect | None = None,
        prior: CameraPrior | None = None,
    ) -> None:
        self.camera = camera
        free = config.calibration.mode == "target_free"
        self.key = (topics.TRACKS if free else topics.POINTS).key(config.rig, camera)
        self.aid: GyroAid | None = None
        if free and config.imus:
            self.aid = GyroAid(config, camera, prior or camera_prior(config, camera))
        predictor = self.aid.predictor if self.aid else None
        self._make: Callable[[], Detect] = lambda: (
            detector or make_detector(config, predictor, self._on_wrong_target)
        )
        self.wrong_target = ""
        self._looks_for = partial(board_words, config)
        self._detect = self._make()
        self._size = (prior or camera_prior(config, camera)).resolution
        self._other_size: tuple[int, int] | None = None  # of the last image, if not that
        self._problem = self._why_malformed = ""
        self.rate_hz = config.calibration.detect_rate_hz  # images per second at most
        self._next_ns = 0.0
        self._images = self._found = self._skipped = self._failures = self.malformed = self.refused = 0
        self._busy_s = 0.0

    def points(self, sample: Sample) -> list[Message]:
        """Return the points message of one image, also if no point was found; [] if the image was skipped."""
        begin_s = time.perf_counter()
        try:
            stamp_ns, image = _decode(sample)
        except (MessageError, ValueError) as error:
            self.malformed += 1
            self._why_malformed = str(error)
            return []
        height, width = image.shape[:2]
        self._other_size = None if (width, height) == self._size else (width, height)
        if self._other_size is not None:  # another lens, to an estimator that knows pixels only
            self.refused += 1
            return []
        if not self._due(stamp_ns):
            self._skipped += 1
            return []
        self._images += 1
        try:
            if self.aid is not None:
                self.aid.prepare()
            found = self._detect(image, stamp_ns)
        except Exception as error:  # OpenCV raises on unusual images
            self._failed(error)
            return []
        points: tuple[Any, Any, Any] = (_NO_IDS, _NO_POINTS, None)
        if found is not None:
            self._found += 1
            points = (found.ids, found.uv_px, found.sigma_px)
        payload = encode_points(stamp_ns, self.camera, *points, (width, height))
        self._busy_s += time.perf_counter() - begin_s
        return [(self.key, payload)]

    def _due(self, stamp_ns: int) -> bool:
        """Whether `rate_hz` allows an image so soon after the last one."""
        ahead_ns, period_ns = self._next_ns - stamp_ns, 1e9 / self.rate_hz
        if 0.5 * period_ns < ahead_ns < _SET_BACK_NS:
            return False
        if ahead_ns >= _SET_BACK_NS:  # the clock was set back, or the stamp before was wrong
            self._next_ns = stamp_ns
        self._next_ns = max(self._next_ns + period_ns, stamp_ns)
        return True

    def _failed(self, error: Exception) -> None:
        """Replace the detector; log each problem once."""
        self._failures += 1
        text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        if text != self._problem:
            self._problem = text
            _log.error("%s: the detector failed and starts again: %s", self.camera, text)
            line = f"{self.camera}: the detector failed and starts again: {text}"
            notify.event("detector_restarted", line, level="warning", camera=self.camera)
        self._detect = self._make()

    def _on_wrong_target(self, text: str) -> None:
        self.wrong_target = text
        line = f"{self.camera}: {text}"
        _log.warning("%s", line)
        notify.event("wrong_target", line, level="warning", camera=self.camera)

    def status(self, dropped: int = 0, busy_s: float = 0.0) -> DiagnosticStatus:
        """Return the health of the detector.

        Args:
            dropped: Images that it had no time for.
            busy_s: Time spent on the current image.
        """
        share = self._found / self._images if self._images else 0.0
        values = {
            "images": str(self._images),
            "with_points": str(self._found),
            "skipped": str(self._skipped),
            "dropped": str(dropped),
            "malformed": str(self.malformed),
            "of_another_size": str(self.refused),
            "failures": str(self._failures),
            "detection_ms": f"{1e3 * self._busy_s / self._images if self._images else 0.0:.2f}",
        } | ({"wrong_target": self.wrong_target} if self.wrong_target else {})
        if busy_s > STUCK_S:
            text = f"stuck: at one image for {busy_s:.0f} s"
            return DiagnosticStatus(Level.STALE, f"detect/{self.camera}", text, "", values)
        if self._other_size is not None:
            found, size = ("{} x {}".format(*one) for one in (self._other_size, self._size))
            text = f"images are {found} px, not {size} as in the config: not used"
            return DiagnosticStatus(Level.ERROR, f"detect/{self.camera}", text, "", values)
        if self.malformed and not self._images:
            text = f"none of {self.malformed} images can be read: {self._why_malformed}"
            return DiagnosticStatus(Level.ERROR, f"detect/{self.camera}", text, "", values)
        message = f"{share:.0%} of {self._images} images show points"
        level = Level.WARN if self._images > 50 and share < 0.1 else Level.OK
        if self._images > 50 and dropped > 0.1 * (self._images + dropped):
            level, ms = Level.WARN, 1e3 * self._busy_s / self._images
            message += f"; {dropped} were dropped: this computer is too slow for them ({ms:.0f} ms an image)"
        if not self._found and level is Level.WARN and (board := self._looks_for()):
            values["looks_for"] = board
            message += f"; looked for: {board}"
        if self.wrong_target:
            level, message = Level.ERROR if share < 0.1 else Level.WARN, self.wrong_target
        return DiagnosticStatus(level, f"detect/{self.camera}", message, "", values)


def attach_aid(bus: Bus, role: DetectRole) -> list[Subscription]:
    """Subscribe a role that tracks natural features to gyro and calibration; [] for other roles."""
    if role.aid is None:
        return []
    return [
        bus.subscribe(role.aid.imu_key, role.aid.take_imu),
        bus.subscribe(role.aid.calibration_key, role.aid.take_calibration),
    ]


def _decode(sample: Sample) -> tuple[int, Any]:
    """Return the stamp and the pixels of a raw or compressed image."""
    parsed = topics.parse_key(sample.key)
    if parsed is not None and parsed.topic is topics.COMPRESSED:
        from vical_daemon.vision import image_codec

        message = decode_compressed_image(sample.payload)
        return message.stamp_ns, image_codec.decode_image(np.frombuffer(message.data, np.uint8))
    image = admit_image(sample.payload)
    return image.stamp_ns, image.pixels()


def run(config: Config, bus: Bus, stop: threading.Event, *, clock: WallClock | None = None) -> None:
    """Detect in the images of every camera to be calibrated until `stop`.

    Args:
        config: The rig.
        bus: Where images come from and points go.
        stop: Ends the role.
        clock: Monotonic to UNIX time; None: the clock that all processes of the service share.
    """
    clock = clock or service_clock()
    detectors = _Detectors(config, bus, stop)
    detectors.thread.start()
    StatusSender(config.rig, "detect", bus, clock).run_until(stop, detectors.statuses)
    detectors.close()


class _Detectors:
    """Thread that takes the images of all cameras in turn, detects, and publishes.

    Threads of one process hardly compute in parallel in Python. With one for each camera, four cameras left
    the estimator in the same process a fifth of what it needed.
    """

    def __init__(self, config: Config, bus: Bus, stop: threading.Event) -> None:
        self._bus, self._stop = bus, stop
        self._queue = ImageQueue(config.calibration_cameras)
        self._cameras = {name: _Camera(config, name, bus, self._queue) for name in config.calibration_cameras}
        self._busy: tuple[str, float] | None = None  # camera of the current image, and since when
        self.thread = threading.Thread(target=self._run, name="detect", daemon=True)

    def close(self) -> None:
        """End the subscriptions and wait for the thread."""
        for camera in self._cameras.values():
            camera.close()
        self.thread.join(JOIN_S)

    def statuses(self) -> list[DiagnosticStatus]:
        """Return the health of each camera's detector."""
        name, since_s = self._busy or ("", 0.0)
        busy_s = time.monotonic() - since_s
        return [camera.status(busy_s if k == name else 0.0) for k, camera in self._cameras.items()]

    def _run(self) -> None:
        while not self._stop.is_set():
            for camera in self._cameras.values():
                camera.follow_wishes()
            taken = self._queue.take(0.2)
            if taken is not None:
                name, sample = taken
                self._busy = name, time.monotonic()  # stays set if the thread ends or hangs
                publish(self._bus, self._cameras[name].role.points(sample))
                self._busy = None


class _Camera:
    """One camera: its detector, and its images put into a queue.

    With `mode: verify` it has a subscription only while images are wanted.
    """

    def __init__(self, config: Config, name: str, bus: Bus, queue: ImageQueue) -> None:
        self.role = DetectRole(config, name)
        self._bus, self._queue, self._name = bus, queue, name
        self._key = topics.IMAGE.key(config.rig, name)
        self._lost = 0  # on the bus, by subscriptions that were closed
        self._images: Subscription | None = None
        self._aid: list[Subscription] = []
        self._wanted: WantedImages | None = None
        if config.mode == "verify":
            self._wanted = WantedImages(bus, topics.VERIFY.key(config.rig, name))
        else:
            self._open()

    def close(self) -> None:
        """End all subscriptions."""
        self._shut()
        if self._wanted is not None:
            self._wanted.close()

    def status(self, busy_s: float) -> DiagnosticStatus:
        """Return its health; `busy_s`: time spent on its current image, s."""
        lost, images = self._lost + self._queue.dropped[self._name], self._images
        return self.role.status(lost + (images.dropped if images else 0), busy_s)

    def follow_wishes(self) -> None:
        """Open or close the subscription as images are wanted."""
        if self._wanted is None:
            return
        rate_hz = self._wanted.rate_hz
        if rate_hz > 0.0:
            self.role.rate_hz = rate_hz
            if self._images is None:
                self._open()
        elif self._images is not None:
            self._shut()

    def _open(self) -> None:
        self._images = self._bus.subscribe(self._key, lambda sample: self._queue.put(self._name, sample))
        self._aid = attach_aid(self._bus, self.role)

    def _shut(self) -> None:
        images, self._images = self._images, None
        if images is not None:
            self._lost += images.dropped
            images.close()
        for subscription in self._aid:
            subscription.close()
        self._aid = []
        self._queue.clear(self._name)
