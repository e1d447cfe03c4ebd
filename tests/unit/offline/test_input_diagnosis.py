"""Mistakes in the input that `vical calibrate` names when it found nothing."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.harness.asl import TARGET, write_asl
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from vical_daemon.bus.messages import encode_image
from vical_daemon.config.priors import Initial
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.logs import open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.input_diagnosis import diagnose_input

SHIFT_S = 0.012
RIG = reference_rig(3, timeshift_cam_imu_s=SHIFT_S)
R, P = RIG.R_imu_cam, RIG.p_imu_cam


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_asl(tmp_path_factory.mktemp("held") / "a", simulate(3, 8.0, rig=RIG))


@pytest.mark.parametrize(
    ("fix", "mounting", "shift_s", "says"),
    [
        ("extrinsics", (R, P), SHIFT_S, ""),
        ("extrinsics", (R.T, -R.T @ P), SHIFT_S, r"held by --fix extrinsics is .*; its inverse fits"),
        ("extrinsics", (R @ np.diag([-1.0, -1.0, 1.0]), P), SHIFT_S, r"is 180 deg from .*\(by 0, 0, 180 deg"),
        ("timeshift", (R, P), SHIFT_S, ""),
        (
            "timeshift",
            (R, P),
            -SHIFT_S,
            r"is -12.0 ms, rotations show 1\d\.\d ± .* \(is its sign reversed\?\)",
        ),
        ("timeshift", (R, P), 0.05, r"is 50.0 ms, rotations show 1\d\.\d ± [\d.]+ ms; correct it"),
    ],
)
def test_a_held_value_that_rotations_contradict_is_named(folder, fix, mounting, shift_s, says):
    prior = CameraPrior(
        resolution=RIG.lens.resolution,
        intrinsics=RIG.lens.intrinsics,
        T_imu_cam=mounting,
        timeshift_cam_imu_s=shift_s,
    )
    job = make_job(
        open_recording(folder),
        Initial(cameras={"cam0": prior}),
        target=str(folder / "target.yaml"),
        fix=[fix],
    )
    found = diagnose_input(job)
    assert bool(found) == bool(says)
    assert re.search(says, found)


def board_image(cols: int, rows: int) -> np.ndarray:
    """A checkerboard with so many inner corners, from the front, on white."""
    squares = (np.indices((rows + 1, cols + 1)).sum(axis=0) % 2).astype(np.uint8) * 200 + 20
    image = np.full((240, 320), 220, np.uint8)
    board = squares.repeat(24, axis=0).repeat(24, axis=1)
    image[20 : 20 + board.shape[0], 30 : 30 + board.shape[1]] = board
    return image


@pytest.mark.parametrize(
    ("seen", "says"), [((8, 6), ""), ((7, 5), "a checkerboard with 7 x 5 inner corners")]
)
def test_another_board_is_named_although_few_images_show_it(tmp_path, write_asl, seen, says):
    """In the service one image in thirty is compared with other boards."""
    recording = open_recording(write_asl(tmp_path / "a"))
    empty = np.full((240, 320), 220, np.uint8)
    with LogWriter(tmp_path / "a.mcap") as writer:
        for n, (key, payload) in enumerate(recording.messages(recording.imus.values())):
            stamp_ns = stamp_of(payload)
            writer.write(key, payload, stamp_ns)
            if n % 40 == 0:
                image = board_image(*seen) if n % 200 == 0 else empty
                message = encode_image(stamp_ns, "cam0", image, "mono8")
                writer.write("vical/rig0/camera/cam0/image", message, stamp_ns)
    (tmp_path / "target.yaml").write_text(TARGET)
    job = make_job(open_recording(tmp_path / "a.mcap"), Initial(), target=str(tmp_path / "target.yaml"))
    found = diagnose_input(job)
    assert says in found and bool(found.count("in view")) == bool(says)


def test_points_of_another_board_are_named(folder, tmp_path):
    """A log may hold points that were found with another target file."""
    other = tmp_path / "other.yaml"
    other.write_text("target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n")
    prior = CameraPrior(resolution=RIG.lens.resolution)
    job = make_job(open_recording(folder), Initial({"cam0": prior}), target=str(other))
    assert re.match(
        r"cam0: the points in its \d+ images fit no pose of the board in .*/other.yaml", diagnose_input(job)
    )
