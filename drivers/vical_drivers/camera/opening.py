"""Opens cameras by URI, and lists them. Libraries are loaded when they are used."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from vical_drivers.camera.formats import ImageDecoder
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.v4l2.kernel import Kernel, LinuxKernel
from vical_drivers.errors import DeviceNotFoundError, DriverError, MissingLibraryError
from vical_drivers.samples import DeviceInfo, FrameSource

_log = logging.getLogger(__name__)

SCHEMES = ("v4l2", "iidc", "aravis", "folder")


def split_uri(uri: str) -> tuple[str, str]:
    """Return scheme and name; a bare path or number is V4L2.

    >>> split_uri("/dev/video0")
    ('v4l2', '/dev/video0')
    >>> split_uri("iidc:00b09d0100a1b2c3")
    ('iidc', '00b09d0100a1b2c3')

    Raises:
        DeviceNotFoundError: Unknown scheme.
    """
    if uri.startswith("/") or uri.isdigit():
        return "v4l2", uri
    scheme, colon, name = uri.partition(":")
    if not colon or scheme not in SCHEMES:
        known = ", ".join(f"{s}:..." for s in SCHEMES)
        raise DeviceNotFoundError(f"camera {uri!r}: not a device path and none of {known}")
    return scheme, name


def open_camera(
    uri: str,
    *,
    width: int | None = None,
    height: int | None = None,
    rate_hz: float | None = None,
    pixel_format: str | None = None,
    encoding: str = "mono8",
    exposure_s: float | None = None,
    gain: float | None = None,
    controls: Mapping[str, float] | None = None,
    decoder: ImageDecoder | None = None,
    borrow: bool = False,
    kernel: Kernel | None = None,
    **more: Any,
) -> FrameSource:
    """Open a camera and start it.

    Args:
        uri: See the table of this package.
        width: Pixels; with `height`.
        height: Pixels.
        rate_hz: Frames per second.
        pixel_format: See `CameraSettings`, as the rest; `info.details` says what was obtained.
        encoding: mono8, mono16 or bgr8.
        exposure_s: Exposure time, s; turns automatic exposure off.
        gain: Gain in the camera's unit.
        controls: More controls by name.
        decoder: For MJPG and image files, e.g. `vical_daemon.vision.image_codec.decode_image`.
        borrow: Frames are valid only until the next `read`, and one copy is saved.
        kernel: System-call boundary of V4L2, for tests.
        more: Further fields of `CameraSettings`: assume_exposure_s, rolling_shutter, readout_s, stamp,
            buffers.

    Raises:
        DriverError: One line that says what is wrong and what to try.
    """
    settings = CameraSettings(
        width=width,
        height=height,
        rate_hz=rate_hz,
        pixel_format=pixel_format,
        encoding=encoding,
        exposure_s=exposure_s,
        gain=gain,
        controls=dict(controls or {}),
        decoder=decoder,
        borrow=borrow,
        **more,
    )
    scheme, name = split_uri(uri)
    return _SOURCES[scheme](name, settings, kernel)


def _open_v4l2(name: str, settings: CameraSettings, kernel: Kernel | None) -> FrameSource:
    from vical_drivers.camera.v4l2.camera import V4l2Camera

    return V4l2Camera(name, settings, kernel=kernel)


def _open_iidc(name: str, settings: CameraSettings, _kernel: Kernel | None) -> FrameSource:
    from vical_drivers.camera.iidc.camera import IidcCamera

    return IidcCamera(name, settings)


def _open_aravis(name: str, settings: CameraSettings, _kernel: Kernel | None) -> FrameSource:
    from vical_drivers.camera.aravis.camera import AravisCamera

    return AravisCamera(name, settings)


def _open_folder(name: str, settings: CameraSettings, _kernel: Kernel | None) -> FrameSource:
    from vical_drivers.camera.folder import ImageFolder

    return ImageFolder(name, settings)


_SOURCES = {"v4l2": _open_v4l2, "iidc": _open_iidc, "aravis": _open_aravis, "folder": _open_folder}


def list_cameras(*, kernel: Kernel | None = None, schemes: tuple[str, ...] = SCHEMES) -> list[DeviceInfo]:
    """Return the connected cameras; `details["uri"]` is what `open_camera` takes.

    A kind whose library is missing is skipped; where there is a FireWire bus, the log says what to install.
    """
    from vical_drivers.camera.v4l2.discovery import list_v4l2_cameras

    found = list_v4l2_cameras(kernel or LinuxKernel()) if "v4l2" in schemes else []
    for scheme in ("iidc", "aravis"):
        if scheme in schemes:
            try:
                found += _list_by_library(scheme)
            except MissingLibraryError as error:
                # Aravis is looked for everywhere, libdc1394 only where there is a FireWire bus
                _log.log(logging.WARNING if scheme == "iidc" else logging.DEBUG, "%s", error)
            except DriverError as error:
                _log.warning("%s", error)
    return found


def _list_by_library(scheme: str) -> list[DeviceInfo]:
    if scheme == "iidc":
        from vical_drivers.camera.iidc.camera import list_iidc_cameras

        return list_iidc_cameras()
    from vical_drivers.camera.aravis.camera import list_aravis_cameras

    return list_aravis_cameras()


def check_camera(uri: str, *, timeout_s: float = 3.0, **wanted: Any) -> list[str]:
    """Open a camera as configured, take one frame, and describe what differs from the settings.

    Args:
        uri: See `open_camera`.
        timeout_s: How long to wait for the frame.
        wanted: What `open_camera` takes.

    Returns:
        One line for each problem; [] if there is none.
    """
    try:
        source = open_camera(uri, **wanted)
    except DriverError as error:
        return [str(error)]
    return check_open_camera(source, uri, timeout_s, **wanted)


def check_open_camera(source: FrameSource, uri: str, timeout_s: float = 3.0, **wanted: Any) -> list[str]:
    """Do what `check_camera` does with a camera that is open already; closes it."""
    with source:
        info = source.info
        problems = _compare(info, wanted)
        try:
            frame = source.read(timeout_s)
        except DriverError as error:
            return [*problems, str(error)]
    if frame is None:
        problems.append(f"{uri}: no frame within {timeout_s:g} s")
        return problems
    height, width = frame.image.shape[:2]
    if wanted.get("width") is not None and (width, height) != (wanted["width"], wanted["height"]):
        problems.append(
            f"{uri}: asked for {wanted['width']} x {wanted['height']} pixels, got {width} x {height}"
        )
    if frame.stamp_rule.startswith("raw-") and wanted.get("stamp") != "raw":
        problems.append(
            f"{uri}: the exposure is {_how_unknown(info)}, "
            f"so stamps are not mid-exposure ({frame.stamp_rule}); set exposure_s, or state assume_exposure_s"
        )
    return problems


def _how_unknown(info: DeviceInfo) -> str:
    return "automatic" if info.details.get("exposure_s") == "automatic" else "not known"


def _compare(info: DeviceInfo, wanted: Mapping[str, Any]) -> list[str]:
    problems = []
    for key, tolerance in (("rate_hz", 0.01), ("exposure_s", 0.05)):
        asked, got = wanted.get(key), info.details.get(key, "")
        if asked is None:
            continue
        name = info.path or info.model
        try:
            if abs(float(got) - asked) > tolerance * asked:
                problems.append(f"{name}: asked for {key} {asked:g}, got {got}")
        except ValueError:
            problems.append(f"{name}: asked for {key} {asked:g}; the camera does not say what it does")
    return problems
