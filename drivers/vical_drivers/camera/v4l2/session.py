"""One opening of a V4L2 camera: format, controls, exposure, UVC metadata and buffers."""

from __future__ import annotations

import logging

from vical_drivers.camera.formats import FORMATS, FrameDecoder
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.controls import Controls
from vical_drivers.camera.v4l2.discovery import NodeEntry
from vical_drivers.camera.v4l2.exposure import apply_settings, is_automatic, read_exposure_ns
from vical_drivers.camera.v4l2.kernel import Kernel
from vical_drivers.camera.v4l2.negotiate import negotiate
from vical_drivers.camera.v4l2.node import NodeIdentity, ObtainedFormat, VideoNode
from vical_drivers.camera.v4l2.uvc_stream import UvcMetadata, hwtimestamps
from vical_drivers.errors import DeviceRefusedError, DriverError

_log = logging.getLogger(__name__)

_UVC_DRIVER = "uvcvideo"


class V4l2Session:
    """Everything about a camera that is made anew after a replug.

    Args:
        kernel: The system-call boundary.
        entry: Which node.
        settings: What is asked of the camera.

    Attributes:
        automatic: The camera chooses its exposure itself.
        stamped_ns: The kernel's last stamp, CLOCK_MONOTONIC; None: there was none.

    Raises:
        DriverError: It cannot be opened, or refuses what is asked.
    """

    def __init__(self, kernel: Kernel, entry: NodeEntry, settings: CameraSettings) -> None:
        self.metadata: UvcMetadata | None = None
        self.stamped_ns: int | None = None
        self.node = VideoNode(kernel, entry.path)
        try:
            self.identity: NodeIdentity = self.node.identity()
            if not self.identity.captures_video:
                raise DeviceRefusedError(_no_capture(entry.path, self.identity))
            self.format: ObtainedFormat
            self.format, self.rate_hz = negotiate(self.node, settings)
            self.decode = _decoder(entry.path, self.format, settings)
            self.controls = Controls(kernel, self.node)
            apply_settings(self.controls, settings)
            self.exposure_ns = read_exposure_ns(self.controls)
            self.automatic = is_automatic(self.controls)
            self._watch_exposure()
            self.uvc_hwtimestamps = False
            if self.identity.driver == _UVC_DRIVER and settings.stamp == "auto":
                self.uvc_hwtimestamps = hwtimestamps(kernel)
                self.metadata = UvcMetadata.open(kernel, entry)
            self.buffers = self.node.start(settings.ring_size(self.rate_hz))
        except BaseException:
            self.close()
            raise

    def _watch_exposure(self) -> None:
        """Ask to be notified when somebody else changes the exposure; not every driver can."""
        for control_id in (abi.CID_EXPOSURE_ABSOLUTE, abi.CID_EXPOSURE_AUTO):
            if self.controls.find(control_id) is not None:
                try:
                    subscription = abi.EventSubscription(type=abi.EVENT_CTRL, id=control_id)
                    self.node.request(abi.VIDIOC_SUBSCRIBE_EVENT, subscription, "report changes")
                except DriverError as error:
                    _log.debug("no control events: %s", error)

    def close(self) -> None:
        """Stop streaming and free the node and its metadata."""
        if self.metadata is not None:
            self.metadata.close()
        self.node.close()


def _decoder(path: str, fmt: ObtainedFormat, settings: CameraSettings) -> FrameDecoder:
    try:
        return FrameDecoder(
            FORMATS[fmt.pixel_format],
            fmt.width,
            fmt.height,
            stride=fmt.stride,
            encoding=settings.encoding,
            decoder=settings.decoder,
        )
    except ValueError as error:
        raise DeviceRefusedError(f"{path}: {error}") from error


def _no_capture(path: str, identity: NodeIdentity) -> str:
    if identity.capabilities & abi.CAP_VIDEO_CAPTURE_MPLANE:
        return f"{path}: {identity.card} has multi-planar buffers only, which are not supported"
    what = "metadata" if identity.captures_metadata else "no pictures"
    return f"{path}: this node of {identity.card} delivers {what}; try the camera's other /dev/video node"
