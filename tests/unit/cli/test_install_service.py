"""Units: installed twice the same, removed without a trace, accepted by systemd and locked down."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from vical_daemon.cli import install_service, main
from vical_daemon.cli.process_sets import PROCESSES

SERVICES = tuple(f"vical-{name}.service" for name in PROCESSES)
MOST_EXPOSED = 2.0
needs_analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed (Debian: systemd)"
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    assert main(["install-service", "--root", str(tmp_path), "--program", sys.executable]) == 0
    return tmp_path


def _files(root: Path) -> dict[str, str]:
    return {str(p.relative_to(root)): p.read_text() for p in sorted(root.rglob("*")) if p.is_file()}


def test_a_root_that_is_not_there_is_not_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["install-service", "--root", str(tmp_path / "typo")]) == 2
    assert "no such folder" in capsys.readouterr().err
    assert not (tmp_path / "typo").exists()


def test_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "install-service",
        "--dry-run",
        "--json",
        "--root",
        str(tmp_path),
        "--program",
        sys.executable,
    ]
    assert main(arguments) == 0
    steps = json.loads(capsys.readouterr().out)["steps"]
    assert len(steps) >= 9 and {s["action"] for s in steps} == {"write"}
    assert not list(tmp_path.iterdir())


def test_twice_is_once(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = _files(root)
    capsys.readouterr()
    assert main(["install-service", "--json", "--root", str(root), "--program", sys.executable]) == 0
    assert {s["action"] for s in json.loads(capsys.readouterr().out)["steps"]} == {"keep"}
    assert _files(root) == before
    assert "@" not in "".join(re.findall(r"@[A-Z_]+@", "".join(before.values())))


def test_an_edited_config_is_kept_and_removal_leaves_only_it(root: Path) -> None:
    config = root / "etc/vical/vical.yaml"
    config.write_text("rig: mine\n")
    assert main(["install-service", "--root", str(root), "--program", sys.executable]) == 0
    assert config.read_text() == "rig: mine\n"
    assert main(["install-service", "--remove", "--root", str(root)]) == 0
    assert list(_files(root)) == ["etc/vical/vical.yaml"]
    assert not (root / "etc/systemd/system/vical-.service.d").exists()
    assert main(["install-service", "--remove", "--root", str(root)]) == 0


def test_every_process_has_a_unit_that_runs_it(root: Path) -> None:
    for name in PROCESSES:
        text = (root / f"etc/systemd/system/vical-{name}.service").read_text()
        assert f"ExecStart={sys.executable} run {name} -c /etc/vical/vical.yaml" in text


def test_removal_takes_the_links_of_udev_and_leaves_what_others_added(root: Path) -> None:
    links, drop_in = root / "dev/vical", root / "etc/systemd/system/vical-.service.d"
    links.mkdir(parents=True)
    (links / "imu-6223.00001").symlink_to("../ttyACM0")
    (drop_in / "mine.conf").write_text("[Service]\nNice=1\n")
    assert main(["install-service", "--remove", "--root", str(root)]) == 0
    assert not links.exists()
    assert [path.name for path in drop_in.iterdir()] == ["mine.conf"]


def test_devices_that_are_plugged_in_already_get_the_rules() -> None:
    rules = (install_service.templates() / "70-vical.rules").read_text()
    subsystems = set(re.findall(r'SUBSYSTEM=="([^"]+)"', rules))
    assert subsystems >= {"tty", "usb-serial", "video4linux", "firewire"}
    for steps in (
        install_service.installation(Path("/"), Path("/usr/bin/vical")),
        install_service.removal(Path("/")),
    ):
        (trigger,) = [step.command for step in steps if step.command[:2] == ("udevadm", "trigger")]
        assert {word.split("=")[1] for word in trigger[2:]} == subsystems
        commands = [step.command[:2] for step in steps if step.command]
        assert commands.index(("udevadm", "control")) < commands.index(("udevadm", "trigger"))


def _imu(device: str, serial: str, vendor: int = 0x199B) -> SimpleNamespace:
    return SimpleNamespace(device=device, vid=vendor, serial_number=serial)


@pytest.mark.parametrize(
    ("ports", "name"),
    [
        ([], "imu-SERIAL"),
        ([_imu("/dev/ttyACM0", "6223.00001"), _imu("/dev/ttyUSB0", "A1", 0x0403)], "imu-6223.00001"),
        ([_imu("/dev/ttyACM0", "a b%c")], "imu-a_b_c"),  # as udev writes it
        ([_imu("/dev/ttyACM0", "1"), _imu("/dev/ttyACM1", "2")], "imu-SERIAL"),
    ],
)
def test_the_first_config_names_the_imu_as_udev_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ports: list[SimpleNamespace], name: str
) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    assert main(["install-service", "--root", str(tmp_path), "--program", sys.executable]) == 0
    text = (tmp_path / "etc/vical/vical.yaml").read_text()
    assert f"port: /dev/vical/{name} " in text
    rules = (tmp_path / "etc/udev/rules.d/70-vical.rules").read_text()
    assert 'SYMLINK+="vical/imu-$attr{serial}"' in rules


def test_dry_run_shows_what_the_files_would_hold(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["install-service", "--dry-run", "--root", str(tmp_path), "--program", sys.executable]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert f"    ExecStart={sys.executable} run acquire -c /etc/vical/vical.yaml\n" in shown
    assert main([*words, "--json"]) == 0
    steps = json.loads(capsys.readouterr().out)["steps"]
    (rules,) = [step for step in steps if step["what"].endswith(".rules")]
    assert rules["text"] == (install_service.templates() / "70-vical.rules").read_text()


ODD_NAMES = ("my robot", "100%n", "%i me", "$HOME", "ärger", "a;b", "-v @x")
REFUSED_NAMES = ('a"b', "it's", "back\\slash", "a\nUser=root")


@pytest.mark.parametrize("name", ODD_NAMES)
def test_odd_program_names_are_quoted_as_systemd_wants(name: str, tmp_path: Path) -> None:
    program = tmp_path / name / "vical"
    program.parent.mkdir()
    program.symlink_to(sys.executable)
    root = tmp_path / "root"
    root.mkdir()
    assert main(["install-service", "--root", str(root), "--program", str(program)]) == 0
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed (Debian: systemd)")
    units = root / "etc/systemd/system"
    command = ["systemd-analyze", "verify", "--man=no", str(units / "vical-acquire.service")]
    environment = os.environ | {"SYSTEMD_UNIT_PATH": f"{units}:"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    program.unlink()  # verify says whether the very file that is named is there
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert f"Command {program} is not executable" in done.stderr


@pytest.mark.parametrize("name", REFUSED_NAMES)
def test_names_that_systemd_takes_in_no_spelling_are_refused_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = tmp_path / name / "vical"
    program.parent.mkdir()
    program.symlink_to(sys.executable)
    assert main(["install-service", "--root", str(tmp_path), "--program", str(program)]) == 2
    err = capsys.readouterr().err
    assert "--program" in err and len(err.splitlines()) == 1
    assert not (tmp_path / "etc").exists()


@needs_analyze
@pytest.mark.parametrize("spelling", ['a"b', r"a\"b", r"a\x22b", r"it\'s", r"a\\b"])
def test_systemd_really_takes_these_in_no_spelling(spelling: str, tmp_path: Path) -> None:
    unit = tmp_path / "x.service"
    for word in (f"/opt/{spelling}/vical", f'"/opt/{spelling}/vical"'):
        unit.write_text(f"[Service]\nExecStart={word} run\n")
        done = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True
        )
        assert done.returncode and "is not executable" not in done.stderr


def test_a_program_in_a_home_folder_stays_readable(tmp_path: Path) -> None:
    common, python = "vical-.service.d/10-common.conf", Path("/usr/bin/python3")
    assert "ProtectHome=read-only" in install_service.render(common, Path("/home/robot/bin/vical"), python)
    assert "ProtectHome=yes" in install_service.render(common, Path("/opt/vical/bin/vical"), python)
    at_home = Path("/root/.pyenv/bin/python3")
    assert "ProtectHome=read-only" in install_service.render(common, Path("/opt/vical/bin/vical"), at_home)


def test_a_folder_that_the_service_user_may_not_enter_is_named(tmp_path: Path) -> None:
    (tmp_path / "private" / "bin").mkdir(parents=True)
    assert install_service.closed_folder(Path("/usr/bin/env")) is None
    (tmp_path / "private").chmod(0o700)
    closed = install_service.closed_folder(tmp_path / "private" / "bin" / "vical")
    assert closed is not None and closed in (tmp_path / "private", *tmp_path.parents)


def test_only_acquire_is_real_time(root: Path) -> None:
    units = root / "etc/systemd/system"
    real_time = [s for s in SERVICES if "CPUSchedulingPolicy=fifo" in (units / s).read_text()]
    assert real_time == ["vical-acquire.service"]


def test_no_right_to_write_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if os.getuid() == 0:
        pytest.skip("root may write everywhere")
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc").chmod(0o500)
    assert main(["install-service", "--root", str(tmp_path), "--program", sys.executable]) == 1
    assert "sudo" in capsys.readouterr().err


@needs_analyze
def test_systemd_has_nothing_to_complain_about(root: Path) -> None:
    units = root / "etc/systemd/system"
    names = [str(units / name) for name in (*SERVICES, "vical.target")]
    environment = os.environ | {"SYSTEMD_UNIT_PATH": f"{units}:"}
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *names], capture_output=True, text=True, env=environment
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@needs_analyze
def test_the_sandbox_is_tight(root: Path) -> None:
    units = root / "etc/systemd/system"
    environment = os.environ | {"SYSTEMD_UNIT_PATH": f"{units}:"}
    for name in SERVICES:
        done = subprocess.run(
            ["systemd-analyze", "security", "--offline=yes", "--no-pager", str(units / name)],
            capture_output=True,
            text=True,
            env=environment,
        )
        level = re.search(rf"level for {name}: ([0-9.]+)", done.stdout)
        assert level is not None, done.stdout + done.stderr
        assert float(level.group(1)) <= MOST_EXPOSED, name
