"""The metadata node of a USB camera, read together with its images."""

from __future__ import annotations

import contextlib
import logging
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import Self

from vical_drivers.camera.stamps import Anchor, RawStamp
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.discovery import NodeEntry, metadata_node
from vical_drivers.camera.v4l2.kernel import Kernel
from vical_drivers.camera.v4l2.kernel_stamp import to_monotonic_ns
from vical_drivers.camera.v4l2.node import DequeuedBuffer, VideoNode
from vical_drivers.camera.v4l2.uvc import (
    ClockHealth,
    PayloadHeader,
    UvcClock,
    clock_frequency_hz,
    metadata_bytes,
    parse_metadata,
    plausible_capture,
)
from vical_drivers.errors import DriverError

_log = logging.getLogger(__name__)

_BUFFERS = 16
_KEEP = 32
"""Frames whose PTS is kept until their pictures come."""


class UvcMetadata:
    """Streams the metadata node and stamps frames by their PTS.

    Args:
        kernel: The system-call boundary.
        node: Open metadata node, already streaming.
        frequency_hz: Of the camera's clock; None where its descriptors do not say.
    """

    def __init__(self, kernel: Kernel, node: VideoNode, frequency_hz: float | None) -> None:
        self._kernel = kernel
        self._node = node
        self._clock = UvcClock(frequency_hz)
        self._pts: OrderedDict[int, int] = OrderedDict()
        self._said: set[str] = set()
        self._in_use = False
        self._driver_stamps_capture = hwtimestamps(kernel)

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
                return cls(kernel, node, _frequency(kernel, camera))
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
        if t_ns is not None and not plausible_capture(t_ns, self._arrived_ns(buffer)):
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
                    self._add(header)
                    if header.pts is not None:
                        self._pts[buffer.sequence] = header.pts
                self._node.queue(buffer.index)
        while len(self._pts) > _KEEP:
            self._pts.popitem(last=False)

    def _arrived_ns(self, buffer: DequeuedBuffer) -> int:
        """When the frame's first packet arrived, or at the latest did."""
        now = self._kernel.clocks()
        if self._driver_stamps_capture:
            return now.monotonic_ns
        return to_monotonic_ns(buffer.t_ns, now) or now.monotonic_ns

    def _add(self, header: PayloadHeader) -> None:
        t_ns = to_monotonic_ns(header.t_host_ns, self._kernel.clocks())
        if t_ns is not None:  # uvcvideo may run on CLOCK_REALTIME (its parameter "clock")
            self._clock.add(header if t_ns == header.t_host_ns else replace(header, t_host_ns=t_ns))

    def _say(self, reason: str) -> None:
        """Log each reason once until the fit is used again."""
        if not reason and not self._in_use:
            self._said.clear()
            _log.info("uvc stamps path=%s uvc-pts in use", self._node.path)
        elif reason and reason not in self._said:
            self._said.add(reason)
            _log.info("uvc stamps path=%s fallback to first packet: %s", self._node.path, reason)
        self._in_use = not reason

    def close(self) -> None:
        """Stop and free the node; may be called twice."""
        self._node.close()


def hwtimestamps(kernel: Kernel) -> bool:
    """Tell whether the uvcvideo module makes stamps of its own from PTS (its parameter hwtimestamps)."""
    try:
        text = (kernel.sysfs / "module/uvcvideo/parameters/hwtimestamps").read_text(encoding="ascii")
    except OSError:
        return False
    return text.strip() in ("1", "Y")


def _frequency(kernel: Kernel, camera: NodeEntry) -> float | None:
    # the descriptors are a file of the USB device, above the interface that the node belongs to
    device = (kernel.sysfs / "class/video4linux" / Path(camera.path).name / "device").resolve()
    for folder in (device, *list(device.parents)[:2]):
        with contextlib.suppress(OSError):  # not this one: one further up
            return clock_frequency_hz((folder / "descriptors").read_bytes())
    return None
