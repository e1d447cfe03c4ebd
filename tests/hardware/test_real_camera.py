"""Any camera that VICAL_CAMERA names (a URI, e.g. /dev/video0 or iidc:GUID): frames, stamps, no leaks."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from vical_drivers.camera import list_cameras, open_camera

from vical_daemon.vision.image_codec import decode_image

pytestmark = pytest.mark.hardware


@pytest.fixture(scope="module")
def uri() -> str:
    name = os.environ.get("VICAL_CAMERA", "")
    if not name:
        there = (
            ", ".join(c.details.get("uri", c.path) for c in list_cameras(schemes=("v4l2", "iidc"))) or "none"
        )
        pytest.skip(f"VICAL_CAMERA names no camera (plugged in: {there})")
    return name


def test_frames_are_whole_stamped_and_complete(uri: str) -> None:
    with open_camera(uri, decoder=decode_image) as source:
        frames = [frame for _ in range(60) if (frame := source.read(5.0)) is not None]
        stats = source.stats()
    assert len(frames) == 60
    stamps = np.array([f.t_exposure_mid_ns for f in frames])
    assert (np.diff(stamps) > 0).all()
    now_ns = time.monotonic_ns()
    assert (np.abs(now_ns - stamps) < 60e9).all()
    assert stats.samples == 60
    assert stats.lost == sum(f.dropped_before for f in frames)


def test_opening_again_and_again_leaves_nothing(uri: str) -> None:
    def cycle() -> int:
        with open_camera(uri, decoder=decode_image) as source:
            assert source.read(5.0) is not None
        return len(list(Path("/proc/self/fd").iterdir()))

    first = cycle()
    assert all(cycle() <= first for _ in range(10))
