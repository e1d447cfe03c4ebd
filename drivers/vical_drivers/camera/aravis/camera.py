"""GenICam cameras through Aravis, grabbed by a small process under the system's Python.

The arrival of a frame's first packet dates it. The camera's own stamps (nanoseconds of its clock) take
the network's jitter off: the lower envelope of (camera's stamp, first packet) is the way of the luckiest
packets. No one-way method can see the constant part of that way, so what is published is still the first
packet, only without its jitter, and half an exposure earlier.
"""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np

from vical_drivers.camera.aravis.dating import CameraClock
from vical_drivers.camera.aravis.process import OPEN_TIMEOUT_S, GrabberProcess
from vical_drivers.camera.formats import FORMATS, CorruptImageError, FrameDecoder, Layout, PixelFormat
from vical_drivers.camera.frame_maker import FrameMaker
from vical_drivers.camera.losses import SequenceCounter
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.stamps import SIGMA_NS, Anchor, RawStamp
from vical_drivers.closing import Closing
from vical_drivers.errors import (
    DeviceLostError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DriverError,
)
from vical_drivers.samples import DeviceInfo, Frame, SourceStats

_log = logging.getLogger(__name__)

_FORMATS: dict[str, PixelFormat] = {
    "Mono8": FORMATS["GREY"],
    "Mono10": FORMATS["Y10"],
    "Mono12": FORMATS["Y12"],
    "Mono16": FORMATS["Y16"],
    "RGB8": FORMATS["RGB3"],
    "RGB8Packed": FORMATS["RGB3"],
    "BGR8": FORMATS["BGR3"],
    "BGR8Packed": FORMATS["BGR3"],
    **{
        f"Bayer{name}8": PixelFormat(f"Bayer{name}8", Layout.BAYER, order=order)
        for name, order in (("RG", "RGGB"), ("GB", "GBRG"), ("GR", "GRBG"), ("BG", "BGGR"))
    },
}


class AravisCamera(Closing):
    """A `FrameSource` over one GenICam camera.

    Args:
        name: Aravis' id ("Vendor-serial") or network address; "": the only camera there is.
        settings: What is asked of the camera.
        interfaces: Further interfaces of Aravis to search ("Fake").

    Raises:
        DriverError: One line, with what to try.
    """

    def __init__(
        self, name: str, settings: CameraSettings | None = None, *, interfaces: tuple[str, ...] = ()
    ) -> None:
        self._settings = s = settings or CameraSettings()
        self._request = {
            "id": name, "width": s.width, "height": s.height, "rate_hz": s.rate_hz, "gain": s.gain,
            "pixel_format": s.pixel_format, "exposure_s": s.exposure_s, "controls": dict(s.controls),
            "interfaces": list(interfaces),
        }  # fmt: skip
        self._frames = FrameMaker(s)
        self._closed = False
        self._grabber: GrabberProcess | None = None
        self._open()

    def _open(self) -> None:
        self._grabber = grabber = GrabberProcess(self._request)
        try:
            answer = grabber.receive(OPEN_TIMEOUT_S)
            if answer is None:
                raise DeviceTimeoutError(f"aravis:{self._request['id']}: no answer from the camera")
            self._info = self._describe(answer[0])
            self._decode = self._make_decoder(answer[0])
        except BaseException:
            self._drop()
            raise
        self._frames.stamper.set_exposure(_ns(answer[0]["exposure_s"]), 0)
        self._counter = SequenceCounter(16, skips_zero=True)
        self._sequence = 0
        self._clock = CameraClock(self._info.details["uri"])

    def _describe(self, opened: dict[str, Any]) -> DeviceInfo:
        device = opened["device"]
        _, _, width, height = opened["region"]
        exposure_s = opened["exposure_s"]
        not_told = "automatic" if opened["automatic"] else "unknown"
        return DeviceInfo(
            kind="camera",
            model=f"{device['vendor']} {device['model']}",
            serial_number=device["serial_number"] or device["id"],
            path=device["address"] or "",
            protocol="aravis",
            details={
                "uri": f"aravis:{device['id']}",
                "transport": device["protocol"],
                "pixel_format": opened["pixel_format"],
                "size": f"{width}x{height}",
                "rate_hz": f"{opened['rate_hz']:g}",
                "encoding": self._settings.encoding,
                "exposure_s": not_told if exposure_s is None else f"{exposure_s:g}",
            },
        )

    def _make_decoder(self, opened: dict[str, Any]) -> FrameDecoder:
        name = opened["pixel_format"]
        _, _, width, height = opened["region"]
        uri = self._info.details["uri"]
        if name not in _FORMATS:
            raise DeviceRefusedError(f"{uri}: pixel format {name} is none of {', '.join(_FORMATS)}")
        wanted = (self._settings.width, self._settings.height)
        if wanted[0] is not None and wanted != (width, height):
            raise DeviceRefusedError(f"{uri}: asked for {wanted[0]}x{wanted[1]}, got {width}x{height}")
        try:
            return FrameDecoder(_FORMATS[name], width, height, encoding=self._settings.encoding)
        except ValueError as error:
            raise DeviceRefusedError(f"{uri}: {error}") from error

    def _drop(self) -> None:
        grabber, self._grabber = self._grabber, None
        if grabber is not None:
            grabber.close()

    @property
    def info(self) -> DeviceInfo:
        """Who the camera is and, in `details`, what was obtained of what was asked."""
        return self._info

    def set_exposure(self, exposure_s: float) -> None:
        """Ask for another exposure time; frames that began before it took effect keep the old one."""
        if self._grabber is None:
            raise DeviceLostError(f"{self._info.details['uri']}: the camera is away")
        self._grabber.send({"exposure_s": exposure_s})

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s` without one.

        Raises:
            DeviceLostError: The camera or its process went away; call again.
        """
        deadline = time.monotonic() + timeout_s
        try:
            if self._grabber is None:
                self._come_back()
            while True:
                frame = self._next(max(0.0, deadline - time.monotonic()))
                if frame is not None or time.monotonic() >= deadline:
                    return frame
        except DeviceLostError:
            self._drop()
            raise

    def _come_back(self) -> None:
        if self._closed:
            raise DeviceLostError(f"{self._info.details['uri']}: the camera is closed")
        try:
            self._open()  # searching the network takes its time: no further wait is needed
        except DriverError as error:
            raise DeviceLostError(f"{self._info.details['uri']}: not back yet ({error})") from error
        self._frames.reopened()

    def _next(self, timeout_s: float) -> Frame | None:
        assert self._grabber is not None
        message = self._grabber.receive(timeout_s)
        if message is None:
            return None
        fields, data = message
        if fields["kind"] == "exposure":
            self._frames.stamper.set_exposure(_ns(fields["exposure_s"]), fields["t_ns"])
            self._clock.forget()  # the way from the camera's stamp to its first packet is another now
            return None
        missing = self._counter.missing_before(fields["frame_id"])
        self._sequence += missing + 1
        self._frames.numbered(fields["first_packet_ns"], missing)
        if not fields["whole"]:
            self._frames.statistics.count(f"buffers_{fields['status'].replace('-', '_')}")
            self._frames.lost()
            return None
        return self._finish(fields, data)

    def _finish(self, fields: dict[str, Any], data: memoryview) -> Frame | None:
        raw = self._raw_stamp(fields["device_ns"], fields["first_packet_ns"])
        try:
            image = self._decode(np.frombuffer(data, dtype=np.uint8))
        except CorruptImageError as error:
            _log.debug("corrupt image: %s", error)
            self._frames.count_corrupt("corrupt_images")
            self._frames.lost()
            return None
        return self._frames.frame(image, raw, sequence=self._sequence, t_arrival_ns=fields["arrival_ns"])

    def _raw_stamp(self, device_ns: int, first_packet_ns: int) -> RawStamp:
        before = self._clock.settings
        dated = self._clock.date(device_ns, first_packet_ns)
        if self._clock.settings != before:
            self._frames.statistics.count("clock_restarts")
        if dated is None:
            return RawStamp(first_packet_ns, Anchor.FIRST_PACKET, None, SIGMA_NS[Anchor.FIRST_PACKET])
        forced = self._settings.stamp
        anchor = Anchor.FIRST_PACKET if forced in ("auto", "raw") else Anchor(forced)
        return RawStamp(dated[0], anchor, f"{anchor.value}(device-clock)", dated[1])

    def stats(self) -> SourceStats:
        """Counters since the source was opened."""
        return self._frames.statistics.snapshot(clock_skew_ppm=-self._clock.skew * 1e6)

    def close(self) -> None:
        """Stop the camera and end its process; may be called twice."""
        self._closed = True
        self._drop()


def _ns(seconds: float | None) -> int | None:
    return None if seconds is None else round(seconds * 1e9)


def list_aravis_cameras(interfaces: tuple[str, ...] = ()) -> list[DeviceInfo]:
    """Return the GenICam cameras that Aravis finds on network and USB (it takes about a second).

    Raises:
        MissingLibraryError: Aravis' bindings are not installed.
    """
    grabber = GrabberProcess({"list": True, "interfaces": list(interfaces)})
    try:
        answer = grabber.receive(OPEN_TIMEOUT_S)
    finally:
        grabber.close()
    devices = [] if answer is None else answer[0]["devices"]
    return [
        DeviceInfo(
            kind="camera",
            model=f"{d['vendor']} {d['model']}",
            serial_number=d["serial_number"] or d["id"],
            path=d["address"] or "",
            protocol="aravis",
            details={"uri": f"aravis:{d['id']}", "transport": d["protocol"]},
        )
        for d in devices
    ]
