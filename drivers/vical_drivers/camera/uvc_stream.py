"""The metadata node of a USB camera, read beside its pictures."""

from __future__ import annotations

import contextlib
import logging
from collections import OrderedDict
from pathlib import Path
from typing import Self

from vical_drivers.camera import v4l2_abi as abi
from vical_drivers.camera.discovery import NodeEntry, metadata_node
from vical_drivers.camera.kernel import Kernel
from vical_drivers.camera.stamps import Anchor
from vical_drivers.camera.uvc import (
    ClockHealth,
    UvcClock,
    clock_frequency_hz,
    metadata_bytes,
    parse_metadata,
    plausible_capture,
)
from vical_drivers.camera.v4l2_node import DequeuedBuffer, VideoNode
from vical_drivers.camera.v4l2_stamp import RawStamp
from vical_drivers.errors import DriverError

_log = logging.getLogger(__name__)

_BUFFERS = 16
_KEEP = 32
"""Frames whose PTS is kept until their pictures come."""


class UvcMetadata:
    """Streams the metadata node and stamps frames by their PTS.

    Args:
        node: Open metadata node, already streaming.
        frequency_hz: Of the camera's clock; None where its descriptors do not say.
    """

    def __init__(self, node: VideoNode, frequency_hz: float | None) -> None:
        self._node = node
        self._clock = UvcClock(frequency_hz)
        self._pts: OrderedDict[int, int] = OrderedDict()
        self._said = ""

    @classmethod
    def open(cls, kernel: Kernel, camera: NodeEntry) -> Self | None:
        """Open the metadata node of a camera; None, with the reason logged, where that does not work."""
        entry = metadata_node(kernel, camera)
        if entry is None:
            _log.warning("no uvc metadata path=%s: frames are dated by their first packet", camera.path)
            return None
        node: VideoNode | None = None
        try:
            node = VideoNode(kernel, entry.path, abi.BUF_TYPE_META_CAPTURE)
            obtained = node.set_metadata_format("UVCH")
            if obtained == "UVCH":
                node.start(_BUFFERS)
                return cls(node, _frequency(kernel, camera))
            _log.warning("uvc metadata path=%s: no UVCH but %s", entry.path, obtained)
        except DriverError as error:
            _log.warning("uvc metadata unusable: %s: frames are dated by their first packet", error)
        if node is not None:
            node.close()
        return None

    def stamp(self, buffer: DequeuedBuffer) -> RawStamp | None:
        """Return the capture time of a frame by its PTS; None while the fit is not good enough."""
        self._take_all()
        pts = self._pts.pop(buffer.sequence, None)
        health = self._clock.health()
        reason = health.reason
        if not reason and pts is None:
            reason = "frames without PTS"
        t_ns = None if reason or pts is None else self._clock.to_host_ns(pts)
        if t_ns is not None and not plausible_capture(t_ns, buffer.t_ns):
            reason, t_ns = "PTS does not fit the arrival of the frames", None
        self._say(reason)
        if t_ns is None:
            return None
        return RawStamp(t_ns, Anchor.START_OF_EXPOSURE, "uvc-pts", round(health.residual_sigma_ns))

    def health(self) -> ClockHealth:
        """State of the clock fit."""
        return self._clock.health()

    def _take_all(self) -> None:
        """Read what the node has; it never blocks, and a lost node only ends the fit."""
        with contextlib.suppress(DriverError):
            while (buffer := self._node.dequeue()) is not None:
                mapping = self._node.mappings[buffer.index]
                for header in parse_metadata(metadata_bytes(mapping.array, buffer.bytes_used)):
                    self._clock.add(header)
                    if header.pts is not None:
                        self._pts[buffer.sequence] = header.pts
                self._node.queue(buffer.index)
        while len(self._pts) > _KEEP:
            self._pts.popitem(last=False)

    def _say(self, reason: str) -> None:
        if reason != self._said:
            self._said = reason
            state = f"fallback to first packet: {reason}" if reason else "uvc-pts in use"
            _log.info("uvc stamps path=%s %s", self._node.path, state)

    def close(self) -> None:
        """Stop and free the node; may be called twice."""
        self._node.close()


def _frequency(kernel: Kernel, camera: NodeEntry) -> float | None:
    # the descriptors are a file of the USB device, above the interface that the node belongs to
    device = (kernel.sysfs / "class/video4linux" / Path(camera.path).name / "device").resolve()
    for folder in (device, *list(device.parents)[:2]):
        with contextlib.suppress(OSError):
            return clock_frequency_hz((folder / "descriptors").read_bytes())
    return None
