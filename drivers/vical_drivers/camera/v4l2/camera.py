"""V4L2 cameras: memory-mapped streaming, kernel stamps moved to the middle of the exposure.

What happens when something goes wrong:

| event | outcome |
|---|---|
| unplugged, also during a dequeue | `DeviceLostError`; the next `read` waits for it and opens it anew |
| empty buffer, buffer flagged as damaged, JPEG or image cut off | counted, skipped, the frame is lost |
| jump in the sequence numbers | `Frame.dropped_before`, counted |
| jump in the stamps alone (lost inside the camera) | the same, one frame later; counted apart as well |
| format or size refused | `DeviceRefusedError` with what is on offer |
| a second process on the camera | `DeviceBusyError` naming the first one |
| no permission | `DevicePermissionError` naming the group |
"""

from __future__ import annotations

import logging
import select
from collections.abc import Callable

from vical_drivers.camera.formats import CorruptImageError, Image
from vical_drivers.camera.frame_maker import FrameMaker
from vical_drivers.camera.hotplug import wait_for_camera
from vical_drivers.camera.losses import SequenceCounter
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.stamps import RawStamp
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.controls import Controls
from vical_drivers.camera.v4l2.discovery import find_again, find_node, twin_ports
from vical_drivers.camera.v4l2.exposure import read_exposure_ns, set_exposure
from vical_drivers.camera.v4l2.kernel import Kernel, LinuxKernel
from vical_drivers.camera.v4l2.kernel_stamp import kernel_stamp, to_monotonic_ns
from vical_drivers.camera.v4l2.node import DequeuedBuffer
from vical_drivers.camera.v4l2.session import V4l2Session
from vical_drivers.closing import Closing
from vical_drivers.errors import DeviceLostError, DriverError
from vical_drivers.host_clocks import HostClocks
from vical_drivers.samples import DeviceInfo, Frame, SourceStats

_log = logging.getLogger(__name__)

_GONE = select.POLLERR | select.POLLHUP | select.POLLNVAL


class V4l2Camera(Closing):
    """A `FrameSource` over one V4L2 node.

    Args:
        name: Device node, a link to it, its number, or the camera's serial number.
        settings: What is asked of the camera; applied again after each replug.
        kernel: The system-call boundary.
        wait: Waits up to a number of seconds for a camera to appear; None: on the udev events.

    Raises:
        DriverError: See the table above.
    """

    def __init__(
        self,
        name: str,
        settings: CameraSettings | None = None,
        *,
        kernel: Kernel | None = None,
        wait: Callable[[float], None] | None = None,
    ) -> None:
        self._settings = settings or CameraSettings()
        self._kernel = kernel or LinuxKernel()
        self._wait = wait or wait_for_camera
        self._entry = find_node(self._kernel, name)
        self._sequence = SequenceCounter()
        self._frames = FrameMaker(self._settings)
        self._borrowed: int | None = None
        self._rule = ""
        self._closed = False
        self._session: V4l2Session | None = None
        self._open()
        self._info = self._describe()

    # -- life ---------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._session = V4l2Session(self._kernel, self._entry, self._settings)
        self._twins = twin_ports(self._kernel, self._entry)
        self._frames.stamper.set_exposure(self._session.exposure_ns, 0)
        self._sequence.restart()
        self._borrowed = None

    def _drop_session(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def _come_back(self, timeout_s: float) -> None:
        entry = find_again(self._kernel, self._entry, self._twins)
        if entry is None:
            self._wait(timeout_s)
            entry = find_again(self._kernel, self._entry, self._twins)
        if entry is None:
            raise DeviceLostError(f"{self._entry.path}: the camera is still away; plug it in again")
        self._entry = entry
        try:
            self._open()
        except DriverError as error:
            self._wait(timeout_s)  # udev may not have set the permissions yet
            raise DeviceLostError(f"{entry.path}: the camera is not back yet ({error})") from error
        self._frames.reopened()
        _log.info("camera back path=%s", entry.path)

    def close(self) -> None:
        """Stop streaming and free the device; may be called twice."""
        self._closed = True
        self._drop_session()

    # -- who and how ---------------------------------------------------------------------------------

    @property
    def info(self) -> DeviceInfo:
        """Who the camera is and, in `details`, what was obtained of what was asked."""
        return self._info

    def _describe(self) -> DeviceInfo:
        session = self._need_session()
        fmt, exposure_ns = session.format, self._frames.stamper.exposure_ns
        not_told = "automatic" if session.automatic else "unknown"
        return DeviceInfo(
            kind="camera",
            model=session.identity.card,
            serial_number=self._entry.identity,
            path=self._entry.stable_path or self._entry.path,
            protocol="v4l2",
            details={
                "driver": session.identity.driver,
                "bus": session.identity.bus_info,
                "pixel_format": fmt.pixel_format,
                "size": f"{fmt.width}x{fmt.height}",
                "rate_hz": f"{session.rate_hz:g}",
                "encoding": self._settings.encoding,
                "exposure_s": not_told if exposure_ns is None else f"{exposure_ns * 1e-9:g}",
                "buffers": str(session.buffers),
                "uvc_metadata": "yes" if session.metadata is not None else "no",
            },
        )

    def _need_session(self) -> V4l2Session:
        if self._closed:
            raise DeviceLostError(f"{self._entry.path}: the camera is closed")
        if self._session is None:
            raise DeviceLostError(f"{self._entry.path}: the camera is away")
        return self._session

    @property
    def controls(self) -> Controls:
        """The controls of the open camera."""
        return self._need_session().controls

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure time while streaming; returns the one obtained, s.

        Frames that began to expose before now keep the old exposure in their stamps.
        """
        session = self._need_session()
        obtained_ns = set_exposure(session.controls, exposure_s)
        self._frames.stamper.set_exposure(obtained_ns, self._kernel.monotonic_ns())
        return obtained_ns * 1e-9

    def stats(self) -> SourceStats:
        """Counters since the source was opened; `extra` counts faults by kind and the UVC clock fit."""
        metadata = self._session.metadata if self._session is not None else None
        if metadata is None:
            return self._frames.statistics.snapshot()
        health = metadata.health()
        return self._frames.statistics.snapshot(
            clock_skew_ppm=health.skew_ppm,
            uvc_fit_residual_us=health.residual_sigma_ns * 1e-3,
            uvc_arrival_jitter_us=health.jitter_ns * 1e-3,
            uvc_fit_used=float(health.usable),
        )

    # -- frames --------------------------------------------------------------------------------------

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s` without one.

        With `CameraSettings.borrow` the image shows kernel memory and is valid until the next call.

        Raises:
            DeviceLostError: The camera went away, or is still away; call again.
        """
        deadline_ns = self._kernel.monotonic_ns() + round(timeout_s * 1e9)
        if self._session is None and not self._closed:
            self._come_back(timeout_s)
        session = self._need_session()
        try:
            self._return_borrowed(session)
            while True:
                left_s = (deadline_ns - self._kernel.monotonic_ns()) * 1e-9
                buffer = self._next_buffer(session, left_s)
                if buffer is not None:
                    frame = self._frame(session, buffer)
                    if frame is not None:
                        return frame
                elif self._kernel.monotonic_ns() >= deadline_ns:
                    return None
        except DeviceLostError:
            self._drop_session()
            raise

    def _return_borrowed(self, session: V4l2Session) -> None:
        if self._borrowed is not None:
            index, self._borrowed = self._borrowed, None
            session.node.queue(index)

    def _next_buffer(self, session: V4l2Session, timeout_s: float) -> DequeuedBuffer | None:
        """Wait for a buffer; None on timeout or when only an event came."""
        fd = session.node.fd
        events = self._kernel.poll([(fd, select.POLLIN | select.POLLPRI)], max(0.0, timeout_s)).get(fd, 0)
        if events & select.POLLPRI:
            self._take_event(session)
        if events & (select.POLLIN | _GONE):
            buffer = session.node.dequeue()  # names the reason if the device is gone
            if buffer is None and events & _GONE:
                raise DeviceLostError(f"{self._entry.path}: the camera stopped delivering")
            return buffer
        return None

    def _take_event(self, session: V4l2Session) -> None:
        session.node.request(abi.VIDIOC_DQEVENT, abi.Event(), "report changes")
        self._frames.stamper.set_exposure(read_exposure_ns(session.controls), self._kernel.monotonic_ns())

    def _frame(self, session: V4l2Session, buffer: DequeuedBuffer) -> Frame | None:
        # before anything takes time: a stamp of another clock is moved by their difference
        now = self._kernel.clocks()
        t_arrival_ns = now.monotonic_ns
        before_ns = session.stamped_ns
        known_ns = to_monotonic_ns(buffer.t_ns, now, before_ns)
        if known_ns is not None:
            session.stamped_ns = known_ns
        t_stamp_ns = known_ns or t_arrival_ns
        self._frames.numbered(t_stamp_ns, self._sequence.missing_before(buffer.sequence))
        image = self._image(session, buffer)
        if image is None:
            self._frames.lost()
            session.node.queue(buffer.index)
            return None
        if self._settings.borrow:
            self._borrowed = buffer.index
        else:
            if not image.flags.owndata:
                image = image.copy()
            session.node.queue(buffer.index)
        raw = self._raw_stamp(session, buffer, now, before_ns)
        frame = self._frames.frame(image, raw, sequence=buffer.sequence, t_arrival_ns=t_arrival_ns)
        self._say_rule(frame.stamp_rule)
        return frame

    def _image(self, session: V4l2Session, buffer: DequeuedBuffer) -> Image | None:
        """Decode a buffer; None, with the reason counted, where it holds no good image."""
        if buffer.bytes_used == 0:
            self._frames.statistics.count("empty_buffers")
            return None
        if buffer.flags & abi.BUF_FLAG_ERROR:
            self._frames.count_corrupt("flagged_buffers")
            return None
        try:
            return session.decode(session.node.mappings[buffer.index].array[: buffer.bytes_used])
        except CorruptImageError as error:
            self._frames.count_corrupt("corrupt_images")
            _log.debug("corrupt image sequence=%d: %s", buffer.sequence, error)
            return None

    def _raw_stamp(
        self, session: V4l2Session, buffer: DequeuedBuffer, now: HostClocks, before_ns: int | None
    ) -> RawStamp:
        if session.metadata is not None:
            fitted = session.metadata.stamp(buffer)
            if fitted is not None:
                return fitted
        return kernel_stamp(
            buffer,
            driver=session.identity.driver,
            now=now,
            forced=self._settings.stamp,
            uvc_hwtimestamps=session.uvc_hwtimestamps,
            before_ns=before_ns,
        )

    def _say_rule(self, rule: str) -> None:
        if rule != self._rule:
            _log.info("stamp rule path=%s rule=%s", self._entry.path, rule)
            self._rule = rule
