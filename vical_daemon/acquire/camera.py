"""Role camera: one thread per camera, blocking read -> stamp (in the driver) -> bounded queue -> bus."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from vical_drivers.samples import Frame, FrameSource

from vical_daemon.acquire.device_loop import FrameReader
from vical_daemon.acquire.pipeline import DevicePipeline, StampOrder, run_pipelines, start_pipeline
from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import encode_image
from vical_daemon.config.model import LOG_SCHEME, CameraConfig, Config
from vical_daemon.service.wall_clock import WallClock, service_clock

QUEUE_DEPTH = 8  # images are large: 8 of 1.3 MB

OpenCamera = Callable[[CameraConfig], FrameSource]


class CameraEncoder:
    """Turns the frames of one camera into messages. No I/O.

    Args:
        rig: Name of the rig.
        name: Name of the camera.
        clock: Monotonic to UNIX time.
    """

    def __init__(self, rig: str, name: str, clock: WallClock) -> None:
        self.key = topics.IMAGE.key(rig, name)
        self._name, self._clock = name, clock
        self._order = StampOrder()
        self._dropped = 0
        self._rules: Counter[str] = Counter()
        self._exposure_ns: int | None = None

    def message(self, frame: Frame) -> bytes | None:
        """Return the message of one frame, stamped mid-exposure; None if its stamp does not increase."""
        self._dropped += frame.dropped_before
        if not self._order.admits(frame.t_exposure_mid_ns):
            return None
        self._rules[frame.stamp_rule] += 1
        self._exposure_ns = frame.exposure_ns
        stamp_ns = self._clock.unix_ns(frame.t_exposure_mid_ns)
        return encode_image(stamp_ns, self._name, frame.image, frame.encoding)

    def counters(self) -> dict[str, str]:
        """Return what the driver does not keep: stamp rules and how often, losses, the last exposure."""
        rules = ", ".join(f"{rule} ({count})" for rule, count in self._rules.items())
        counters = {
            "stamp_rule": rules,
            "frames_dropped": str(self._dropped),
            "stamps_backwards": str(self._order.backwards),
        }
        if self._exposure_ns is not None:
            counters["exposure_ms"] = f"{1e-6 * self._exposure_ns:.3f}"
        return counters


def open_camera(config: CameraConfig) -> FrameSource:
    """Open the device of the config, or play the recording that the config gives in its place (`playback`).

    Raises:
        DriverError: The device cannot be opened; one line.
    """
    if config.uri.startswith(LOG_SCHEME):
        from vical_daemon.acquire.playback import LogCamera

        return LogCamera(config.uri)
    from vical_drivers.camera import opening

    return opening.open_camera(config.uri, **driver_options(config))


def driver_options(config: CameraConfig) -> dict[str, Any]:
    """Return the settings for the driver."""
    width, height = config.size
    return {
        "width": width,
        "height": height,
        "rate_hz": config.rate_hz,
        "pixel_format": config.pixel_format,
        "exposure_s": config.exposure_s,
        "gain": config.gain,
        "controls": config.controls,
        "decoder": _decompress,
        "assume_exposure_s": config.assume_exposure_s,
        "rolling_shutter": config.lens.readout_s > 0,
        "readout_s": config.lens.readout_s,
        "stamp": config.stamp,
        "borrow": True,  # the message is built before the next read, so that no second copy is needed
    }


def _decompress(data: npt.NDArray[np.uint8], *, colour: bool) -> npt.NDArray[np.uint8]:
    """Decompress a JPEG. Loads OpenCV only if a camera sends JPEGs."""
    from vical_daemon.vision import image_codec

    return image_codec.decode_image(data, colour=colour)


def run(
    config: Config,
    bus: Bus,
    stop: threading.Event,
    *,
    clock: WallClock | None = None,
    open_source: OpenCamera = open_camera,
) -> None:
    """Acquire from every camera of the config until `stop`.

    Args:
        config: The rig.
        bus: Where images and status go.
        stop: Ends the role.
        clock: Monotonic to UNIX time; None: the clock that all processes of the service share.
        open_source: Opens a device; the demo passes a rendered camera.
    """
    clock = clock or service_clock()

    def start(name: str, camera: CameraConfig) -> DevicePipeline[Frame]:
        return start_pipeline(
            f"camera/{name}", CameraEncoder(config.rig, name, clock),
            lambda: FrameReader(open_source(camera)), bus, stop, rate_hz=camera.rate_hz, depth=QUEUE_DEPTH,
        )  # fmt: skip

    run_pipelines(config.rig, "camera", (start(*item) for item in config.cameras.items()), bus, stop, clock)
