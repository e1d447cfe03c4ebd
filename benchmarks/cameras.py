"""Camera drivers: CPU and latency of the grabber, and stamp errors against the stand-ins' truth."""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from vical_drivers.camera import CameraSettings
from vical_drivers.camera.v4l2.camera import V4l2Camera
from vical_mocks import firewire_rig
from vical_mocks.v4l2_camera import FakeCamera, UvcClockModel
from vical_mocks.v4l2_kernel import FakeKernel, RealClock

from vical_daemon.vision.image_codec import decode_image, encode_image

ROOT = Path(__file__).resolve().parent.parent
SHIM = ROOT / "tests/unit/drivers/camera/iidc/fake_firewire.c"


def main(argv: list[str]) -> int:
    """Run and print Markdown tables."""
    parser = argparse.ArgumentParser(prog="benchmarks cameras", description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each grabbing run")
    parser.add_argument("--json", default="", help=argparse.SUPPRESS)  # the process on the FireWire bus
    args = parser.parse_args(argv)
    if args.json == "iidc":
        return _iidc_inside(args.seconds)
    print(_grabbing(args.seconds))
    print(_stamps(args.seconds))
    return 0


# -- CPU and latency: real time, on the fake kernel -------------------------------------------------------


def _jpeg(number: int, _name: str, width: int, height: int) -> np.ndarray:
    y, x = np.mgrid[0:height, 0:width]
    image = ((x // 40 + y // 40) % 2 * 200 + number % 40).astype(np.uint8)
    return np.frombuffer(encode_image(image, "jpeg"), np.uint8)


CASES = (
    ("GREY 640x480 at 30 Hz", "GREY", (640, 480), 30.0, {}),
    ("YUYV 640x480 at 30 Hz", "YUYV", (640, 480), 30.0, {}),
    ("MJPG 640x480 at 30 Hz", "MJPG", (640, 480), 30.0, {"decoder": decode_image}),
    ("GREY 1280x1024 at 60 Hz", "GREY", (1280, 1024), 60.0, {}),
    ("GREY 1280x1024 at 60 Hz, borrowed", "GREY", (1280, 1024), 60.0, {"borrow": True}),
    ("YUYV 1280x1024 at 60 Hz, borrowed", "YUYV", (1280, 1024), 60.0, {"borrow": True}),
    ("Bayer 1280x1024 at 60 Hz to mono8", "RGGB", (1280, 1024), 60.0, {}),
)


def _grabbing(seconds: float) -> str:
    lines = [
        "| source | frames | dropped | CPU with the stand-in, % of a core | ready to read: p50 / p99, ms |",
        "|---|---|---|---|---|",
    ]
    for title, name, size, rate_hz, settings in CASES:
        lines.append(_grab(title, name, size, rate_hz, settings, seconds))
    return "\n".join(lines) + "\n"


def _grab(
    title: str, name: str, size: tuple[int, int], rate_hz: float, settings: dict, seconds: float
) -> str:
    picture = None
    if name == "MJPG":
        data = _jpeg(0, name, *size)
        picture = lambda *_: data  # noqa: E731
    camera = FakeCamera(formats={name: {size: (rate_hz,)}}, picture=picture, static=picture is None)
    with tempfile.TemporaryDirectory() as folder:
        kernel = FakeKernel(Path(folder), RealClock())
        path = kernel.plug(camera)
        latencies = []
        gc.collect()
        with V4l2Camera(path, CameraSettings(exposure_s=0.004, **settings), kernel=kernel) as source:
            cpu_s, started = time.thread_time(), time.monotonic()
            while time.monotonic() - started < seconds:
                frame = source.read(1.0)
                if frame is not None:
                    latencies.append(frame.t_arrival_ns - camera.truth[frame.sequence].t_ready_ns)
                    frame.image.ravel()[:: max(1, frame.image.size - 1)].sum()  # somebody looks at it
            cpu_s, elapsed = time.thread_time() - cpu_s, time.monotonic() - started
            stats = source.stats()
    p50, p99 = np.percentile(latencies, [50, 99]) * 1e-6
    share = 100 * cpu_s / elapsed
    return f"| {title} | {stats.samples} | {stats.lost} | {share:.1f} | {p50:.2f} / {p99:.2f} |"


# -- stamps ------------------------------------------------------------------------------------------


def _stamps(seconds: float) -> str:
    lines = [
        "| source | stamp rule | frames | bias, us | sd, us | largest, us |",
        "|---|---|---|---|---|---|",
    ]
    for stamps in ("soe", "eof"):
        camera = FakeCamera(stamps=stamps)
        settings = {"exposure_s": 0.0071, "readout_s": 0.008}
        lines.append(_stamp_errors(f"V4L2, driver stamps {stamps}", camera, settings, 600, 0))
    for ppm, mean_us, floor_us in ((37, 300, 15), (-80, 1500, 15), (37, 300, 125)):
        clock = UvcClockModel(skew_ppm=ppm, delay_mean_ns=mean_us * 1000, delay_floor_ns=floor_us * 1000)
        title = f"UVC, clock {ppm:+d} ppm, payloads late by {floor_us} us + exp({mean_us} us)"
        lines.append(_stamp_errors(title, _usb(clock), {"exposure_s": 0.012}, 9000, 600))
    bad = UvcClockModel(scatter_ns=60e6)
    lines.append(_stamp_errors("UVC, useless clock readings", _usb(bad), {"exposure_s": 0.012}, 1200, 0))
    lines += _iidc(seconds)
    return "\n".join(lines) + "\n"


def _usb(clock: UvcClockModel) -> FakeCamera:
    formats = {"YUYV": {(64, 48): (30.0,)}}
    return FakeCamera(driver="uvcvideo", stamps="first-packet", formats=formats, uvc=clock)


def _stamp_errors(title: str, camera: FakeCamera, settings: dict, frames: int, skip: int) -> str:
    with tempfile.TemporaryDirectory() as folder:
        kernel = FakeKernel(Path(folder))
        errors, rule = [], ""
        with V4l2Camera(kernel.plug(camera), CameraSettings(**settings), kernel=kernel) as source:
            for number in range(frames):
                frame = source.read(1.0)
                assert frame is not None
                rule = frame.stamp_rule
                if number >= skip:
                    errors.append(frame.t_exposure_mid_ns - camera.truth[frame.sequence].t_mid_ns)
    return _row(title, rule, np.array(errors) * 1e-3)


def _row(title: str, rule: str, errors_us: np.ndarray) -> str:
    figures = (errors_us.mean(), errors_us.std(), np.abs(errors_us).max())
    return f"| {title} | {rule} | {errors_us.size} | " + " | ".join(f"{x:.2f}" for x in figures) + " |"


def _iidc(seconds: float) -> list[str]:
    missing = firewire_rig.missing_tools()
    if missing:
        return [f"| FireWire | not run: {missing} | | | | |"]
    with tempfile.TemporaryDirectory() as folder:
        environment = firewire_rig.build(SHIM, Path(folder))
        command = [sys.executable, "-m", "benchmarks", "cameras", "--json", "iidc", "--seconds", str(seconds)]
        done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True)
    result = json.loads(done.stdout)
    return [
        _row(f"FireWire, embedded stamps, bus clock {result['ppm']:+g} ppm", result["rule"], np.array(part))
        for part in (result["errors_us"],)
    ]


def _iidc_inside(seconds: float) -> int:
    from vical_drivers.camera import open_camera

    rig = firewire_rig.FireWireRig(os.environ[firewire_rig.ENVIRONMENT])
    rig.shared.ppm = 37.0
    errors_us, rule = [], ""
    with open_camera("iidc:", width=640, height=480, rate_hz=60.0, exposure_s=0.006) as source:
        for _ in range(round(seconds * 60)):
            frame = source.read(1.0)
            if frame is None:
                continue
            counter = int.from_bytes(frame.image.reshape(-1)[8:12].tobytes(), "big")
            truth = rig.exposures_of(counter)
            errors_us.append((frame.t_exposure_mid_ns - truth.t_mid_ns) * 1e-3)
            rule = frame.stamp_rule
    print(json.dumps({"ppm": 37.0, "rule": rule, "errors_us": errors_us}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
