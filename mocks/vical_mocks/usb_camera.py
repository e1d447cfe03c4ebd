"""A USB camera (UVC 1.1, bulk, YUYV) at the USB/IP protocol, for the kernel's own drivers.

`vhci_hcd` takes one end of a socket pair as a plugged-in device; the real uvcvideo, its metadata node and
its exposure control then run on it. Needs root and ``modprobe vhci_hcd uvcvideo``. The true instants of the
exposures go into a text file: one line ``number start_ns exposure_ns`` a frame (CLOCK_MONOTONIC).

Run it as a process: ``python -m vical_mocks.usb_camera TRUTH_FILE``; it ends when it is unplugged.
"""

from __future__ import annotations

import socket
import struct
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

ATTACH = Path("/sys/devices/platform/vhci_hcd.0/attach")
WIDTH, HEIGHT, RATE_HZ = 64, 48, 30
CLOCK_HZ = 15_000_000
PAYLOADS = 6
_FRAME = WIDTH * HEIGHT * 2
_CHUNK = _FRAME // PAYLOADS
_INTERVAL = 10_000_000 // RATE_HZ
_HIGH_SPEED = 3
_SUBMIT, _UNLINK, _SUBMITTED, _UNLINKED = 1, 2, 3, 4
_STALL, _RESET = -32, -104
_GET_CUR, _GET_MIN, _GET_MAX, _GET_RES, _GET_LEN, _GET_INFO, _GET_DEF = range(0x81, 0x88)


def _le(layout: str, *values: int) -> bytes:
    return struct.pack("<" + layout, *values)


def configuration() -> bytes:
    """Return the configuration descriptor: video control with a camera terminal, video stream on bulk."""
    terminals = _le("BBBBHBBHHHB3B", 18, 0x24, 2, 1, 0x0201, 0, 0, 0, 0, 0, 3, 0x0A, 0, 0)
    terminals += _le("BBBBHBBB", 9, 0x24, 3, 2, 0x0101, 0, 1, 0)
    control = _le("BBBHHIBB", 13, 0x24, 1, 0x0110, 13 + len(terminals), CLOCK_HZ, 1, 1) + terminals
    yuyv = bytes.fromhex("5955593200001000800000aa00389b71")
    formats = _le("5B", 27, 0x24, 4, 1, 1) + yuyv + _le("6B", 16, 1, 0, 0, 0, 0)
    bit_rate = _FRAME * 8 * RATE_HZ
    formats += _le("5BHHIIIIBI", 30, 0x24, 5, 1, 0, WIDTH, HEIGHT, bit_rate, bit_rate, _FRAME, _INTERVAL, 1,
                   _INTERVAL)  # fmt: skip
    header = _le("4BH8B", 14, 0x24, 1, 1, 14 + len(formats), 0x81, 0, 2, 0, 0, 0, 1, 0)
    body = _le("8B", 8, 0x0B, 0, 2, 0x0E, 3, 0, 0)
    body += _le("9B", 9, 4, 0, 0, 0, 0x0E, 1, 0, 0) + control
    body += _le("9B", 9, 4, 1, 0, 1, 0x0E, 2, 0, 0) + header + formats
    body += _le("4BHB", 7, 5, 0x81, 2, 512, 0)
    return _le("BBH5B", 9, 2, 9 + len(body), 2, 1, 0, 0x80, 250) + body


DEVICE = _le("BBHBBBBHHHBBBB", 18, 1, 0x200, 0xEF, 2, 1, 64, 0x1D6B, 0x0102, 0x100, 1, 2, 3, 1)
STRINGS = ("Vical", "Fake UVC", "UVC0001")


def _string(index: int) -> bytes:
    if index == 0:
        return _le("BBH", 4, 3, 0x409)
    text = STRINGS[index - 1].encode("utf-16-le")
    return bytes([2 + len(text), 3]) + text


@dataclass
class UsbCamera:
    """The device side of one socket.

    Attributes:
        link: Socket whose other end the kernel has.
        truth: Where exposures are written.
        clock_ppm: The camera's clock runs fast by this.
    """

    link: socket.socket
    truth: Path
    clock_ppm: float = 40.0
    exposure_100us: int = 156
    exposure_mode: int = 8
    _pending: list[int] = field(default_factory=list)
    _ready: threading.Condition = field(default_factory=threading.Condition)
    _sending: threading.Lock = field(default_factory=threading.Lock)

    def serve(self) -> None:
        """Answer the kernel until it unplugs the device."""
        threading.Thread(target=self._expose, daemon=True).start()
        while True:
            header = self._receive(48)
            if header is None:
                return
            command, number, _, direction, endpoint = struct.unpack(">5I", header[:20])
            if command == _UNLINK:
                self._unlink(number, *struct.unpack(">I", header[20:24]))
                continue
            (length,) = struct.unpack(">i", header[24:28])
            data = (self._receive(length) or b"") if direction == 0 and length > 0 else b""
            if endpoint == 0:
                answer = self._control(header[40:48], data)
                self._answer(number, answer or b"", _STALL if answer is None else 0, len(data))
            else:
                with self._ready:
                    self._pending.append(number)
                    self._ready.notify()

    def _receive(self, count: int) -> bytes | None:
        data = b""
        while len(data) < count:
            part = self.link.recv(count - len(data))
            if not part:
                return None
            data += part
        return data

    def _answer(self, number: int, data: bytes, status: int = 0, taken: int = 0) -> None:
        head = struct.pack(">5I5i8x", _SUBMITTED, number, 0, 0, 0, status, len(data) or taken, 0, 0, 0)
        with self._sending:
            self.link.sendall(head + data)

    def _unlink(self, number: int, victim: int) -> None:
        with self._ready:
            found = victim in self._pending
            self._pending = [n for n in self._pending if n != victim]
        with self._sending:
            head = struct.pack(">5Ii24x", _UNLINKED, number, 0, 0, 0, _RESET if found else 0)
            self.link.sendall(head)

    def _control(self, setup: bytes, data: bytes) -> bytes | None:
        """Answer a control request; None: stall."""
        kind, request, value, index, length = struct.unpack("<BBHHH", setup)
        answer: bytes | None = None
        if kind & 0x60 == 0x20:
            answer = self._class_request(request, value >> 8, index, data)
        elif kind == 0x80 and request == 6:
            wanted = value >> 8
            texts = {1: DEVICE, 2: configuration()}
            answer = _string(value & 0xFF) if wanted == 3 else texts.get(wanted)
        elif request == 0:
            answer = b"\0\0"
        elif not kind & 0x80:
            answer = b""
        return None if answer is None else answer[:length]

    def _class_request(self, request: int, selector: int, index: int, data: bytes) -> bytes | None:
        entity = index >> 8
        if entity == 0 and index & 0xFF == 1 and selector in (1, 2):  # probe and commit
            probe = _le("HBBI5HII", 1, 1, 1, _INTERVAL, 0, 0, 0, 0, 0, _FRAME, _CHUNK + 12)
            probe += _le("I4B", CLOCK_HZ, 3, 0, 0, 0)
            return {1: b"", _GET_INFO: b"\3", _GET_LEN: _le("H", 34)}.get(request, probe)
        if entity == 1 and selector == 2:  # automatic exposure mode
            if request == 1:
                self.exposure_mode = data[0]
                return b""
            modes = {_GET_INFO: 3, _GET_RES: 9, _GET_DEF: 8}
            return bytes([modes.get(request, self.exposure_mode)])
        if entity == 1 and selector == 4:  # exposure time, 100 us
            if request == 1:
                (self.exposure_100us,) = struct.unpack("<I", data)
                return b""
            limits = {_GET_MIN: 1, _GET_MAX: 5000, _GET_RES: 1, _GET_DEF: 156}
            return b"\3" if request == _GET_INFO else _le("I", limits.get(request, self.exposure_100us))
        return None

    def _ticks(self, t_ns: int) -> int:
        return int(t_ns * CLOCK_HZ * (1 + 1e-6 * self.clock_ppm) / 1e9) & 0xFFFFFFFF

    def _expose(self) -> None:
        """Expose and send frames while the kernel asks for data."""
        number, t_start_ns = 0, time.monotonic_ns()
        with self.truth.open("w", buffering=1) as truth:
            while True:
                with self._ready:
                    if not self._ready.wait_for(lambda: self._pending, 1.0):
                        t_start_ns = time.monotonic_ns()
                        continue
                exposure_ns = self.exposure_100us * 100_000
                if self._send_frame(number, t_start_ns, exposure_ns):
                    truth.write(f"{number} {t_start_ns} {exposure_ns}\n")
                number += 1
                t_start_ns += 1_000_000_000 // RATE_HZ

    def _send_frame(self, number: int, t_start_ns: int, exposure_ns: int) -> bool:
        pixels = bytes([number & 0xFF, 128]) * (_FRAME // 2)
        for k in range(PAYLOADS):
            wait_ns = t_start_ns + exposure_ns + k * 1_000_000 - time.monotonic_ns()
            time.sleep(max(0, wait_ns) * 1e-9)
            with self._ready:
                if not self._ready.wait_for(lambda: self._pending, 0.1):
                    return False
                urb = self._pending.pop(0)
            flags = 0x8C | number & 1 | (2 if k == PAYLOADS - 1 else 0)
            now_ns = time.monotonic_ns()
            sof = now_ns // 1_000_000 & 0x7FF
            header = _le("BBIIH", 12, flags, self._ticks(t_start_ns), self._ticks(now_ns), sof)
            self._answer(urb, header + pixels[k * _CHUNK : (k + 1) * _CHUNK])
        return True


def main(argv: list[str]) -> int:
    """Plug the camera in and serve it."""
    here, there = socket.socketpair()
    ATTACH.write_text(f"0 {there.fileno()} 1 {_HIGH_SPEED}", encoding="ascii")
    there.close()
    UsbCamera(here, Path(argv[0])).serve()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
