"""Grabs from a GenICam camera and writes frames to its standard output; run by the *system's* Python.

Aravis has no package on PyPI: its bindings belong to the distribution's Python (gir1.2-aravis-0.8,
python3-gi), which is not the one of a virtual environment. So this file runs in a process of its own,
imports nothing of vical, and speaks a small protocol that `camera.py` reads:

    b"VGRB" | u32 length of JSON | u32 length of data | JSON | data      (little endian)

JSON kinds: "devices", "open", "frame" (data: the pixels), "lost", "error". Commands come as JSON lines on
standard input; its end ends the process.
"""

from __future__ import annotations

import importlib
import json
import os
import struct
import sys
import threading
import time
from typing import Any, NoReturn

MAGIC = b"VGRB"
BUFFERS = 16
POP_TIMEOUT_US = 200_000


def send(message: dict[str, Any], data: bytes = b"") -> None:
    """Write one message; ends the process when nobody reads any more."""
    text = json.dumps(message).encode()
    try:
        for part in (MAGIC + struct.pack("<II", len(text), len(data)) + text, data):
            view = memoryview(part)
            while view:
                view = view[os.write(1, view) :]
    except BrokenPipeError:
        os._exit(0)


def fail(kind: str, text: object) -> NoReturn:
    """Report a failure and exit."""
    send({"kind": "error", "error": kind, "text": " ".join(str(text).split())})
    sys.exit(1)


def load_aravis() -> Any:
    """Return the Aravis module."""
    try:
        importlib.import_module("gi").require_version("Aravis", "0.8")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError) as error:
        fail("missing", error)


def list_devices(aravis: Any) -> list[dict[str, str]]:
    """Return what Aravis finds, as dictionaries."""
    aravis.update_device_list()
    return [
        {
            "id": aravis.get_device_id(k),
            "vendor": aravis.get_device_vendor(k),
            "model": aravis.get_device_model(k),
            "serial_number": aravis.get_device_serial_nbr(k),
            "address": aravis.get_device_address(k),
            "protocol": aravis.get_device_protocol(k),
        }
        for k in range(aravis.get_n_devices())
    ]


class Grabber:
    """One open camera."""

    def __init__(self, aravis: Any, wanted: dict[str, Any]) -> None:
        self.aravis = aravis
        self.wanted = wanted
        self.refusal: type[Exception] = importlib.import_module("gi.repository.GLib").Error
        devices = list_devices(aravis)  # without it a camera opens but never delivers
        ids = [d["id"] for d in devices]
        name = wanted["id"] or (ids[0] if len(ids) == 1 else "")
        if name not in ids and not any(name and name == d["address"] for d in devices):
            fail("not-found", f"aravis:{name}: not found; there are: {', '.join(ids) or 'none'}")
        try:
            self.camera = aravis.Camera.new(name)
            self.device = next(d for d in devices if name in (d["id"], d["address"]))
            self.configure()
        except Exception as error:  # of the camera (`refusal`), or of values that the bindings do not take
            text = getattr(error, "message", str(error))
            busy = "controlled" in text or "denied" in text.lower()
            fail("busy" if busy else "refused", f"aravis:{name}: {text}")
        self.lost = threading.Event()
        self.camera.get_device().connect("control-lost", lambda *_: self.lost.set())

    def configure(self) -> None:
        """Apply the settings."""
        camera, wanted = self.camera, self.wanted
        if wanted.get("pixel_format"):
            camera.set_pixel_format_from_string(wanted["pixel_format"])
        if wanted.get("width"):
            camera.set_region(0, 0, wanted["width"], wanted["height"])
        if wanted.get("rate_hz"):
            camera.set_frame_rate(wanted["rate_hz"])
        if wanted.get("exposure_s"):
            if camera.is_exposure_auto_available():
                camera.set_exposure_time_auto(self.aravis.Auto.OFF)
            self.set_exposure(wanted["exposure_s"])
        if wanted.get("gain") is not None:
            if camera.is_gain_auto_available():
                camera.set_gain_auto(self.aravis.Auto.OFF)
            camera.set_gain(wanted["gain"])
        for name, value in wanted.get("controls", {}).items():
            self.set_feature(name, value)

    def set_feature(self, name: str, value: float) -> None:
        """Write a GenICam feature by name, whole numbers as integers."""
        if float(value).is_integer():
            try:
                self.camera.set_integer(name, int(value))
                return
            except self.refusal:
                pass  # it is a float feature: written below, where a refusal counts
        self.camera.set_float(name, float(value))

    def set_exposure(self, exposure_s: float) -> None:
        """Set the exposure time within the camera's bounds."""
        low, high = self.camera.get_exposure_time_bounds()
        if not low <= exposure_s * 1e6 <= high:
            fail("refused", f"exposure {exposure_s:g} s is out of range: {low * 1e-6:g} to {high * 1e-6:g} s")
        self.camera.set_exposure_time(exposure_s * 1e6)

    def exposure_s(self) -> float | None:
        """Exposure in force; None where the camera chooses it or cannot tell."""
        camera = self.camera
        if not camera.is_exposure_time_available() or self.exposure_is_automatic():
            return None
        return float(camera.get_exposure_time()) * 1e-6

    def exposure_is_automatic(self) -> bool:
        """Whether the camera chooses its exposure itself."""
        camera = self.camera
        if not camera.is_exposure_auto_available():
            return False
        return bool(camera.get_exposure_time_auto() != self.aravis.Auto.OFF)

    def description(self) -> dict[str, Any]:
        """What was obtained."""
        camera = self.camera
        x, y, width, height = camera.get_region()
        return {
            "kind": "open",
            "device": self.device,
            "region": [x, y, width, height],
            "pixel_format": camera.get_pixel_format_as_string(),
            "rate_hz": camera.get_frame_rate() if camera.is_frame_rate_available() else 0.0,
            "exposure_s": self.exposure_s(),
            "automatic": self.exposure_is_automatic(),
        }

    def run(self) -> None:
        """Deliver frames until the pipe ends."""
        stream = self.camera.create_stream(None, None)
        if stream is None:
            fail("busy", "the stream cannot be opened; another program has it")
        payload = self.camera.get_payload()
        for _ in range(BUFFERS):
            stream.push_buffer(self.aravis.Buffer.new_allocate(payload))
        send(self.description())
        self.camera.start_acquisition()
        threading.Thread(target=self.obey, daemon=True).start()
        success = self.aravis.BufferStatus.SUCCESS
        while not self.lost.is_set():
            buffer = stream.timeout_pop_buffer(POP_TIMEOUT_US)
            if buffer is None:
                continue
            self.forward(buffer, buffer.get_status() == success)
            stream.push_buffer(buffer)
        send({"kind": "lost", "text": "the camera went away"})

    def forward(self, buffer: Any, whole: bool) -> None:
        """Send one buffer; a damaged one without its pixels."""
        arrival_ns, real_ns = time.monotonic_ns(), time.time_ns()
        message = {
            "kind": "frame",
            "whole": whole,
            "status": buffer.get_status().value_nick,
            "frame_id": buffer.get_frame_id(),
            "device_ns": buffer.get_timestamp(),
            "first_packet_ns": arrival_ns - (real_ns - buffer.get_system_timestamp()),
            "arrival_ns": arrival_ns,
        }
        if not whole:
            send(message)
            return
        message["width"], message["height"] = buffer.get_image_width(), buffer.get_image_height()
        send(message, buffer.get_data())

    def obey(self) -> None:
        """Take commands; the end of the input ends the process."""
        for line in sys.stdin:
            command = json.loads(line)
            if "exposure_s" in command:
                self.set_exposure(command["exposure_s"])
                send({"kind": "exposure", "exposure_s": self.exposure_s(), "t_ns": time.monotonic_ns()})
        try:
            self.camera.stop_acquisition()
        finally:
            os._exit(0)


def main() -> None:
    """Run with one JSON argument: {"list": true} or the settings of a camera."""
    wanted = json.loads(sys.argv[1])
    aravis = load_aravis()
    for interface in wanted.get("interfaces", []):
        aravis.enable_interface(interface)
    if wanted.get("list"):
        send({"kind": "devices", "devices": list_devices(aravis)})
        return
    Grabber(aravis, wanted).run()


if __name__ == "__main__":
    main()
