"""A recording played as live devices: stamps of now, one time base, played once, joined late."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import numpy as np
import pytest
from vical_drivers.errors import DataEndedError, DeviceNotFoundError, DeviceRefusedError
from vical_drivers.samples import FrameSource, ImuSource

from vical_daemon.acquire.camera import open_camera
from vical_daemon.acquire.imu import open_imu
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    encode_diagnostics,
    encode_image,
    encode_imu,
    encode_points,
)
from vical_daemon.config.model import CameraConfig, ImuConfig
from vical_daemon.logs.mcap import LogWriter

T0_NS = 1_700_000_000_000_000_000
IMU_STEP_NS, FRAME_STEP_NS = 5_000_000, 40_000_000
FIRST_FRAME_NS = 3_000_000  # after the first inertial sample
IMU_COUNT, FRAME_COUNT = 40, 5


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """0.2 s of an IMU at 200 Hz and a camera at 25 Hz, of long ago."""
    path = tmp_path / "run.mcap"
    with LogWriter(path) as writer:
        for k in range(IMU_COUNT):
            t_ns = T0_NS + k * IMU_STEP_NS
            payload = encode_imu(t_ns, "imu0", (0.1 * k, 0.0, 0.0), (0.0, 0.0, 9.8))
            writer.write("vical/rig0/imu/imu0", payload, t_ns)
        for k in range(FRAME_COUNT):
            t_ns = T0_NS + FIRST_FRAME_NS + k * FRAME_STEP_NS
            payload = encode_image(t_ns, "cam0", np.full((48, 64), k, np.uint8), "mono8")
            writer.write("vical/rig0/camera/cam0/image", payload, t_ns)
    return path


def _samples(imu: ImuSource, count: int) -> list:
    samples: list = []
    while len(samples) < count:
        samples += imu.read(60.0)
    return samples


def test_a_recording_in_other_units_is_named_when_it_is_opened(tmp_path: Path, caplog) -> None:
    path = tmp_path / "g.mcap"
    with LogWriter(path) as writer:
        for k in range(IMU_COUNT):
            t_ns = T0_NS + k * IMU_STEP_NS
            small = 1e-4 * k
            payload = encode_imu(t_ns, "imu0", (small, small, small), (small, small, 1.0 + small))
            writer.write("vical/rig0/imu/imu0", payload, t_ns)
    with open_imu(ImuConfig(port=f"log:{path}")):
        pass
    assert "not fit for calibration: imu0: the accelerometer reads 1 in the middle" in caplog.text
    assert "it looks like g" in caplog.text


def test_imu_and_camera_share_the_recorded_time_base(log: Path) -> None:
    before_ns = time.monotonic_ns()
    with (
        open_imu(ImuConfig(port=f"log:{log}")) as imu,
        open_camera(CameraConfig(uri=f"log:{log}")) as camera,
    ):
        assert isinstance(imu, ImuSource) and isinstance(camera, FrameSource)
        samples = _samples(imu, 10)
        frame = camera.read(60.0)
        assert imu.info.serial_number == "log-run-imu0" and camera.info.serial_number == "log-run-cam0"
    assert frame is not None and samples[0].t_host_ns >= before_ns
    stamps = [s.t_host_ns for s in samples]
    assert [b - a for a, b in itertools.pairwise(stamps)] == [IMU_STEP_NS] * (len(stamps) - 1)
    assert samples[3].gyro_rps == (pytest.approx(samples[0].gyro_rps[0] + 0.3), 0.0, 0.0)
    # Whichever frame the camera joined at, it keeps its recorded distance from the samples.
    number = int(frame.image[0, 0])
    first = round(samples[0].gyro_rps[0] / 0.1)
    begin_ns = stamps[0] - first * IMU_STEP_NS
    assert frame.t_exposure_mid_ns - begin_ns == FIRST_FRAME_NS + number * FRAME_STEP_NS
    assert all(s.t_arrival_ns >= s.t_host_ns for s in samples)


def test_stamps_are_known_as_when_they_were_recorded(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    said = DiagnosticStatus(Level.OK, "imu/imu0", values={"stamp_sigma_us": "150.0"})
    with LogWriter(path) as writer:
        for k in range(8):
            t_ns = T0_NS + k * IMU_STEP_NS
            payload = encode_imu(t_ns, "imu0", (0.1 * k, 0.0, 0.0), (0.0, 0.0, 9.8))
            writer.write("vical/rig0/imu/imu0", payload, t_ns)
            if k == 3:
                status = encode_diagnostics(t_ns + 1, "imu", [said])
                writer.write("vical/rig0/status/imu", status, t_ns + 1)
    with open_imu(ImuConfig(port=f"log:{path}")) as imu:
        samples = _samples(imu, 8)
    assert [s.t_sigma_ns for s in samples] == [0] * 4 + [150_000] * 4


def test_it_is_played_once_and_its_end_is_told(log: Path) -> None:
    """The same data once more would count as new ones: sigmas would shrink with each turn of a loop."""
    with open_imu(ImuConfig(port=f"log:{log}")) as imu:
        samples = _samples(imu, IMU_COUNT)
        with pytest.raises(DataEndedError, match=r"run\.mcap has ended after 0\.2 s; start again"):
            imu.read(60.0)
    assert len(samples) == IMU_COUNT


def test_nothing_comes_before_its_time(tmp_path: Path) -> None:
    path = tmp_path / "slow.mcap"
    with LogWriter(path) as writer:
        for k in range(2):
            t_ns = T0_NS + k * 3600 * 10**9
            payload = encode_imu(t_ns, "imu0", (0.1 * k, 0.0, 0.0), (0.0, 0.0, 9.8))
            writer.write("vical/rig0/imu/imu0", payload, t_ns)
    with open_imu(ImuConfig(port=f"log:{path}")) as imu:
        _samples(imu, 1)
        assert imu.read(0.01) == []


def test_what_is_not_there_is_one_line(log: Path, tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFoundError, match=r"nowhere\.mcap does not exist"):
        open_imu(ImuConfig(port=f"log:{tmp_path}/nowhere.mcap"))
    with pytest.raises(DeviceNotFoundError, match=r"no camera 'cam7' in it \(there: cam0\)"):
        open_camera(CameraConfig(uri=f"log:{log}#cam7"))


def test_several_devices_must_be_named_and_points_are_no_images(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with LogWriter(path) as writer:
        for name, k in itertools.product(("imu0", "imu1"), range(3)):
            t_ns = T0_NS + k * IMU_STEP_NS
            writer.write(f"vical/rig0/imu/{name}", encode_imu(t_ns, name, (0.0,) * 3, (0.0, 0.0, 9.8)), t_ns)
        points = encode_points(T0_NS, "cam0", np.arange(4), np.ones((4, 2)), None, (64, 48))
        writer.write("vical/rig0/camera/cam0/points", points, T0_NS)
    with pytest.raises(DeviceRefusedError, match=r"two\.mcap#NAME with one of imu0, imu1"):
        open_imu(ImuConfig(port=f"log:{path}"))
    with open_imu(ImuConfig(port=f"log:{path}#imu1")) as imu:
        assert imu.info.serial_number == "log-two-imu1"
    with pytest.raises(DeviceNotFoundError, match="of points alone, `vical replay`"):
        open_camera(CameraConfig(uri=f"log:{path}"))
