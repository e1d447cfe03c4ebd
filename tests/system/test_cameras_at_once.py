"""Two cameras in one camera role: a thread and a clock mapping each; one is unplugged and comes back."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from vical_drivers.camera import CameraSettings
from vical_drivers.camera.v4l2.camera import V4l2Camera
from vical_drivers.samples import FrameSource
from vical_mocks.v4l2_camera import FakeCamera, UvcClockModel
from vical_mocks.v4l2_kernel import FakeKernel, RealClock

from vical_daemon.acquire import camera as camera_role
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.messages import decode_image
from vical_daemon.config.model import CameraConfig, loads
from vical_daemon.service.wall_clock import WallClock

pytestmark = pytest.mark.system
CLOCK = WallClock(1_700_000_000_000_000_000)


def test_each_camera_has_its_own_thread_clock_and_fate(tmp_path: Path) -> None:
    config = loads(
        "rig: two\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
        "cameras:\n"
        "  left: {uri: 'v4l2:/dev/video0', size: [64, 48], rate_hz: 30, exposure_s: 0.004}\n"
        "  right: {uri: 'v4l2:/dev/video2', size: [64, 48], rate_hz: 30, exposure_s: 0.004}\n"
        "target: t.yaml\n"
    )
    cameras = {
        "left": FakeCamera(formats={"GREY": {(64, 48): (30.0,)}}, stamps="soe"),
        "right": FakeCamera(
            formats={"YUYV": {(64, 48): (30.0,)}},
            driver="uvcvideo",
            stamps="first-packet",
            uvc=UvcClockModel(),
        ),
    }
    kernels, paths = {}, {}
    for name, camera in cameras.items():
        (tmp_path / name).mkdir()
        kernels[name] = FakeKernel(tmp_path / name, RealClock())
        paths[name] = kernels[name].plug(camera)

    def open_source(wanted: CameraConfig) -> FrameSource:
        name = "left" if wanted.uri.endswith("video0") else "right"
        settings = CameraSettings(exposure_s=wanted.exposure_s, borrow=True)
        return V4l2Camera(paths[name], settings, kernel=kernels[name], wait=time.sleep)

    bus, stop = LocalBus(), threading.Event()
    got: dict[str, list[Sample]] = {"left": [], "right": []}
    for name, samples in got.items():
        bus.subscribe(f"vical/two/camera/{name}/image", samples.append)
    role = threading.Thread(
        target=camera_role.run, args=(config, bus, stop), kwargs={"clock": CLOCK, "open_source": open_source}
    )
    role.start()
    try:
        wait_until(lambda: min(len(samples) for samples in got.values()) >= 15)
        kernels["right"].unplug(cameras["right"])
        seen = len(got["right"])
        so_far = len(got["left"])
        wait_until(lambda: len(got["left"]) >= so_far + 15)  # the other one is not disturbed
        assert len(got["right"]) <= seen + 1
        kernels["right"].plug(cameras["right"])
        wait_until(lambda: len(got["right"]) >= seen + 10)
    finally:
        stop.set()
        role.join(10)
    assert not role.is_alive()
    assert all(kernel.open_descriptors == 0 and not kernel.mappings for kernel in kernels.values())
    for samples in got.values():
        stamps = np.array([decode_image(s.payload).stamp_ns for s in samples])
        assert (np.diff(stamps) > 0).all()
    truth = {CLOCK.unix_ns(t.t_mid_ns) // 2000 for t in cameras["left"].truth}
    stamps = [decode_image(s.payload).stamp_ns for s in got["left"]]
    assert sum(s // 2000 in truth or s // 2000 + 1 in truth for s in stamps) == len(stamps)


def wait_until(condition, timeout_s: float = 30.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)
