"""`vical init`: finds what is plugged in, writes a config that `vical check` accepts, overwrites nothing."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path

import pytest
from vical_drivers.camera import opening
from vical_drivers.camera.v4l2.discovery import list_v4l2_cameras
from vical_drivers.samples import DeviceInfo
from vical_mocks.gx3_emulator import Gx3Emulator
from vical_mocks.v4l2_camera import CID_EXPOSURE_AUTO, FakeCamera
from vical_mocks.v4l2_kernel import FakeKernel

from vical_daemon.cli import devices, init_config, main
from vical_daemon.config.model import load, loads
from vical_daemon.vision.target import AprilGrid, Checkerboard, load_target


@pytest.fixture
def computer(tmp_path, monkeypatch):
    """A computer with the cameras that a test plugs in, and no serial port of its own."""
    kernel = FakeKernel(tmp_path / "kernel")
    monkeypatch.setattr(devices, "serial_ports", list)
    monkeypatch.setattr(devices, "list_cameras", lambda: (list_v4l2_cameras(kernel), ""))
    monkeypatch.setattr(opening, "open_camera", functools.partial(opening.open_camera, kernel=kernel))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.chdir(tmp_path)
    return kernel


def test_nothing_plugged_in_is_said_and_the_emulated_rig_offered(computer, capsys) -> None:
    assert main(["init"]) == 1
    err = capsys.readouterr().err
    assert "no IMU and no camera" in err and "vical init --emulated" in err
    assert not Path("vical.yaml").exists()


@pytest.mark.system
def test_what_is_plugged_in_is_written_and_checked(computer, capsys) -> None:
    computer.plug(FakeCamera(formats={"GREY": {(752, 480): (30.0,)}}))
    with Gx3Emulator(serial_number="6223-00042") as emulator:
        code = main(["init", "--port", emulator.port_name, "--target", "checkerboard", "--rig", "rover"])
    out, err = capsys.readouterr()
    assert code == 0, out + err
    config = load("vical.yaml")
    assert config.rig == "rover" and config.imus["imu0"].port == emulator.port_name
    assert config.cameras["cam0"].size == (752, 480) and config.cameras["cam0"].rate_hz == 30.0
    assert isinstance(load_target("target.yaml"), Checkerboard) and Path("board.pdf").stat().st_size > 1000
    assert "serial 6223-00042" in Path("vical.yaml").read_text()
    assert re.search(r"^ok +imus\.imu0 .* 500\.\d Hz", out, re.M) and "next: vical run -c vical.yaml" in out


def test_nothing_is_overwritten_without_force(computer, capsys) -> None:
    computer.plug(FakeCamera())
    Path("vical.yaml").write_text("mine\n")
    assert main(["init", "--no-check"]) == 1
    assert "vical.yaml exists" in capsys.readouterr().err and Path("vical.yaml").read_text() == "mine\n"
    Path("target.yaml").write_text("measured\n")
    assert main(["init", "--no-check", "-o", "other.yaml", "--target", "aprilgrid"]) == 1
    assert "target.yaml exists" in capsys.readouterr().err and Path("target.yaml").read_text() == "measured\n"
    assert not Path("other.yaml").exists()
    assert main(["init", "--no-check", "--target", "aprilgrid", "--force"]) == 0
    assert isinstance(load_target("target.yaml"), AprilGrid) and load("vical.yaml").target == "target.yaml"


def test_a_board_beside_the_config_is_used_and_without_one_it_is_target_free(computer, capsys) -> None:
    computer.plug(FakeCamera())
    assert main(["init", "--no-check"]) == 0
    assert load("vical.yaml").calibration.mode == "target_free"
    assert "vical init --target aprilgrid" in capsys.readouterr().out
    Path("board.yaml").write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
    assert main(["init", "--no-check", "--force"]) == 0
    config = load("vical.yaml")
    assert config.target == "board.yaml" and config.calibration.mode == "target"


def test_a_camera_that_does_not_tell_its_exposure_gets_a_guess_that_says_so(computer) -> None:
    computer.plug(FakeCamera(controls=[]))
    assert main(["init", "--no-check"]) == 0
    assert load("vical.yaml").cameras["cam0"].assume_exposure_s == 0.01


def test_json_stands_alone_on_stdout(computer, capsys) -> None:
    computer.plug(FakeCamera())
    assert main(["init", "--json", "--no-check"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["config"] == "vical.yaml" and answer["imus"] == [] and len(answer["cameras"]) == 1
    assert answer["target"] is None and answer["check"] is None


def test_an_automatic_exposure_is_fixed_because_stamps_depend_on_it(computer) -> None:
    camera = FakeCamera()
    computer.plug(camera)
    assert camera.control(CID_EXPOSURE_AUTO).value == 3
    assert main(["init", "--no-check"]) == 0
    config = load("vical.yaml").cameras["cam0"]
    assert (config.exposure_s, config.assume_exposure_s) == (0.01, None)


@pytest.mark.system
def test_the_emulated_rig_needs_nothing(computer, capsys) -> None:
    assert main(["init", "--emulated", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["emulated"] and answer["check"]["ok"] and answer["target"] == "target.yaml"
    assert load("vical.yaml").imus["imu0"].port == "emulated"


@pytest.mark.parametrize(
    "words", [["--emulated", "--port", "/dev/x"], ["-o", "nowhere/vical.yaml"], ["--rig", "a b"]]
)
def test_wrong_usage_writes_nothing(computer, words) -> None:
    computer.plug(FakeCamera())
    assert main(["init", "--no-check", *words]) == 2
    assert not Path("vical.yaml").exists()


def test_what_a_device_calls_itself_stays_a_comment() -> None:
    """A name with a line feed must not become a key."""
    evil = DeviceInfo(
        "camera", "Cam\nrig: other #", "S\u2028N", "/dev/video0", "v4l2", details={"uri": 'v4l2:/dev/"x'}
    )
    camera = init_config.FoundCamera(evil.details["uri"], evil.model, evil.serial_number)
    imu = {"port": "/dev/tty\nX", "protocol": "mip", "model": "GX\n5", "serial_number": "1", "firmware": "1"}
    config = loads(init_config.config_of("rig0", [imu, imu], [camera], "my board.yaml"))
    assert config.rig == "rig0" and config.cameras["cam0"].uri == 'v4l2:/dev/"x'
    assert config.calibration_imu == "imu0" and len(config.imus) == 2 and config.target == "my board.yaml"
    assert loads(init_config.config_of("rig0", [imu], [], None)).cameras == {}
    assert loads(init_config.config_of("rig0", [], [camera], None)).imus == {}
