"""Video modes of an IIDC camera: a fixed mode where one has size and rate, else Format7."""

from __future__ import annotations

import math
from ctypes import byref, c_uint32
from dataclasses import dataclass

from vical_drivers.camera.iidc import abi
from vical_drivers.camera.iidc.device import IidcDevice
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.errors import DeviceRefusedError

_PREFERENCE = {
    "mono8": ("mono8", "raw8", "yuv422", "rgb8"),
    "mono16": ("mono16",),
    "bgr8": ("rgb8", "yuv422", "raw8"),
}
_CYCLES_HZ = 8000.0


@dataclass(frozen=True, slots=True)
class IidcMode:
    """What was set: libdc1394's mode number, pixels, coding and rate (0.0: unknown)."""

    number: int
    width: int
    height: int
    coding: str
    rate_hz: float


def set_mode(device: IidcDevice, settings: CameraSettings) -> IidcMode:
    """Set speed, video mode and rate; a size without a fixed mode takes Format7."""
    if device.fast:
        device.call("video_set_operation_mode", abi.OPERATION_MODE_1394B, doing="use 1394b")
    speed = abi.ISO_SPEED_800 if device.fast else abi.ISO_SPEED_400
    device.call("video_set_iso_speed", speed, doing="set the bus speed")
    wanted = _codings(device, settings)
    modes = abi.VideoModes()
    device.call("video_get_supported_modes", byref(modes), doing="list its video modes")
    offered = list(modes.modes[: modes.num])
    fixed = _fixed_mode(device, settings, offered, wanted)
    if fixed is not None:
        return fixed
    scalable = [m for m in offered if abi.FORMAT7_FIRST <= m <= abi.FORMAT7_LAST]
    if not scalable:
        raise DeviceRefusedError(f"{device.name}: no such video mode; it offers: {_modes_text(offered)}")
    return _format7(device, settings, scalable[0], wanted)


def _codings(device: IidcDevice, settings: CameraSettings) -> tuple[str, ...]:
    if settings.pixel_format is None:
        return _PREFERENCE[settings.encoding]
    if settings.pixel_format not in abi.CODINGS:
        known = ", ".join(abi.CODINGS)
        raise DeviceRefusedError(f"{device.name}: pixel format {settings.pixel_format!r} is none of {known}")
    return (settings.pixel_format,)


def _fixed_mode(
    device: IidcDevice, settings: CameraSettings, offered: list[int], wanted: tuple[str, ...]
) -> IidcMode | None:
    known = [(m, *abi.MODES[m]) for m in offered if m in abi.MODES]
    size = (settings.width, settings.height)
    if settings.width is None:
        current = device.number("video_get_mode", doing="report its video mode")
        size = abi.MODES[current][:2] if current in abi.MODES else (0, 0)
    for coding in wanted:
        for mode, width, height, its_coding in known:
            if (width, height) != size or its_coding != coding:
                continue
            rate = _fixed_rate(device, mode, settings.rate_hz)
            if rate is not None:
                device.call("video_set_mode", mode, doing=f"set {width}x{height} {coding}")
                device.call("video_set_framerate", rate, doing="set the frame rate")
                return IidcMode(mode, width, height, coding, abi.FRAMERATES_HZ[rate])
    return None


def _fixed_rate(device: IidcDevice, mode: int, rate_hz: float | None) -> int | None:
    rates = abi.Framerates()
    device.call("video_get_supported_framerates", mode, byref(rates), doing="list its frame rates")
    offered = [r for r in rates.framerates[: rates.num] if r in abi.FRAMERATES_HZ]
    if rate_hz is None:
        current = device.number("video_get_framerate", doing="report its frame rate")
        return current if current in offered else max(offered, default=None)
    return next((r for r in offered if abs(abi.FRAMERATES_HZ[r] - rate_hz) < 0.01 * rate_hz), None)


def _format7(device: IidcDevice, settings: CameraSettings, mode: int, wanted: tuple[str, ...]) -> IidcMode:
    coding = next((c for c in wanted if c in abi.CODINGS), "mono8")
    device.call("video_set_mode", mode, doing="use Format7")
    widest, tallest = _pair(device, "format7_get_max_image_size", mode)
    unit_w, unit_h = _pair(device, "format7_get_unit_size", mode)
    width, height = settings.width or widest, settings.height or tallest
    if width > widest or height > tallest or width % max(unit_w, 1) or height % max(unit_h, 1):
        raise DeviceRefusedError(
            f"{device.name}: {width}x{height} is not to be had: at most {widest}x{tallest} "
            f"in steps of {unit_w}x{unit_h}"
        )
    packet = abi.USE_RECOMMENDED
    if settings.rate_hz is not None:
        unit, largest = _pair(device, "format7_get_packet_parameters", mode)
        depth = 2 if coding in ("mono16", "yuv422") else 3 if coding == "rgb8" else 1
        bytes_per_cycle = width * height * depth * settings.rate_hz / _CYCLES_HZ
        packet = min(math.ceil(bytes_per_cycle / max(unit, 1)) * max(unit, 1), largest)
    left, top = (widest - width) // 2, (tallest - height) // 2
    left, top = left - left % max(unit_w, 1), top - top % max(unit_h, 1)
    device.call(
        "format7_set_roi", mode, abi.CODINGS[coding], packet, left, top, width, height,
        doing=f"set {width}x{height} {coding} in Format7",
    )  # fmt: skip
    rate_hz = _feature_rate(device, settings.rate_hz)
    return IidcMode(mode, width, height, coding, rate_hz)


def _feature_rate(device: IidcDevice, rate_hz: float | None) -> float:
    if rate_hz is None or not device.has_absolute(abi.FEATURE_FRAME_RATE):
        return rate_hz or 0.0
    return device.set_absolute(abi.FEATURE_FRAME_RATE, rate_hz, "frame rate", "Hz")


def _pair(device: IidcDevice, function: str, mode: int) -> tuple[int, int]:
    one, two = c_uint32(), c_uint32()
    device.call(function, mode, byref(one), byref(two), doing="describe Format7")
    return one.value, two.value


def _modes_text(offered: list[int]) -> str:
    texts = ["{}x{} {}".format(*abi.MODES[m]) for m in offered if m in abi.MODES]
    return ", ".join(texts) or "nothing that is understood"
