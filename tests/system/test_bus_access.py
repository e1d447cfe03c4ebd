"""Who reaches the bus of this computer: the service's group, nobody else, and every refusal is one line."""

from __future__ import annotations

import grp
import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from vical_daemon import client
from vical_daemon.bus import socket_paths, topics
from vical_daemon.bus.local_bus import open_local_bus
from vical_daemon.bus.messages import encode_string
from vical_daemon.bus.socket_paths import Reach, local_sockets, reach, why_closed
from vical_daemon.bus.zenoh_bus import BusError, open_bus
from vical_daemon.bus.zenoh_commands import CommandJournal
from vical_daemon.cli.bus_access import open_client, open_for_roles
from vical_daemon.config.model import BusConfig, Config

pytestmark = pytest.mark.system
COMMAND = topics.COMMAND.key("rover", "record")
NOBODY = 65534


def until(condition, timeout_s: float = 30.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return bool(condition())


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def vical_elsewhere(
    service: Path, words: list[str], port: int, groups: tuple[int, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """Run `vical` as nobody, as if the service were at another place.

    The program is loaded first: its files may lie where nobody may read them.
    """
    code = (
        "import importlib, os, pathlib, pkgutil, sys\n"
        "from vical_daemon.config import paths\n"
        f"paths.LOOPBACK_PORT = {port}\n"
        "from vical_daemon.bus import socket_paths\n"
        f"socket_paths.SERVICE_SOCKET = pathlib.Path({str(service)!r})\n"
        "from vical_daemon import cli\n"
        "for module in pkgutil.iter_modules(cli.__path__, cli.__name__ + '.'):\n"
        "    importlib.import_module(module.name)\n"
        "import rich.live, vical_daemon.bus.messages, vical_daemon.web.role\n"
        "'localhost'.encode('idna')\n"
        f"os.setgroups({list(groups)!r}); os.setgid({NOBODY}); os.setuid({NOBODY})\n"
        f"sys.exit(cli.main({words!r}))\n"
    )
    environment = {key: os.environ[key] for key in ("PATH", "PYTHONPATH", "LANG") if key in os.environ}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd="/", capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip


@pytest.fixture
def service():
    """A running router in a folder like /run/vical, below folders that everybody may enter."""
    with tempfile.TemporaryDirectory() as above:
        Path(above).chmod(0o755)
        if any(not folder.stat().st_mode & 0o001 for folder in Path(above).parents):
            pytest.skip(f"not everybody may enter {above}: set TMPDIR")
        folder = Path(above) / "vical"
        folder.mkdir()
        folder.chmod(0o750)
        path = folder / "zenoh.sock"
        router = open_bus(mode="router", socket=path)
        yield path
        folder.chmod(0o750)
        router.close()


@pytest.mark.root
@pytest.mark.parametrize(
    "words", [["watch", "--once"], ["web", "--port", "0"], ["watch", "--json", "--once"]]
)
def test_a_user_outside_the_group_is_told_which_one_to_join(service, words):
    group = next(entry for entry in grp.getgrall() if entry.gr_gid not in (0, NOBODY))
    os.chown(service.parent, 0, group.gr_gid)
    result = vical_elsewhere(service, words, free_port())
    assert result.returncode == 1
    assert len(result.stderr.splitlines()) == 1
    assert f"belongs to group {group.gr_name}; try: sudo usermod -aG {group.gr_name} $USER" in result.stderr
    assert result.stdout == ""


@pytest.mark.root
def test_a_member_of_the_group_watches_and_a_stranger_cannot_connect(service):
    group = next(entry for entry in grp.getgrall() if entry.gr_gid not in (0, NOBODY))
    os.chown(service.parent, 0, group.gr_gid)
    os.chown(service, 0, group.gr_gid)
    member = vical_elsewhere(service, ["watch", "--once"], free_port(), (group.gr_gid,))
    assert "nothing is calibrating here" in member.stderr  # it is in, and nobody calibrates
    service.parent.chmod(0o755)  # the socket itself is closed as well
    stranger = vical_elsewhere(service, ["watch", "--once"], free_port())
    assert stranger.returncode == 1
    assert "belongs to group" in stranger.stderr
    assert "Traceback" not in stranger.stderr


@pytest.mark.root
def test_readers_loopback_lets_everybody_watch_and_nobody_command(service, tmp_path):
    port = free_port()
    config = Config(
        rig="rover", bus=BusConfig(socket=str(tmp_path / "z.sock"), readers="loopback", tcp_port=port)
    )
    bus = open_for_roles(config, ("imu", "camera"), threading.Event())
    words: list[bytes] = []
    bus.subscribe("vical/*/command/*", lambda sample: words.append(sample.payload))
    result = vical_elsewhere(service, ["watch", "--once"], port)
    assert "nothing is calibrating here" in result.stderr
    with client.connect(f"tcp/127.0.0.1:{port}") as stranger:
        for _ in range(20):
            stranger._bus.publish(COMMAND, encode_string("stop"))
            time.sleep(0.01)
    local = open_bus(mode="client", socket=tmp_path / "z.sock")
    assert until(lambda: local.publish(COMMAND, encode_string("end")) or words)
    assert set(words) == {encode_string("end")}
    local.close()
    bus.close()


def own_runtime_folder(monkeypatch, session):
    """The user's folder below that of the login session; nothing else names one."""
    for variable in ("VICAL_RUNTIME_DIR", "RUNTIME_DIRECTORY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(session))
    own = session / "vical"
    if session.exists():
        own.mkdir()
    return own


def test_a_folder_that_is_closed_to_us_is_one_line(service, monkeypatch):
    if os.geteuid() == 0:
        pytest.skip("nothing is closed to root")
    monkeypatch.setattr(socket_paths, "SERVICE_SOCKET", service)
    own_runtime_folder(monkeypatch, service.parent.parent / "nothing")
    service.parent.chmod(0)
    assert reach(service) is Reach.CLOSED
    with pytest.raises(BusError, match="who alone may use it") as error:
        open_client(None, None)
    assert "\n" not in str(error.value)


def test_the_line_names_user_or_group(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    folder.mkdir()
    path = folder / "zenoh.sock"
    path.touch()
    entry = next(entry for entry in grp.getgrall() if entry.gr_gid != 0)
    real = os.access
    monkeypatch.setattr(os, "access", lambda p, mode: Path(p) not in (folder, path) and real(p, mode))

    class Found:
        st_uid, st_gid, st_mode = 0, entry.gr_gid, 0o40750

    stat = Path.stat
    monkeypatch.setattr(Path, "stat", lambda self, **k: Found if self == folder else stat(self, **k))
    name = entry.gr_name
    assert f"belongs to group {name}; try: sudo usermod -aG {name} $USER" in why_closed(path)
    Found.st_mode = 0o40700
    assert "belongs to user root, who alone may use it" in why_closed(path)
    Found.st_mode, Found.st_gid = 0o40750, 3_999_999_999  # a number without a name
    assert "belongs to group 3999999999" in why_closed(path)


def test_nobody_there_is_said_with_every_place(tmp_path, monkeypatch):
    monkeypatch.setattr(socket_paths, "SERVICE_SOCKET", tmp_path / "service.sock")
    own = own_runtime_folder(monkeypatch, tmp_path)
    with pytest.raises(BusError, match=r"nothing answers; start `vical run") as error:
        open_local_bus(tcp_port=free_port())
    assert str(tmp_path / "service.sock") in str(error.value)
    assert str(own / "zenoh.sock") in str(error.value)
    assert "\n" not in str(error.value)


def test_a_runtime_folder_that_the_user_names_is_the_only_one(service, tmp_path, monkeypatch):
    # a command that is meant for another rig must not reach the service
    monkeypatch.setattr(socket_paths, "SERVICE_SOCKET", service)
    monkeypatch.setenv("VICAL_RUNTIME_DIR", str(tmp_path / "mine"))
    with pytest.raises(BusError, match="nothing answers") as error:
        open_local_bus(tcp_port=0)
    assert f"no bus at {tmp_path / 'mine' / 'zenoh.sock'}: " in str(error.value)


def test_clients_find_the_service_without_being_told(service, tmp_path, monkeypatch):
    monkeypatch.setattr(socket_paths, "SERVICE_SOCKET", service)
    own = own_runtime_folder(monkeypatch, tmp_path)
    (own / "zenoh.sock").touch()  # left behind by a router of this user that was killed
    with client.connect() as robot:
        assert robot.latest() == []
    config = tmp_path / "vical.yaml"
    config.write_text("rig: rover\n")
    open_client(str(config), None).close()  # that config's own bus is not up, the service's is


def test_a_folder_that_somebody_else_made_in_our_place_is_not_used(tmp_path, monkeypatch):
    own = own_runtime_folder(monkeypatch, tmp_path)
    assert local_sockets()[0] == own / "zenoh.sock"
    stat = Path.stat

    class Foreign:
        st_uid = 12345

    monkeypatch.setattr(Path, "stat", lambda self, **k: Foreign if self == own else stat(self, **k))
    assert local_sockets() == [socket_paths.SERVICE_SOCKET]


def test_the_socket_is_closed_to_others_whatever_the_mask(tmp_path):
    for mask in (0o000, 0o022, 0o027, 0o077):
        before = os.umask(mask)
        try:
            router = open_bus(mode="router", socket=tmp_path / "z.sock")
            assert os.umask(mask) == mask  # as it was
            mode = (tmp_path / "z.sock").stat().st_mode
            router.close()
        finally:
            os.umask(before)
        assert mode & 0o007 == 0
        assert mode & 0o060 == 0o060


def test_every_command_is_journalled_with_its_origin(tmp_path, caplog):
    port = free_port()
    users = tmp_path / "users.txt"
    users.write_text("robot:secret\nboss:secret\n")
    config = Config(
        rig="rover",
        bus=BusConfig(
            socket=str(tmp_path / "z.sock"), tcp_port=port, password_file=str(users), user="robot",
            password="secret", commanders=("boss",),
        ),
    )  # fmt: skip

    def journalled() -> list[str]:
        return [m for m in caplog.messages if m.startswith("command to")]

    with caplog.at_level(logging.INFO):
        bus = open_for_roles(config, ("imu", "camera"), threading.Event())
        group = open_bus(mode="client", socket=tmp_path / "z.sock", user="robot", password="secret")
        boss = open_bus(mode="client", tcp_port=port, user="boss", password="secret")
        for sender, way in ((group, "unix socket"), (boss, "tcp 127.0.0.1:")):
            caplog.clear()
            assert until(lambda s=sender: s.publish(COMMAND, encode_string("sto\np")) or journalled())
            line = f"command to rover/record: 'sto\\np', from zenoh id {sender.session.info.zid()}, {way}"
            assert until(lambda text=line: any(entry.startswith(text) for entry in journalled())), line
        caplog.clear()
        group.publish(topics.COMMAND.key("rover", "estimate"), b"\xff")
        assert until(lambda: any("1 bytes that are not a command" in line for line in journalled()))
        bus.publish(COMMAND, encode_string("start"))
        assert until(lambda: any("this process" in line for line in journalled()))
        for _ in range(500):
            group.publish(COMMAND, encode_string("again"))
        time.sleep(0.5)
        assert len(journalled()) < 100
    for each in (group, boss, bus):
        each.close()


def test_a_command_of_a_sender_that_has_left_is_not_taken_for_a_foreign_one(caplog):
    info = SimpleNamespace(zid=lambda: "aa", links=list)
    session = SimpleNamespace(info=info, declare_subscriber=lambda _key, _take: None)
    stamp = SimpleNamespace(get_id=lambda: "bb")
    received = SimpleNamespace(
        key_expr=COMMAND, timestamp=stamp, payload=SimpleNamespace(to_bytes=lambda: encode_string("stop"))
    )
    with caplog.at_level(logging.INFO):
        CommandJournal(session)._take(received)
    text = "'stop', from zenoh id bb, its link is closed by now or leads through another router"
    assert caplog.messages[-1].endswith(text)


def test_a_password_that_would_shut_out_our_own_processes_is_refused(tmp_path):
    bus = BusConfig(socket=str(tmp_path / "z.sock"), user="robot", password="secret")
    with pytest.raises(BusError, match=r"set bus\.password_file"):
        open_for_roles(Config(rig="rover", bus=bus), ("imu", "camera"), threading.Event())


def test_roles_say_under_which_id_they_are_on_the_bus(tmp_path, caplog):
    config = Config(rig="rover", bus=BusConfig(socket=str(tmp_path / "z.sock")))
    with caplog.at_level(logging.INFO):
        bus = open_for_roles(config, ("imu", "camera"), threading.Event())
        role = open_for_roles(config, ("record",), threading.Event())
    for each in (bus, role):
        assert f"on the bus as zenoh id {each.session.info.zid()}" in caplog.messages
    role.close()
    bus.close()


def test_vical_watch_reads_a_bus_over_its_socket(tmp_path):
    path = tmp_path / "z.sock"
    router = open_bus(mode="router", socket=path)
    (tmp_path / "vical.yaml").write_text(f"rig: rover\nbus: {{socket: {path}}}\n")
    words = [
        sys.executable,
        "-m",
        "vical_daemon",
        "watch",
        "-c",
        str(tmp_path / "vical.yaml"),
        "--once",
        "--json",
    ]
    result = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert (result.returncode, result.stdout) == (1, "")
    assert "nothing is calibrating here" in result.stderr
    router.close()
    result = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 1
    assert f"no bus at {path}: nothing answers" in result.stderr
    assert len(result.stderr.splitlines()) == 1
