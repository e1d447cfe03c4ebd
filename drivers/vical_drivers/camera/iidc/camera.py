"""FireWire (IIDC) cameras over libdc1394: frames dated by the bus clock.

A Point Grey camera writes the cycle time at which its shutter closed into each image; the bus clock is
read together with CLOCK_MONOTONIC at each frame and fitted (`cycle_clock`), and half the exposure is
taken off. Any other camera is dated by the first packet of its frame. libdc1394 itself reports neither lost
frames nor lost packets: the first are found by the embedded frame counter, or by gaps in the stamps, the
others as `completeness` says.
"""

from __future__ import annotations

import logging
import select
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from vical_drivers.camera.formats import Bytes, CorruptImageError, FrameDecoder, Image
from vical_drivers.camera.frame_maker import FrameMaker
from vical_drivers.camera.hotplug import wait_for_camera
from vical_drivers.camera.iidc import abi
from vical_drivers.camera.iidc.completeness import Completeness, check_completeness
from vical_drivers.camera.iidc.dating import FrameDating
from vical_drivers.camera.iidc.device import IidcDevice, frame_bytes, list_devices, pixel_format
from vical_drivers.camera.iidc.embedded import EmbeddedInfo, parse_embedded
from vical_drivers.camera.iidc.firewire import BusClock, find_node
from vical_drivers.camera.iidc.modes import IidcMode, set_mode
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.stamps import RawStamp
from vical_drivers.closing import Closing
from vical_drivers.errors import DeviceBusyError, DeviceLostError, DeviceRefusedError, DriverError
from vical_drivers.host_clocks import read_host_clocks
from vical_drivers.samples import DeviceInfo, Frame, SourceStats

_log = logging.getLogger(__name__)

list_iidc_cameras = list_devices

MIN_SILENCE_S = 1.0
SILENT_PERIODS = 5.0


@dataclass(frozen=True, slots=True)
class _Taken:
    """A frame out of the ring, dated and numbered, not yet decoded."""

    data: Bytes
    depth_bits: int
    info: EmbeddedInfo
    raw: RawStamp
    sequence: int
    missing_before: int
    t_arrival_ns: int


class IidcCamera(Closing):
    """A `FrameSource` over one FireWire camera.

    Args:
        name: GUID in hexadecimal; "": the only camera on the bus.
        settings: What is asked of the camera; applied again when it comes back. `borrow` is not used:
            the ring's memory goes away with the camera.

    Raises:
        DriverError: One line, with what to try.
    """

    def __init__(self, name: str, settings: CameraSettings | None = None) -> None:
        self._settings = settings or CameraSettings()
        self._guid = _parse_guid(name)
        self._frames = FrameMaker(self._settings)
        self._device: IidcDevice | None = None
        self._bus: BusClock | None = None
        self._closed = False
        self._open()
        self._info = self._describe()

    # -- life ----------------------------------------------------------------------------------------

    def _open(self) -> None:
        try:
            self._device = device = IidcDevice(self._guid)
            self._guid = device.guid
            path = find_node(device.guid)
            if path is None:
                raise DeviceLostError(f"{device.name}: the camera went away")
            self._bus = BusClock(path)
            self._mode: IidcMode = set_mode(device, self._settings)
            self._frame_info = device.embed()
            self._apply(device)
            self._fd = device.start(self._settings.ring_size(self._mode.rate_hz))
        except BaseException:
            self._drop()
            raise
        self._decode: FrameDecoder | None = None
        self._dating = FrameDating(self._settings.stamp, self._mode.rate_hz, self._frames.statistics)
        self._shutter_raw: int | None = None
        self._held: _Taken | None = None  # the next frame decides whether it is complete
        self._checked: deque[tuple[_Taken, str]] = deque()  # in order; with the fault, "" for a complete one
        self._t_alive_ns = time.monotonic_ns()

    def _apply(self, device: IidcDevice) -> None:
        wanted = self._settings
        if wanted.exposure_s is not None:
            device.set_absolute(abi.FEATURE_SHUTTER, wanted.exposure_s, "shutter", "s")
        if wanted.gain is not None:
            device.set_absolute(abi.FEATURE_GAIN, wanted.gain, "gain", "dB")
        for name, value in wanted.controls.items():
            register = _parse_register(device, name)
            device.set_register(register, int(value))
        self._frames.stamper.set_exposure(self._read_exposure(device), 0)

    def _read_exposure(self, device: IidcDevice) -> int | None:
        """Exposure in force, ns; None where the camera cannot tell it in seconds."""
        if not device.has_absolute(abi.FEATURE_SHUTTER):
            return None
        embeds_shutter = bool(self._frame_info)
        if device.is_automatic(abi.FEATURE_SHUTTER) and not embeds_shutter:
            return None
        return round(device.absolute(abi.FEATURE_SHUTTER) * 1e9)

    def _drop(self) -> None:
        device, self._device = self._device, None
        bus, self._bus = self._bus, None
        if device is not None:
            device.close()
        if bus is not None:
            bus.close()

    def _come_back(self, timeout_s: float) -> None:
        try:
            self._open()
        except DriverError as error:
            wait_for_camera(timeout_s, ("firewire",))
            raise DeviceLostError(f"iidc:{self._guid:016x}: the camera is not back yet ({error})") from error
        self._frames.reopened()
        _log.info("camera back guid=%016x", self._guid)

    def close(self) -> None:
        """Stop the camera and free the bus; may be called twice."""
        self._closed = True
        self._drop()

    # -- who and how -----------------------------------------------------------------------------------

    @property
    def info(self) -> DeviceInfo:
        """Who the camera is and, in `details`, what was obtained of what was asked."""
        return self._info

    def _describe(self) -> DeviceInfo:
        device, bus = self._need()
        exposure_ns = self._frames.stamper.exposure_ns
        settable = device.has_absolute(abi.FEATURE_SHUTTER)
        not_told = "automatic" if settable and device.is_automatic(abi.FEATURE_SHUTTER) else "unknown"
        return DeviceInfo(
            kind="camera",
            model=device.vendor_and_model,
            serial_number=f"{device.guid:016x}",
            path=bus.path,
            protocol="iidc",
            details={
                "uri": device.name,
                "pixel_format": self._mode.coding,
                "size": f"{self._mode.width}x{self._mode.height}",
                "rate_hz": f"{self._mode.rate_hz:g}",
                "encoding": self._settings.encoding,
                "exposure_s": not_told if exposure_ns is None else f"{exposure_ns * 1e-9:g}",
                "embedded_stamp": "yes" if self._frame_info else "no",
            },
        )

    def _need(self) -> tuple[IidcDevice, BusClock]:
        if self._device is None or self._bus is None:
            state = "closed" if self._closed else "away"
            raise DeviceLostError(f"iidc:{self._guid or 0:016x}: the camera is {state}")
        return self._device, self._bus

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure time while streaming; returns the one obtained, s."""
        device, _ = self._need()
        obtained_s = device.set_absolute(abi.FEATURE_SHUTTER, exposure_s, "shutter", "s")
        if not self._frame_info:  # else the image itself says when the new shutter is in force
            self._frames.stamper.set_exposure(round(obtained_s * 1e9), time.monotonic_ns())
        return obtained_s

    def stats(self) -> SourceStats:
        """Counters since the source was opened; `clock_skew_ppm` is the bus clock's."""
        return self._frames.statistics.snapshot(
            clock_skew_ppm=self._dating.clock.skew_ppm,
            bus_clock_restarts=float(self._dating.clock.restarts),
            bus_clock_sigma_us=self._dating.clock.sigma_ns * 1e-3,
        )

    # -- frames ----------------------------------------------------------------------------------------

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s` without one.

        Raises:
            DeviceLostError: The camera went away, fell silent, or is still away; call again.
        """
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        if self._device is None and not self._closed:
            self._come_back(timeout_s)
        try:
            while True:
                left_s = (deadline_ns - time.monotonic_ns()) * 1e-9
                frame = self._next(max(0.0, left_s))
                if frame is not None or time.monotonic_ns() >= deadline_ns:
                    return frame
        except (DeviceLostError, DeviceBusyError):
            self._drop()
            raise

    def _next(self, timeout_s: float) -> Frame | None:
        device, bus = self._need()
        frame_made = self._next_checked(device)
        if frame_made is not None:
            return frame_made
        poller = select.poll()
        poller.register(self._fd, select.POLLIN)
        events = dict(poller.poll(min(timeout_s, MIN_SILENCE_S) * 1e3)).get(self._fd, 0)
        if events & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
            raise DeviceLostError(f"{device.name}: the camera went away")
        held = device.dequeue() if events else None
        if held is None:
            self._check_silence(device)
            return None
        t_arrival_ns, t_real_ns = read_host_clocks()
        self._t_alive_ns = t_arrival_ns
        frame: abi.VideoFrame = held.contents
        data = frame_bytes(frame)
        age_ns = t_real_ns - frame.timestamp_us * 1000  # since its first packet
        image_format = pixel_format(self._mode.coding, frame)
        depth_bits, image_bytes, packet_bytes = frame.data_depth, frame.image_bytes, frame.packet_size
        device.enqueue(held)
        self._dating.clock.add(*bus.read())
        if self._decode is None or self._decode.pixel_format != image_format:
            self._decode = self._make_decoder(device, image_format)
        info = parse_embedded(data[:64].tobytes(), self._frame_info)
        raw = self._dating.raw_stamp(info, t_arrival_ns - age_ns, t_arrival_ns)
        missing = self._dating.missing(info, raw.t_raw_ns)
        taken = _Taken(
            data[:image_bytes], depth_bits, info, raw, self._dating.sequence, missing, t_arrival_ns
        )
        verdict = check_completeness(data, packet_bytes, info, self._frame_info, age_ns, self._mode.rate_hz)
        self._classify(taken, verdict)
        return self._next_checked(device)

    def _classify(self, taken: _Taken, verdict: Completeness) -> None:
        """Decide on the held frame by the one that follows it, and on that one by itself."""
        held, self._held = self._held, None
        if held is not None:
            # before a gap, a shifted image and one that was only fetched late look the same
            self._checked.append((held, "doubtful_images" if taken.missing_before else ""))
        if verdict is Completeness.UNDECIDED:
            self._held = taken
        else:
            self._checked.append((taken, "shifted_images" if verdict is Completeness.SHIFTED else ""))

    def _next_checked(self, device: IidcDevice) -> Frame | None:
        """Return the next good frame; count the bad ones before it."""
        while self._checked:
            taken, fault = self._checked.popleft()
            self._frames.lost(taken.missing_before)
            if fault:
                self._frames.count_corrupt(fault)
                self._frames.lost()
                continue
            frame = self._make(device, taken)
            if frame is not None:
                return frame
        return None

    def _check_silence(self, device: IidcDevice) -> None:
        """A camera that was unplugged for a moment keeps its node, but has forgotten to send."""
        period_s = 1.0 / self._mode.rate_hz if self._mode.rate_hz > 0 else 0.1
        silent_s = (time.monotonic_ns() - self._t_alive_ns) * 1e-9
        if silent_s > max(MIN_SILENCE_S, SILENT_PERIODS * period_s):
            raise DeviceLostError(f"{device.name}: no frame for {silent_s:.1f} s; it is opened anew")

    def _make_decoder(self, device: IidcDevice, image_format: Any) -> FrameDecoder:
        try:
            mode, encoding = self._mode, self._settings.encoding
            return FrameDecoder(image_format, mode.width, mode.height, encoding=encoding)
        except ValueError as error:
            raise DeviceRefusedError(f"{device.name}: {error}") from error

    def _make(self, device: IidcDevice, taken: _Taken) -> Frame | None:
        self._update_exposure(device, taken.info)
        image = self._image(taken.data, taken.depth_bits)
        if image is None:
            self._frames.lost()
            return None
        return self._frames.frame(image, taken.raw, sequence=taken.sequence, t_arrival_ns=taken.t_arrival_ns)

    def _update_exposure(self, device: IidcDevice, info: EmbeddedInfo) -> None:
        """Read the shutter in seconds again whenever the image says that its raw value changed."""
        if info.shutter is None or info.shutter == self._shutter_raw:
            return
        self._shutter_raw = info.shutter
        exposure_ns = self._read_exposure(device)
        self._frames.stamper.set_exposure(exposure_ns, 0)

    def _image(self, data: Bytes, depth_bits: int) -> Image | None:
        assert self._decode is not None
        if self._mode.coding == "mono16":  # big endian on the bus, and left of its depth
            wide = data.view(">u2").astype(np.uint16)
            data = (wide << max(0, 16 - depth_bits)).astype(np.uint16).view(np.uint8)
        try:
            return self._decode(data)
        except CorruptImageError as error:
            self._frames.count_corrupt("corrupt_images")
            _log.debug("corrupt image: %s", error)
            return None


def _parse_guid(name: str) -> int | None:
    if not name:
        return None
    try:
        return int(name, 16)
    except ValueError as error:
        raise DeviceRefusedError(f"iidc:{name}: not a GUID; it has 16 hexadecimal digits") from error


def _parse_register(device: IidcDevice, name: str) -> int:
    try:
        return int(name, 16)
    except ValueError as error:
        raise DeviceRefusedError(
            f"{device.name}: control {name!r} is no register like 0x80c; exposure_s and gain have names"
        ) from error
