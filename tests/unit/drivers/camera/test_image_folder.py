"""An image folder with UNIX stamps plays as a camera does: in real time, on CLOCK_MONOTONIC."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import numpy as np
import pytest
from vical_drivers.camera import check_camera, open_camera
from vical_drivers.errors import DeviceRefusedError

from vical_daemon.acquire.camera import CameraEncoder
from vical_daemon.bus.messages import decode_image as decode_image_message
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.vision.image_codec import decode_image, encode_image

T0_NS = 1_403_636_579_763_555_584  # EuRoC's clock: UNIX time of 2014
STEP_NS = 80_000_000
COUNT = 5


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    lines = ["#timestamp [ns],filename"]
    for k in range(COUNT):
        stamp_ns = T0_NS + k * STEP_NS
        (tmp_path / "data" / f"{stamp_ns}.png").write_bytes(encode_image(np.full((48, 64), k, np.uint8)))
        lines.append(f"{stamp_ns},{stamp_ns}.png")
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_stamps_are_of_this_clock_and_as_far_apart_as_recorded(folder: Path) -> None:
    before_ns = time.monotonic_ns()
    with open_camera(f"folder:{folder}", decoder=decode_image) as camera:
        frames = [camera.read(60.0) for _ in range(COUNT)]
    stamps = [f.t_exposure_mid_ns for f in frames]
    assert [b - a for a, b in itertools.pairwise(stamps)] == [STEP_NS] * (COUNT - 1)
    assert stamps[0] >= before_ns
    assert all(f.t_arrival_ns >= f.t_exposure_mid_ns for f in frames)  # never before its time


def test_a_frame_that_is_not_due_is_not_given(folder: Path) -> None:
    listing = folder / "data.csv"
    name = listing.read_text().splitlines()[1].split(",")[1]
    listing.write_text(f"{T0_NS},{name}\n{T0_NS + 3600 * 10**9},{name}\n")  # the second an hour later
    with open_camera(f"folder:{folder}", decoder=decode_image) as camera:
        assert camera.read(1.0) is not None
        assert camera.read(0.01) is None


def test_the_service_can_publish_it(folder: Path) -> None:
    clock = private_clock()
    role = CameraEncoder("rig0", "cam0", clock)
    with open_camera(f"folder:{folder}", decoder=decode_image) as camera:
        payload = role.message(camera.read(1.0))
    assert payload is not None
    age_s = (clock.now_ns() - decode_image_message(payload).stamp_ns) * 1e-9
    assert 0 <= age_s < 60


def test_check_knows_its_rate_and_size(folder: Path) -> None:
    wanted = {"decoder": decode_image, "width": 64, "height": 48, "rate_hz": 12.5}
    assert check_camera(f"folder:{folder}", **wanted) == []
    (rate,) = check_camera(f"folder:{folder}", **{**wanted, "rate_hz": 20.0})
    assert rate.endswith("asked for rate_hz 20, got 12.500")
    (size,) = check_camera(f"folder:{folder}", **{**wanted, "width": 640, "height": 480})
    assert "asked for 640 x 480 pixels, got 64 x 48" in size
    (exposure,) = check_camera(f"folder:{folder}", **{**wanted, "exposure_s": 0.005})
    assert exposure.endswith("asked for exposure_s 0.005; the camera does not say what it does")


def test_a_list_out_of_order_is_refused(folder: Path) -> None:
    lines = (folder / "data.csv").read_text().splitlines()
    (folder / "data.csv").write_text("\n".join([lines[0], lines[2], lines[1]]) + "\n")
    with pytest.raises(DeviceRefusedError, match="do not increase"):
        open_camera(f"folder:{folder}", decoder=decode_image)
