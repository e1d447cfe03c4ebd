"""GenICam through Aravis: the grabber process on Aravis' own fake cameras."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from vical_drivers import errors
from vical_drivers.camera import CameraSettings
from vical_drivers.camera.aravis.camera import AravisCamera, list_aravis_cameras
from vical_drivers.camera.aravis.process import system_python

pytestmark = pytest.mark.system
FAKE = ("Fake",)


@pytest.fixture(scope="module", autouse=True)
def _aravis() -> None:
    try:
        list_aravis_cameras(FAKE)
    except errors.MissingLibraryError as error:
        pytest.skip(str(error))


def open_fake(**settings: object) -> AravisCamera:
    return AravisCamera("Fake_1", CameraSettings(**settings), interfaces=FAKE)


def test_fake_camera_delivers_stamped_frames() -> None:
    with open_fake(rate_hz=100.0, exposure_s=0.002, width=128, height=64) as source:
        assert source.info.details["size"] == "128x64"
        assert source.info.details["rate_hz"] == "100"
        frames = [source.read(2.0) for _ in range(130)]
        stats = source.stats()
    assert all(f.image.shape == (64, 128) and f.exposure_ns == 2_000_000 for f in frames)
    assert frames[0].stamp_rule == "first-packet-exposure/2"
    assert frames[-1].stamp_rule == "first-packet(device-clock)-exposure/2"
    assert stats.samples == 130
    assert stats.lost == sum(f.dropped_before for f in frames)
    delays_ms = [(f.t_arrival_ns - f.t_exposure_mid_ns) * 1e-6 for f in frames]
    assert min(delays_ms) > 0.9  # half the exposure at least


def test_refusals_name_the_camera_and_the_range() -> None:
    with pytest.raises(errors.DeviceNotFoundError, match=r"there are: .*Fake_1"):
        AravisCamera("Acme-7", interfaces=FAKE)
    with pytest.raises(errors.DeviceRefusedError, match="out of range"):
        open_fake(exposure_s=1000.0)


def test_a_process_that_dies_is_a_lost_camera_that_comes_back() -> None:
    source = open_fake(rate_hz=100.0, width=64, height=64)
    try:
        source.read(2.0)
        source._grabber._process.kill()
        with pytest.raises(errors.DeviceLostError):
            drain(source)
        assert source.read(5.0) is not None
        assert source.stats().reconnects == 1
        process = source._grabber._process
    finally:
        source.close()
        source.close()
    assert process.poll() is not None  # nothing is left behind
    with pytest.raises(errors.DeviceLostError, match="closed"):
        source.read(0.1)


def drain(source: AravisCamera) -> None:
    for _ in range(1000):
        source.read(1.0)


def test_a_missing_binding_names_its_packages(tmp_path: Path, monkeypatch) -> None:
    bare = tmp_path / "python3"  # a Python without the distribution's packages
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    bare.chmod(0o755)
    monkeypatch.setenv("VICAL_SYSTEM_PYTHON", str(bare))
    with pytest.raises(errors.MissingLibraryError, match=r"apt install gir1\.2-aravis-0\.8 python3-gi"):
        list_aravis_cameras()
    monkeypatch.setenv("VICAL_SYSTEM_PYTHON", str(tmp_path / "nothing"))
    with pytest.raises(errors.MissingLibraryError):
        system_python()


@pytest.fixture
def gige_camera() -> Iterator[str]:
    """A GigE Vision camera of Aravis' on loopback."""
    program = os.environ.get("VICAL_ARV_FAKE_GV") or shutil.which("arv-fake-gv-camera-0.8")
    if program is None:
        pytest.skip("no arv-fake-gv-camera-0.8: apt install aravis-tools (or VICAL_ARV_FAKE_GV=path)")
    process = subprocess.Popen(
        [program, "-i", "127.0.0.1"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    time.sleep(0.5)
    yield "127.0.0.1"
    process.terminate()
    process.wait()


@pytest.mark.root  # Aravis' packet socket; through the UDP socket of an ordinary user, loopback loses packets
def test_gige_vision_on_loopback(gige_camera: str) -> None:
    with AravisCamera(gige_camera, CameraSettings(rate_hz=30.0, exposure_s=0.003)) as source:
        frames = [source.read(2.0) for _ in range(45)]
        assert source.info.details["transport"] == "GigEVision"
        unnumbered = source.stats().extra.get("lost_in_camera", 0)  # on a busy machine the camera pauses
    assert all(f is not None for f in frames)
    skipped = [b.sequence - a.sequence - 1 for a, b in itertools.pairwise(frames)]
    dropped = [f.dropped_before for f in frames[1:]]
    assert all(d >= s for d, s in zip(dropped, skipped, strict=True))
    assert sum(dropped) == sum(skipped) + unnumbered
    assert frames[-1].stamp_rule == "first-packet(device-clock)-exposure/2"
