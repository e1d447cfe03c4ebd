"""The real uvcvideo driver on an emulated USB camera (vhci_hcd): its metadata node gives the stamps."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from vical_drivers import errors
from vical_drivers.camera import CameraSettings, list_cameras
from vical_drivers.camera.v4l2.camera import V4l2Camera
from vical_mocks import usb_camera

pytestmark = [pytest.mark.hardware, pytest.mark.root]  # root plugs the camera in
SECONDS = 20.0


@pytest.fixture
def truth_file(tmp_path: Path) -> Iterator[Path]:
    """Plug the emulated camera in; the file with its true exposures."""
    if not usb_camera.ATTACH.exists() or not Path("/sys/module/uvcvideo").exists():
        pytest.skip("no emulated USB bus: sudo modprobe -a vhci_hcd uvcvideo")
    path = tmp_path / "truth"
    process = subprocess.Popen([sys.executable, "-m", "vical_mocks.usb_camera", str(path)])
    yield path
    process.kill()
    process.wait()


def drain(source: V4l2Camera) -> None:
    for _ in range(100):
        source.read(1.0)


def find_camera() -> str:
    for _ in range(120):
        for camera in list_cameras(schemes=("v4l2",)):
            if camera.serial_number == usb_camera.STRINGS[2] and "problem" not in camera.details:
                return camera.path
        time.sleep(0.5)
    raise AssertionError("uvcvideo did not take the emulated camera")


def test_fitted_stamps_lie_at_a_constant_small_distance_from_the_truth(truth_file: Path) -> None:
    with V4l2Camera(find_camera(), CameraSettings(exposure_s=0.010)) as source:
        assert source.info.details["uvc_metadata"] == "yes"
        assert source.info.details["exposure_s"] == "0.01"
        frames, end = [], time.monotonic() + SECONDS
        while time.monotonic() < end:
            frame = source.read(1.0)
            if frame is not None:
                frames.append(frame)
    truth = np.loadtxt(truth_file, dtype=np.int64)
    middles = truth[:, 1] + truth[:, 2] // 2
    stamps = np.array([f.t_exposure_mid_ns for f in frames if f.stamp_rule == "uvc-pts+exposure/2"])
    assert stamps.size > 0.3 * len(frames)
    errors_us = (stamps - middles[np.abs(stamps[:, None] - middles).argmin(axis=1)]) * 1e-3
    settled = errors_us[errors_us.size // 2 :]
    # the least way of a payload through an emulated bus is a constant; about it nothing may be left
    assert 0 < np.median(settled) < 2000.0
    assert np.percentile(np.abs(settled - np.median(settled)), 95) < 50.0


def test_unplugged_while_it_streams(truth_file: Path) -> None:
    source = V4l2Camera(find_camera(), CameraSettings())
    try:
        assert source.read(10.0) is not None
        Path("/sys/devices/platform/vhci_hcd.0/detach").write_text("0", encoding="ascii")
        with pytest.raises(errors.DeviceLostError):
            drain(source)
        with pytest.raises(errors.DeviceLostError):
            source.read(0.1)
    finally:
        source.close()
