"""An open IIDC camera: libdc1394's calls with errors a person understands, features, frames."""

from __future__ import annotations

import contextlib
import ctypes
import os
from ctypes import byref, c_float, c_uint32
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_drivers.camera.formats import FORMATS, Layout, PixelFormat
from vical_drivers.camera.iidc import abi, embedded, firewire
from vical_drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceRefusedError
from vical_drivers.samples import DeviceInfo

_CODING_FORMATS = {"mono8": "GREY", "mono16": "Y16", "yuv422": "UYVY", "rgb8": "RGB3"}


class IidcDevice:
    """One camera, opened by its GUID; closed by `close`.

    Args:
        guid: Of the camera; None: the only one on the bus.

    Raises:
        MissingLibraryError: libdc1394 is not installed.
        DeviceNotFoundError: No such camera.
        DevicePermissionError: This user may not open the FireWire nodes.
    """

    def __init__(self, guid: int | None) -> None:
        self._library: Any = abi.load()
        self._context = self._library.dc1394_new()
        self._camera: Any = None
        self._ring_fd = -1
        self._ring: tuple[int, int] | None = None  # address and length of the mapped ring
        self._buffers = 0
        try:
            if not self._context:
                raise DeviceNotFoundError("iidc: no FireWire bus here; is firewire-ohci loaded?")
            self.guid = _choose(self._guids(), guid)
            self._camera = self._library.dc1394_camera_new(self._context, self.guid)
            if not self._camera:
                raise DeviceLostError(f"iidc:{self.guid:016x}: the camera does not answer")
        except BaseException:
            self.close()
            raise

    def _guids(self) -> list[int]:
        found = ctypes.POINTER(abi.CameraList)()
        code = self._library.dc1394_camera_enumerate(self._context, byref(found))
        if code != abi.SUCCESS:
            raise DeviceLostError(f"iidc: the bus cannot be searched (libdc1394 error {code})")
        try:
            return [int(found.contents.ids[k].guid) for k in range(found.contents.num)]
        finally:
            self._library.dc1394_camera_free_list(found)

    @property
    def name(self) -> str:
        """URI of the camera."""
        return f"iidc:{self.guid:016x}"

    @property
    def vendor_and_model(self) -> str:
        """As the camera's ROM says."""
        camera = self._camera.contents
        return " ".join(t.decode("latin-1").strip() for t in (camera.vendor, camera.model) if t)

    @property
    def fast(self) -> bool:
        """Whether the camera speaks 1394b, 800 Mbit/s."""
        return bool(self._camera.contents.bmode_capable)

    def call(self, function: str, *arguments: object, doing: str) -> None:
        """Run a function of libdc1394 on this camera; `doing` completes "cannot ..."."""
        code = getattr(self._library, f"dc1394_{function}")(self._camera, *arguments)
        if code == abi.SUCCESS:
            return
        if firewire.find_node(self.guid) is None:
            raise DeviceLostError(f"{self.name}: the camera went away; check its cable")
        raise DeviceRefusedError(f"{self.name}: cannot {doing} (libdc1394 error {code})")

    def number(self, function: str, *arguments: object, doing: str) -> int:
        """Run a function whose last argument receives a number."""
        value = c_uint32()
        self.call(function, *arguments, byref(value), doing=doing)
        return value.value

    def register(self, offset: int) -> int:
        """Read a control register."""
        value = c_uint32()
        self.call("get_control_registers", offset, byref(value), 1, doing=f"read register {offset:#x}")
        return value.value

    def set_register(self, offset: int, value: int) -> None:
        """Write a control register."""
        word = c_uint32(value)
        self.call("set_control_registers", offset, byref(word), 1, doing=f"write register {offset:#x}")

    # -- features ------------------------------------------------------------------------------------

    def has_absolute(self, feature: int) -> bool:
        """Tell whether a feature takes physical units."""
        if not self.number("feature_is_present", feature, doing="list its features"):
            return False
        return bool(self.number("feature_has_absolute_control", feature, doing="list its features"))

    def absolute(self, feature: int) -> float:
        """Read a feature in its physical unit (shutter: s, gain: dB)."""
        value = c_float()
        self.call("feature_get_absolute_value", feature, byref(value), doing="report a feature")
        return value.value

    def is_automatic(self, feature: int) -> bool:
        """Tell whether the camera chooses a feature itself."""
        return self.number("feature_get_mode", feature, doing="report a mode") != abi.FEATURE_MODE_MANUAL

    def set_absolute(self, feature: int, value: float, what: str, unit: str) -> float:
        """Set a feature by hand, in its physical unit; returns the value obtained."""
        if not self.has_absolute(feature):
            raise DeviceRefusedError(f"{self.name}: its {what} cannot be set in {unit}")
        low, high = c_float(), c_float()
        self.call(
            "feature_get_absolute_boundaries",
            feature,
            byref(low),
            byref(high),
            doing=f"report its {what} range",
        )
        if not low.value * 0.999 <= value <= high.value * 1.001:
            bounds_text = f"{low.value:g} to {high.value:g} {unit}"
            raise DeviceRefusedError(f"{self.name}: {what} {value:g} {unit} is out of range: {bounds_text}")
        self.call("feature_set_power", feature, abi.ON, doing=f"switch its {what} on")
        self.call("feature_set_mode", feature, abi.FEATURE_MODE_MANUAL, doing=f"set its {what} by hand")
        self.call("feature_set_absolute_control", feature, abi.ON, doing=f"set its {what} in {unit}")
        self.call("feature_set_absolute_value", feature, c_float(value), doing=f"set its {what}")
        return self.absolute(feature)

    def embed(self) -> int:
        """Switch time stamp, shutter and frame counter into the image; returns the register, 0: cannot."""
        try:
            if not self.register(embedded.FRAME_INFO) & embedded.PRESENT:
                return 0
            self.set_register(embedded.FRAME_INFO, embedded.WANTED)
            obtained = self.register(embedded.FRAME_INFO)
        except DeviceRefusedError:  # not a Point Grey camera: no such register
            return 0
        return obtained if obtained >> embedded.TIMESTAMP & 1 else 0

    # -- frames --------------------------------------------------------------------------------------

    def start(self, buffers: int) -> int:
        """Set the ring up and let the camera send; returns the descriptor to poll."""
        if self.number("video_get_transmission", doing="report whether it sends"):
            # nobody of ours holds it (see BusClock): a program that crashed left it sending
            self.call("video_set_transmission", abi.OFF, doing="stop to send")
        self.call("capture_setup", buffers, abi.CAPTURE_FLAGS_DEFAULT, doing="set its ring up (bandwidth?)")
        self._buffers = buffers
        self._ring_fd = int(self._library.dc1394_capture_get_fileno(self._camera))
        self.call("video_set_transmission", abi.ON, doing="start to send")
        return self._ring_fd

    def dequeue(self) -> Any:
        """Take a frame from the ring; None where none is ready."""
        frame = ctypes.POINTER(abi.VideoFrame)()
        code = self._library.dc1394_capture_dequeue(self._camera, abi.POLICY_POLL, byref(frame))
        if code != abi.SUCCESS:
            raise DeviceLostError(f"{self.name}: the camera went away (libdc1394 error {code})")
        if frame and self._ring is None:
            first: abi.VideoFrame = frame.contents
            base = first.image - first.frame_id * first.total_bytes
            self._ring = (base, first.total_bytes * self._buffers)
        return frame if frame else None

    def enqueue(self, frame: Any) -> None:
        """Give a frame back to the ring."""
        self.call("capture_enqueue", frame, doing="take a buffer back")

    def close(self) -> None:
        """Stop and free everything; may be called twice, never raises for a camera that is gone."""
        camera, self._camera = self._camera, None
        if camera:
            if self._ring_fd >= 0:
                self._library.dc1394_video_set_transmission(camera, abi.OFF)
                if self._library.dc1394_capture_stop(camera) != abi.SUCCESS:
                    self._free_ring()
                self._ring_fd, self._ring = -1, None
            self._library.dc1394_camera_free(camera)
        context, self._context = self._context, None
        if context:
            self._library.dc1394_free(context)

    def _free_ring(self) -> None:
        """Free what libdc1394 leaves behind when the camera is gone: it returns before it frees."""
        if self._ring is not None:
            ctypes.CDLL(None).munmap(ctypes.c_void_p(self._ring[0]), ctypes.c_size_t(self._ring[1]))
        with contextlib.suppress(OSError):  # it had closed it after all
            os.close(self._ring_fd)


def frame_bytes(frame: abi.VideoFrame) -> npt.NDArray[np.uint8]:
    """Return a copy of all bytes that came for a frame: `image_bytes` of the image, then padding."""
    source = (ctypes.c_uint8 * frame.total_bytes).from_address(frame.image)
    return np.frombuffer(source, dtype=np.uint8).copy()


def pixel_format(coding: str, frame: abi.VideoFrame) -> PixelFormat:
    """Return the format of a coding; raw8 takes its mosaic from the frame."""
    if coding == "raw8":
        order = abi.BAYER_ORDERS.get(frame.color_filter)
        return PixelFormat("raw8", Layout.BAYER, order=order) if order else FORMATS["GREY"]
    return FORMATS[_CODING_FORMATS[coding]]


def _choose(found: list[int], guid: int | None) -> int:
    if guid is None and len(found) == 1:
        return found[0]
    if guid in found and guid is not None:
        return guid
    if not found:
        firewire.find_node(guid)  # raises where permission is the reason
    there = ", ".join(f"iidc:{g:016x}" for g in found) or "none"
    asked = "one camera" if guid is None else f"iidc:{guid:016x}"
    raise DeviceNotFoundError(f"{asked} was asked for; on the bus: {there}")


def list_devices() -> list[DeviceInfo]:
    """Return the cameras on the bus; [] where there is no bus."""
    if not firewire.nodes():
        return []
    library = abi.load()
    context = library.dc1394_new()
    if not context:
        return []
    found = ctypes.POINTER(abi.CameraList)()
    cameras = []
    try:
        if library.dc1394_camera_enumerate(context, byref(found)) != abi.SUCCESS:
            return []
        guids = [int(found.contents.ids[k].guid) for k in range(found.contents.num)]
        library.dc1394_camera_free_list(found)
        for guid in guids:
            camera = library.dc1394_camera_new(context, guid)
            names = (camera.contents.vendor, camera.contents.model) if camera else (b"does not answer",)
            model = " ".join(t.decode("latin-1").strip() for t in names if t)
            if camera:
                library.dc1394_camera_free(camera)
            uri = f"iidc:{guid:016x}"
            cameras.append(
                DeviceInfo(
                    kind="camera",
                    model=model,
                    serial_number=f"{guid:016x}",
                    path=firewire.find_node(guid) or "",
                    protocol="iidc",
                    details={"uri": uri},
                )
            )
    finally:
        library.dc1394_free(context)
    return cameras
