"""A rendered video that begins at an unknown time of an IMU's recording: the answer is true, and dated."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.camera import CameraSettings, SimulatedCamera
from vical_mocks.harness.boards import rig_before
from vical_mocks.lens import Lens
from vical_mocks.points import SimulationOptions, simulate_imu
from vical_mocks.rig import reference_rig
from vical_mocks.room import RoomCamera

from vical_daemon.config.priors import Initial
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.logs import open_recording
from vical_daemon.offline.calibrate import document, run_job
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.errors import InputError, OptionError
from vical_daemon.offline.td_icp.own_clock import placed
from vical_daemon.offline.td_icp.request import TdIcpRequest
from vical_daemon.offline.td_icp.single import register_camera
from vical_daemon.vision.target import AprilGrid

SMALL = Lens((260.0, 260.0, 160.0, 120.0), (0.0, 0.0, 0.0, 0.0), (320, 240))
BOARD = "target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.055\ntagSpacing: 0.3\n"
IMU_S, BEGIN_S, FPS = 80.0, 57.213, 15.0


def recorded(folder, rig, camera, length_s, begin_s=BEGIN_S):
    """Write the IMU's table, and a video that begins at `begin_s` of it."""
    folder.mkdir()
    options = SimulationOptions(imu_rate_hz=200.0)
    rows = zip(*simulate_imu(rig, IMU_S, options, np.random.default_rng(7)), strict=True)
    text = [f"{t},{','.join(map(repr, [*w.tolist(), *a.tolist()]))}" for t, w, a in rows]
    (folder / "imu0.csv").write_text("#timestamp [ns],wx,wy,wz,ax,ay,az\n" + "\n".join(text) + "\n")
    (folder / "board.yaml").write_text(BOARD)
    path = str(folder / "GX010007.MP4")
    writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), FPS, rig.lens.resolution)
    for k in range(round(length_s * FPS)):
        writer.write(cv2.cvtColor(camera.render(begin_s + k / FPS), cv2.COLOR_GRAY2BGR))
    writer.release()
    return folder, options.epoch_ns * 1e-9 + begin_s


@pytest.fixture(scope="module")
def before_a_board(tmp_path_factory):
    rig = rig_before(AprilGrid(6, 6, 0.055, 0.3), 0.5, 11)
    settings = CameraSettings(exposure_s=0.002)
    camera = SimulatedCamera(AprilGrid(6, 6, 0.055, 0.3), SMALL, rig.camera_pose_target, settings, 1)
    folder, zero_s = recorded(tmp_path_factory.mktemp("videos") / "a", rig_with(rig, SMALL), camera, 14.0)
    return folder, zero_s, rig


def rig_with(rig, lens):
    return reference_rig(11, trajectory=rig.trajectory, lens=lens)


def test_a_video_and_a_table_give_the_truth_and_the_time_of_the_video(before_a_board):
    folder, zero_s, rig = before_a_board
    said = []
    job = make_job(open_recording(folder), Initial(), target=str(folder / "board.yaml"))
    job.warn = said.append
    result = document(job, run_job(job, lambda *_: None))
    camera = result["cameras"]["cam0"]
    assert result["status"] == "converged"
    truth, found = rig.truth()["cameras"]["cam0"]["T_imu_cam"], camera["T_imu_cam"]
    off = Rotation.from_quat(truth["q_wxyz"], scalar_first=True).inv()
    turned = (off * Rotation.from_quat(found["q_wxyz"], scalar_first=True)).as_rotvec()
    error = np.concatenate([np.subtract(found["p_m"], truth["p_m"]), turned])
    assert (np.abs(error) < 3.0 * np.sqrt(np.diag(found["covariance"]))).all()
    off_s = camera["added_to_stamps_s"] - zero_s + camera["timeshift_cam_imu_s"]
    assert abs(off_s) < 3.0 * camera["timeshift_sigma_s"] < 1e-3
    assert any(f"{camera['added_to_stamps_s']:.3f} s is added to its stamps" in text for text in said)
    assert not job.common_clock  # of two videos, each has its own


def test_td_icp_finds_the_same(before_a_board):
    folder, zero_s, _ = before_a_board
    said = []
    request = TdIcpRequest(folder, target=str(folder / "board.yaml"), warn=said.append)
    shift_s = register_camera(request).result.timeshift_cam_imu_s
    added_s = float(said[-1].split(" s is added")[0].split(" ")[-1])
    assert abs(added_s + shift_s - zero_s) < 5e-4


def test_a_video_of_another_recording_is_named(before_a_board, tmp_path):
    folder, _, _ = before_a_board
    other = rig_with(rig_before(AprilGrid(6, 6, 0.055, 0.3), 0.5, 12), SMALL)
    rows = zip(*simulate_imu(other, 40.0, SimulationOptions(), np.random.default_rng(7)), strict=True)
    text = [f"{t},{','.join(map(repr, [*w.tolist(), *a.tolist()]))}" for t, w, a in rows]
    (tmp_path / "imu0.csv").write_text("#timestamp [ns],wx,wy,wz,ax,ay,az\n" + "\n".join(text) + "\n")
    (tmp_path / "a.mp4").symlink_to(folder / "GX010007.MP4")
    job = make_job(open_recording(tmp_path), Initial(), target=str(folder / "board.yaml"))
    with pytest.raises(InputError, match=r"cam0: when .*a\.mp4 begins in the IMU's recording is not found: "):
        run_job(job, lambda *_: None)


def test_a_given_time_shift_says_nothing_about_a_video(before_a_board):
    folder, _, _ = before_a_board
    prior = CameraPrior(resolution=SMALL.resolution, timeshift_cam_imu_s=0.1)
    given = Initial({"cam0": prior})
    job = make_job(open_recording(folder), given, target=str(folder / "board.yaml"), fix=["timeshift"])
    with pytest.raises(OptionError, match="--fix timeshift: cam0 is a video with a clock of its own"):
        run_job(job, lambda *_: None)


def test_a_part_without_images_is_named(before_a_board):
    folder, _, _ = before_a_board
    target = str(folder / "board.yaml")
    job = make_job(open_recording(folder), Initial(), target=target, seconds=30.0)
    with pytest.raises(OptionError, match=r"has no images; they are from 57\.2 to 71\.\d s"):
        run_job(job, lambda *_: None)


def test_without_a_board_features_show_when_a_video_begins(tmp_path):
    rig = reference_rig(11, lens=SMALL)
    folder, zero_s = recorded(
        tmp_path / "a", rig, RoomCamera(SMALL, rig.camera_pose_target, seed=11), 9.0, 60.4
    )
    recording = open_recording(folder)
    placed(recording, "imu0", recording.cameras["cam0"], None, None)
    assert abs(recording.added_ns["cam0"] * 1e-9 - zero_s) < 0.02
