"""Choice of a V4L2 format: the cheapest that gives the wanted size, rate and encoding."""

from __future__ import annotations

from vical_drivers.camera.formats import FORMATS, Layout, PixelFormat
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.v4l2.node import ObtainedFormat, VideoNode
from vical_drivers.errors import DeviceRefusedError

RATE_TOLERANCE = 0.01


def negotiate(node: VideoNode, settings: CameraSettings) -> tuple[ObtainedFormat, float]:
    """Set format, size and rate.

    Returns:
        The format and the rate (Hz; 0.0 where the driver does not tell) that were obtained.

    Raises:
        DeviceRefusedError: A format or a size that was asked for is not to be had; says what is.
    """
    current = node.current_format()
    width, height = settings.width or current.width, settings.height or current.height
    name = _choose(node, settings, width, height)
    obtained = node.set_format(name, width, height)
    if obtained.pixel_format != name or (
        settings.width is not None and (obtained.width, obtained.height) != (width, height)
    ):
        raise DeviceRefusedError(
            f"{node.path}: asked for {name} {width}x{height}, got {obtained.pixel_format} "
            f"{obtained.width}x{obtained.height}; it offers: {offers_text(node)}"
        )
    return obtained, node.set_rate(settings.rate_hz)


def offers_text(node: VideoNode) -> str:
    """Return formats and sizes on offer in one line."""
    lines = []
    for name in node.pixel_formats():
        sizes = " ".join(f"{w}x{h}" for w, h in node.sizes(name))
        lines.append(f"{name} ({sizes})" if sizes else name)
    return "; ".join(lines) or "nothing"


def _choose(node: VideoNode, settings: CameraSettings, width: int, height: int) -> str:
    offered = node.pixel_formats()
    if settings.pixel_format is not None:
        if settings.pixel_format not in FORMATS:
            known = ", ".join(FORMATS)
            raise DeviceRefusedError(
                f"{node.path}: pixel format {settings.pixel_format!r} is none of {known}"
            )
        if settings.pixel_format not in offered:
            raise DeviceRefusedError(
                f"{node.path}: no pixel format {settings.pixel_format}; it offers: {offers_text(node)}"
            )
        return settings.pixel_format
    usable = [f for f in FORMATS.values() if f.name in offered and _gives(f, settings)]
    if not usable:
        raise DeviceRefusedError(
            f"{node.path}: nothing on offer gives {settings.encoding}; it offers: {offers_text(node)}"
        )
    fitting = [f for f in usable if node.size_offered(f.name, width, height)] or usable
    best_rate = 0.0
    best = fitting[0].name
    for candidate in fitting:  # in order of preference: a later one must be faster to win
        rates = node.rates_hz(candidate.name, width, height)
        rate = min(max(rates, default=float("inf")), settings.rate_hz or 0.0)
        if rate > best_rate * (1 + RATE_TOLERANCE):
            best, best_rate = candidate.name, rate
    return best


def _gives(pixel_format: PixelFormat, settings: CameraSettings) -> bool:
    if settings.encoding == "mono16":
        return pixel_format.layout is Layout.GREY and pixel_format.bits > 8
    if settings.encoding == "bgr8" and pixel_format.layout is Layout.GREY:
        return False
    return pixel_format.layout is not Layout.JPEG or settings.decoder is not None
