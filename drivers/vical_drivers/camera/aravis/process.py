"""The process that grabs for `aravis`: started under the system's Python, spoken to over two pipes."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import shutil
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

from vical_drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceRefusedError,
    DriverError,
    MissingLibraryError,
)

PACKAGES = "gir1.2-aravis-0.8 python3-gi"
_GRABBER = Path(__file__).with_name("grabber.py")
_HEADER = struct.Struct("<4sII")
_MAGIC = b"VGRB"
OPEN_TIMEOUT_S = 15.0
_PIPE_BYTES = 1 << 20
_ERRORS: dict[str, type[DriverError]] = {
    "not-found": DeviceNotFoundError,
    "busy": DeviceBusyError,
    "refused": DeviceRefusedError,
}


class GrabberProcess:
    """The process at the other end of a pipe, and its messages."""

    def __init__(self, request: dict[str, Any]) -> None:
        python = system_python()
        self._buffer = bytearray()
        self._process = subprocess.Popen(
            # -I: nothing of this environment's packages may leak into the other Python
            [python, "-I", str(_GRABBER), json.dumps(request)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert self._process.stdout is not None and self._process.stdin is not None
        self._out = self._process.stdout.fileno()
        self._in = self._process.stdin
        with contextlib.suppress(OSError):  # above the limit for users: then writes take more turns
            fcntl.fcntl(self._out, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def receive(self, timeout_s: float) -> tuple[dict[str, Any], memoryview] | None:
        """Return the next message and its data; None after `timeout_s`.

        Raises:
            DriverError: The process reported a failure, or ended.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            message = self._parse()
            if message is not None:
                return self._check(message)
            left_s = deadline - time.monotonic()
            poller = select.poll()
            poller.register(self._out, select.POLLIN)
            if not poller.poll(max(0.0, left_s) * 1e3):
                return None
            data = os.read(self._out, _PIPE_BYTES)
            if not data:
                raise DeviceLostError("aravis: the grabber process ended")
            self._buffer += data

    def _parse(self) -> tuple[dict[str, Any], memoryview] | None:
        if len(self._buffer) < _HEADER.size:
            return None
        magic, text_bytes, data_bytes = _HEADER.unpack_from(self._buffer)
        if magic != _MAGIC:
            raise DeviceLostError("aravis: the grabber process sent nonsense")
        start = _HEADER.size + text_bytes
        end = start + data_bytes
        if len(self._buffer) < end:
            return None
        # what belongs to this message is cut off, so that its pixels need no copy
        message, self._buffer = self._buffer[:end], self._buffer[end:]
        return json.loads(message[_HEADER.size : start]), memoryview(message)[start:]

    @staticmethod
    def _check(message: tuple[dict[str, Any], memoryview]) -> tuple[dict[str, Any], memoryview]:
        fields = message[0]
        if fields["kind"] == "lost":
            raise DeviceLostError(f"aravis: {fields['text']}")
        if fields["kind"] == "error":
            if fields["error"] == "missing":
                raise MissingLibraryError(f"GenICam cameras need Aravis: sudo apt install {PACKAGES}")
            raise _ERRORS[fields["error"]](fields["text"])
        return message

    def send(self, command: dict[str, Any]) -> None:
        """Give the process a command.

        Raises:
            DeviceLostError: It has ended.
        """
        try:
            self._in.write(json.dumps(command).encode() + b"\n")
            self._in.flush()
        except OSError as error:
            raise DeviceLostError("aravis: the grabber process ended") from error

    def close(self) -> None:
        """End the process; may be called twice."""
        with contextlib.suppress(OSError):  # it has ended already
            self._in.close()  # the end of its input ends it
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()


def system_python() -> str:
    """Return the distribution's Python, which has the bindings; VICAL_SYSTEM_PYTHON names another.

    Raises:
        MissingLibraryError: There is none.
    """
    python = os.environ.get("VICAL_SYSTEM_PYTHON", "/usr/bin/python3")
    if shutil.which(python) is None:
        raise MissingLibraryError(f"GenICam cameras need {python}: sudo apt install python3 {PACKAGES}")
    return python
