"""`vical check` against an emulated IMU and with a wrong config."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from vical_mocks.gx3_emulator import Gx3Emulator

from vical_daemon.cli import main
from vical_daemon.vision.target import Checkerboard

pytestmark = pytest.mark.system


@pytest.fixture
def rig(tmp_path: Path):
    """Write a config with an IMU on the given port and no camera."""

    def write(port: str, more: str = "") -> str:
        (tmp_path / "target.yaml").write_text(Checkerboard(8, 5, 0.05, 0.05).to_yaml())
        (tmp_path / "vical.yaml").write_text(
            f"imus: {{imu0: {{port: {port}, protocol: single-byte, rate_hz: 100}}}}\ntarget: target.yaml\n"
            f"record: {{directory: {tmp_path / 'log'}}}\n{more}"
        )
        return str(tmp_path / "vical.yaml")

    return write


def test_all_is_well_with_an_emulated_imu(rig, capsys) -> None:
    emulator = Gx3Emulator(link="direct", serial_number="6223-00042")
    emulator.plug()
    with emulator:
        assert main(["check", "-c", rig(emulator.port_name)]) == 0
    out = capsys.readouterr().out
    assert "6223-00042" in out and "100.0 Hz" in out and out.rstrip().endswith("all is well")
    assert "checkerboard, 40 points over 0.350 x 0.200 m" in out


@pytest.mark.parametrize(
    ("quota_bytes", "free_bytes", "says"),
    [
        (20_000_000_000, 30_000_000_000, ""),
        (20_000_000_000, 10_500_000_000, "recordings end when they fill 10.0 GB"),
        (0, 30_500_000_000, "recordings end when they fill 30.0 GB"),
    ],
)
def test_a_disk_that_is_full_before_anything_is_deleted(
    rig, capsys, monkeypatch, quota_bytes, free_bytes, says
) -> None:
    """A robot of weeks: nothing is recorded any more, and nothing had said that it would be so."""
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free_bytes))
    config = Path(rig("/dev/null"))
    config.write_text(config.read_text().replace("/log}", f"/log, quota_bytes: {quota_bytes}}}"))
    assert main(["check", "-c", str(config), "--no-devices"]) == 0
    out = capsys.readouterr().out
    assert says in out and ("recordings end" in out) == bool(says)


def test_json_lists_every_problem(rig, capsys) -> None:
    config = rig("/dev/nothing", "cameras: {cam0: {uri: 'v4l2:/dev/video77'}}\n")
    (Path(config).parent / "target.yaml").write_text("target_type: aprilgrid\ntagCols: 6\n")
    assert main(["check", "-c", config, "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] is False and len(result["problems"]) == 3
    assert [c["what"] for c in result["checked"] if c["problem"]] == ["target", "imus.imu0", "cameras.cam0"]


def test_what_cannot_be_written_hosted_or_verified_is_found(rig, tmp_path, capsys) -> None:
    (tmp_path / "file").write_text("")
    more = (
        f"store: {{directory: {tmp_path}/file}}\nmode: verify\nverify: {{against: nothing.json}}\n"
        f"cameras: {{cam0: {{uri: 'v4l2:/dev/video77'}}}}\n"
        f"bus: {{socket: '{tmp_path}/{'x' * 120}', connect: [robot]}}\n"
    )
    assert main(["check", "-c", rig("/dev/nothing", more), "--no-devices", "--json"]) == 1
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert len(problems) == 4
    for part in ("file is no folder", "nothing.json", "107 bytes at most", "'robot' is no endpoint"):
        assert any(part in problem for problem in problems), part


def test_a_device_that_two_sensors_name_is_found(rig, capsys) -> None:
    """Each is opened alone here, so both looked well."""
    more = "cameras: {left: {uri: 'v4l2:/dev/video0'}, right: {uri: 'v4l2:/dev/video0'}}\n"
    assert main(["check", "-c", rig("/dev/nothing", more), "--no-devices", "--json"]) == 1
    (problem,) = json.loads(capsys.readouterr().out)["problems"]
    assert problem == "cameras.right: v4l2:/dev/video0 is that of left, too; each needs a device of its own"
    of_log = more.replace("v4l2:/dev/video0", "log:run.mcap")
    assert main(["check", "-c", rig("log:run.mcap", of_log), "--no-devices"]) == 0


def test_a_wrong_config_exits_2_with_all_of_it(rig, capsys) -> None:
    config = rig("/dev/x", "rat: 5\nweb: {prt: 1}\n")
    assert main(["check", "-c", config, "--no-devices"]) == 2
    out, err = capsys.readouterr()
    assert out.count("FAIL") == 2 and "and 1 more" in err


def test_no_devices_opens_nothing(rig, capsys) -> None:
    assert main(["check", "-c", rig("/dev/nothing"), "--no-devices"]) == 0
    assert "imus.imu0" not in capsys.readouterr().out


@pytest.mark.parametrize("text", ["", "rig: rover\n"])
def test_a_config_without_devices_is_not_well(tmp_path: Path, capsys, text: str) -> None:
    (tmp_path / "vical.yaml").write_text(text)
    assert main(["check", "-c", str(tmp_path / "vical.yaml")]) == 2
    out, err = capsys.readouterr()
    assert "all is well" not in out
    assert "no IMUs and no cameras" in err and err.count("\n") == 1
