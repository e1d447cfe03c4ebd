"""Where bytes come from: the `BytePort` protocol and the serial port behind pyserial.

A read returns the bytes *and* CLOCK_MONOTONIC taken right after the system call, before anything looks
at them: every later microsecond would end up in the time stamps.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import select
import termios
import time
from collections import deque
from pathlib import Path
from typing import Protocol

import serial

from vical_drivers.access import how_to_open
from vical_drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DevicePermissionError,
    DeviceTimeoutError,
    DriverError,
)

_log = logging.getLogger(__name__)
BITS_PER_BYTE = 10
"""Start, eight data, stop."""
_CHUNK = 4096  # more than a terminal holds; larger ones cost the allocator more than the read
_WRITE_TIMEOUT_S = 1.0
_slow_ports: set[str] = set()
_CHUNKS_KEPT = 512  # a record waits for its end for 261 bytes at most


class BytePort(Protocol):
    """An open byte stream to a device."""

    @property
    def name(self) -> str:
        """Path, for messages."""
        ...

    @property
    def baud(self) -> int:
        """Bits per second on the line as set on this side."""
        ...

    @property
    def wire_byte_ns(self) -> float:
        """Time one byte occupies the wire, ns; 0 where no UART is in between (USB)."""
        ...

    @property
    def link(self) -> str:
        """What lies in between: "usb", "ftdi", "uart" or "unknown"."""
        ...

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Return what has arrived and CLOCK_MONOTONIC ns of the read; (b"", now) after the timeout.

        Raises:
            DeviceLostError: The other side is gone.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send all bytes.

        Raises:
            DeviceLostError: The other side is gone, or takes nothing.
        """
        ...

    def set_baud(self, baud: int) -> None:
        """Change this side's baud; what was in flight is dropped."""
        ...

    def close(self) -> None:
        """Free the port; may be called twice."""
        ...


def link_of(path: str) -> str:
    """Guess what lies between device and host: "usb", "ftdi", "uart" or "unknown" (pseudo terminal)."""
    name = Path(os.path.realpath(path)).name
    with contextlib.suppress(OSError):
        driver = os.path.realpath(f"/sys/class/tty/{name}/device/driver")
        known = {"cdc_acm": "usb", "ftdi_sio": "ftdi"}
        if Path(driver).name in known:
            return known[Path(driver).name]
    if name.startswith("ttyACM"):
        return "usb"
    return "uart" if name.startswith("tty") else "unknown"


def latency_timer_ms(path: str, sysfs: str = "/sys/bus/usb-serial/devices") -> int | None:
    """Latency timer of an FTDI chip behind a port, ms; None where there is none."""
    timer = Path(sysfs) / Path(os.path.realpath(path)).name / "latency_timer"
    try:
        return int(timer.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


class SerialPort:
    """A serial port, opened raw, exclusively and in low-latency mode.

    Exclusively: an advisory lock, which other drivers heed, and on real ports TIOCEXCL, which keeps out
    whoever does not (`cat`, ModemManager). A pseudo terminal gets the lock alone: its flag would outlive us.

    Args:
        path: Device path; a link such as ``/dev/serial/by-id/...`` is best, it survives a replug.
        baud: Bits per second.
        link: "auto", or "usb", "ftdi", "uart" where the guess of `link_of` is wrong. Only on a real UART
            (everything but "usb" and "unknown") do the bytes take time, which the stamps take off.

    Raises:
        DeviceNotFoundError: No such path, or it is no serial port.
        DevicePermissionError: This user may not open it.
        DeviceBusyError: Another process has it open.
    """

    def __init__(self, path: str, baud: int = 115_200, *, link: str = "auto") -> None:
        self._name = path
        self._link = link_of(path) if link == "auto" else link
        try:
            self._serial = serial.Serial(
                path, baud, timeout=0, write_timeout=_WRITE_TIMEOUT_S, exclusive=True
            )
        except (OSError, ValueError, termios.error) as error:
            raise _explain(path, error) from None
        self._note_baud()
        self._fd: int = self._serial.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        if self._link != "unknown":
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, termios.TIOCEXCL)
        self._lower_latency()

    def _lower_latency(self) -> None:
        """Ask for ASYNC_LOW_LATENCY: ftdi_sio then sets the chip's latency timer from 16 to 1 ms."""
        try:
            self._serial.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError) as error:
            # Pseudo terminals, CDC-ACM and some adapters refuse; they need it least.
            _log.debug("port=%s low_latency=refused reason=%s", self._name, error)
        timer_ms = latency_timer_ms(self._name)
        if timer_ms is not None and timer_ms > 1 and self._name not in _slow_ports:
            _slow_ports.add(self._name)  # said once, not at each attempt to come back
            _log.warning(
                "port=%s latency_timer=%dms samples come late and in bunches; "
                "`vical install-service` has the udev rule that sets 1 ms",
                *(self._name, timer_ms),
            )

    @property
    def name(self) -> str:
        """Path, for messages."""
        return self._name

    @property
    def link(self) -> str:
        """What lies in between: "usb", "ftdi", "uart" or "unknown" (pseudo terminal)."""
        return self._link

    @property
    def baud(self) -> int:
        """Bits per second on the line as set on this side."""
        return int(self._serial.baudrate)

    @property
    def wire_byte_ns(self) -> float:
        """Time one byte occupies the wire, ns; 0 where no UART is in between."""
        return self._wire_byte_ns

    def _note_baud(self) -> None:
        no_wire = self.link in ("usb", "unknown")
        self._wire_byte_ns = 0.0 if no_wire else BITS_PER_BYTE * 1e9 / self.baud

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """See `BytePort.read`."""
        try:
            events = self._poll.poll(timeout_s * 1e3 if timeout_s > 0.0 else 0)
            data = os.read(self._fd, _CHUNK) if events else b""
            now_ns = time.monotonic_ns()
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EINTR):
                return b"", time.monotonic_ns()
            raise self._lost(error.strerror or str(error)) from None
        if events and not data:
            raise self._lost("it reports data and has none")
        return data, now_ns

    def write(self, data: bytes) -> None:
        """See `BytePort.write`."""
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            raise self._lost("it takes no more bytes") from None
        except (OSError, termios.error) as error:
            raise self._lost(str(error)) from None

    def set_baud(self, baud: int) -> None:
        """See `BytePort.set_baud`."""
        try:
            self._serial.flush()
            self._serial.baudrate = baud
            self._note_baud()
            self._serial.reset_input_buffer()
        except (OSError, termios.error) as error:
            raise self._lost(str(error)) from None

    def _lost(self, why: str) -> DeviceLostError:
        return DeviceLostError(f"{self._name}: the port is gone ({why}); check the cable and power")

    def close(self) -> None:
        """Free the port; may be called twice."""
        if not self._serial.is_open:
            return
        if self._link != "unknown":
            with contextlib.suppress(OSError, termios.error):
                # What a device did not take until now it never will, and the kernel would wait 30 s for it.
                self._serial.reset_output_buffer()
                fcntl.ioctl(self._fd, termios.TIOCNXCL)
        with contextlib.suppress(OSError, termios.error):
            self._serial.close()


def _explain(path: str, error: Exception) -> DriverError:
    """Turn what the system says into what a person can do."""
    code = getattr(error, "errno", None)
    text = str(error)
    if code in (errno.EACCES, errno.EPERM):
        return DevicePermissionError(f"{path}: permission denied; {how_to_open(path, 'dialout')}")
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return DeviceBusyError(f"{path}: another process has it open; find it with: fuser -v {path}")
    if code == errno.ENOENT or not Path(path).exists():
        return DeviceNotFoundError(f"{path}: no such port; `vical devices` lists those that exist")
    if code in (errno.ENXIO, errno.ENODEV, errno.EIO):
        return DeviceNotFoundError(f"{path}: nothing is connected to this port")
    if code in (errno.EMFILE, errno.ENFILE):
        return DriverError(f"{path}: {os.strerror(code)}; see `ulimit -n` of this process")
    if isinstance(error, ValueError):
        return DeviceNotFoundError(f"{path}: the port does not take these settings ({error})")
    return DeviceNotFoundError(f"{path}: this is no serial port; `vical devices` lists those that exist")


class ArrivalLog:
    """Dates each byte of a stream by the read that brought it.

    A record is dated by its last byte: the bytes read after it in the same call were on the wire later,
    so on a real UART their wire time is taken off.

    Attributes:
        end: Stream offset after the newest read.
        t_read_ns: When that was, ns.
    """

    def __init__(self) -> None:
        self._chunks: deque[tuple[int, int]] = deque(maxlen=_CHUNKS_KEPT)
        self.end = self.t_read_ns = 0

    def add(self, size: int, t_read_ns: int) -> None:
        """Note that `size` bytes arrived by a read at `t_read_ns`."""
        self.t_read_ns = t_read_ns
        self.end += size
        self._chunks.append((self.end, t_read_ns))

    def arrival_ns(self, offset: int, wire_byte_ns: float) -> int:
        """When the byte that ends at stream offset `offset` was there, ns; offsets must not decrease."""
        chunks = self._chunks
        while True:
            end, t_read_ns = chunks[0]
            if end >= offset or len(chunks) == 1:
                break
            chunks.popleft()
        return t_read_ns if end == offset else t_read_ns - round((end - offset) * wire_byte_ns)


def wait_for_silence(port: BytePort, quiet_s: float, limit_s: float) -> bool:
    """Read and drop until nothing came for `quiet_s`; False where it still talks after `limit_s`."""
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        data, _ = port.read(quiet_s)
        if not data:
            return True
    return False


def timeout(port: BytePort, what: str) -> DeviceTimeoutError:
    """Make the error for a device that does not answer."""
    return DeviceTimeoutError(f"{port.name}: no answer to {what}; check power, cable and baud")
