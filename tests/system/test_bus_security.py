"""Who may do what on the bus: no network by default, TLS with certificates, passwords, rights."""

from __future__ import annotations

import logging
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    decode_string,
    encode_diagnostics,
    encode_string,
)
from vical_daemon.bus.zenoh_bus import BusError, open_bus
from vical_daemon.bus.zenoh_commands import CommandJournal
from vical_daemon.cli import main
from vical_daemon.cli.bus_access import open_for_roles
from vical_daemon.config.model import Config

pytestmark = pytest.mark.system
COMMAND = topics.COMMAND.key("rig0", "record")
KEY = topics.CALIBRATION.key("rig0", "cam0")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(condition, timeout_s: float = 30.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return bool(condition())


def listening() -> set[str]:
    """Addresses on which this process listens (TCP) or receives (UDP)."""
    inodes = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            target = str(link.readlink())
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = set()
    for table, state in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == state and fields[9] in inodes:
                found.add(f"{table} {fields[1].split(':')[0]}")
    return found


def test_by_default_nothing_listens_on_a_network(tmp_path, monkeypatch):
    """As `vical run` opens it, with a config that says nothing about the bus."""
    monkeypatch.setenv("VICAL_RUNTIME_DIR", str(tmp_path / "run"))
    before = listening()
    bus = open_for_roles(Config(), ("imu", "camera"), threading.Event())
    assert bus is not None
    assert listening() - before == set()
    mode = (tmp_path / "run" / "zenoh.sock").stat().st_mode
    assert mode & 0o007 == 0
    assert mode & 0o060 == 0o060  # or members of the group could not connect
    bus.close()


def test_nothing_listens_beyond_loopback(tmp_path):
    before = listening()
    router = open_bus(mode="router", socket=tmp_path / "z.sock", tcp_port=free_port())
    client = open_bus(mode="client", socket=tmp_path / "z.sock")
    client.publish(KEY, b"x")
    assert listening() - before == {"tcp 0100007F"}  # 127.0.0.1 and nothing else
    client.close()
    router.close()
    quiet = open_bus(mode="router", socket=tmp_path / "z.sock")
    assert listening() - before == set()
    quiet.close()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """An authority, a certificate signed by it, and one signed by somebody else."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make certificates with")
    folder = tmp_path_factory.mktemp("certificates")

    def run(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    for authority, leaf in (("ca", "robot"), ("other_ca", "stranger")):
        run("req", "-x509", *curve, "-keyout", f"{authority}.key", "-out", f"{authority}.pem", "-days", "2",
            "-subj", f"/CN={authority}")  # fmt: skip
        run("req", *curve, "-keyout", f"{leaf}.key", "-out", f"{leaf}.csr", "-subj", f"/CN={leaf}")
        (folder / "names.txt").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
        run("x509", "-req", "-in", f"{leaf}.csr", "-CA", f"{authority}.pem", "-CAkey", f"{authority}.key",
            "-CAcreateserial", "-out", f"{leaf}.pem", "-days", "2", "-extfile", "names.txt")  # fmt: skip
    return folder


def tls(folder: Path, leaf: str) -> dict[str, str]:
    return {
        "tls_ca": str(folder / "ca.pem"),
        "tls_certificate": str(folder / f"{leaf}.pem"),
        "tls_key": str(folder / f"{leaf}.key"),
    }


def test_tls_admits_our_certificates_only(certificates, tmp_path):
    endpoint = f"tls/localhost:{free_port()}"
    router = open_bus(
        mode="router", socket=tmp_path / "z.sock", listen=[endpoint], **tls(certificates, "robot")
    )
    router.publish(KEY, b"secret")
    friend = open_bus(mode="client", connect=[endpoint], **tls(certificates, "robot"))
    assert until(lambda: [s.payload for s in friend.latest(KEY)] == [b"secret"])
    friend.close()
    with pytest.raises(BusError, match="no bus at"):
        open_bus(mode="client", connect=[endpoint], tls_ca=str(certificates / "ca.pem"))
    try:  # TLS 1.3 refuses a certificate only after the client thinks that it is in
        stranger = open_bus(mode="client", connect=[endpoint], **tls(certificates, "stranger"))
    except BusError:
        pass
    else:
        assert stranger.latest(KEY, 0.5) == []
        stranger.close()
    router.close()


def test_what_a_certificate_names_can_be_given_rights(certificates, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    endpoint = f"tls/localhost:{free_port()}"
    router = open_bus(
        mode="router", socket=tmp_path / "z.sock", listen=[endpoint], commanders=["robot"],
        **tls(certificates, "robot"),
    )  # fmt: skip
    commands = commanded(router)
    journal = CommandJournal(router.session)
    robot = open_bus(mode="client", connect=[endpoint], **tls(certificates, "robot"))
    assert until(lambda: robot.publish(COMMAND, encode_string("start")) or commands)
    robot.publish(KEY, b"forged")
    assert router.latest(KEY) == []
    assert until(lambda: any("tls 127.0.0.1:" in m and m.endswith("user robot") for m in caplog.messages))
    journal.close()
    for bus in (robot, router):
        bus.close()


def test_vical_command_says_that_a_network_may_drop_it(tmp_path, capsys):
    port, path = free_port(), tmp_path / "z.sock"
    router = open_bus(mode="router", socket=path, tcp_port=port)
    status = encode_diagnostics(1, "record", [DiagnosticStatus(Level.OK, "record", "")])
    router.publish("vical/rig0/status/record", status)
    words = commanded(router)
    assert main(["command", "record-stop", "--connect", f"tcp/127.0.0.1:{port}"]) == 0
    said = "over tcp, rig0 obeys those whom its bus.commanders names"
    assert capsys.readouterr().err == f"vical: whether it was obeyed is not known: {said}\n"
    assert words == []
    assert main(["command", "record-stop", "--connect", f"unixsock-stream/{path}"]) == 0
    assert capsys.readouterr().err == ""
    assert until(lambda: words == ["stop"])
    router.close()


def commanded(bus) -> list[str]:
    """Collect the words that are put as commands."""
    words: list[str] = []
    bus.subscribe("vical/*/command/*", lambda sample: words.append(decode_string(sample.payload)))
    return words


@pytest.fixture
def rights(tmp_path):
    """A router with a password file, and a client for each user over TCP."""
    users = tmp_path / "users.txt"
    names = ("robot", "viewer", "boss", "feeder")
    users.write_text("".join(f"{name}:secret of {name}\n" for name in names))
    port = free_port()
    router = open_bus(
        mode="router", socket=tmp_path / "z.sock", tcp_port=port, password_file=str(users),
        user="robot", password="secret of robot", commanders=["boss"], publishers=["feeder"],
    )  # fmt: skip
    clients = {
        name: open_bus(mode="client", tcp_port=port, user=name, password=f"secret of {name}")
        for name in names[1:]
    }
    clients["group"] = open_bus(
        mode="client", socket=tmp_path / "z.sock", user="robot", password="secret of robot"
    )
    yield router, clients, port
    for bus in (*clients.values(), router):
        bus.close()


def test_wrong_passwords_are_refused(rights):
    _, _, port = rights
    for wrong in (
        {},
        {"user": "robot", "password": "wrong"},
        {"user": "nobody", "password": "secret of robot"},
    ):
        with pytest.raises(BusError, match="user and password"):
            open_bus(mode="client", tcp_port=port, **wrong)


@pytest.mark.parametrize(
    ("name", "may_command", "may_publish"),
    [("viewer", False, False), ("boss", True, False), ("feeder", True, True), ("group", True, True)],
)
def test_who_may_command_and_who_may_publish(rights, name, may_command, may_publish):
    router, clients, _ = rights
    client, group = clients[name], clients["group"]
    commands, heard = commanded(router), []
    router.subscribe("vical/*/imu/*", lambda s: heard.append(s.payload))
    router.subscribe("vical/*/calibration/*", lambda s: heard.append(s.payload))
    seen: list[bytes] = []
    client.subscribe("vical/rig0/calibration/other", lambda s: seen.append(s.payload))
    other = topics.CALIBRATION.key("rig0", "other")
    assert until(lambda: router.publish(other, b"from the rig") or seen)  # everybody may read
    assert [s.payload for s in client.latest(other)] == [b"from the rig"]
    for _ in range(20):
        client.publish(COMMAND, encode_string("from the client"))
        client.publish(topics.IMU.key("rig0", "imu0"), b"imu of the client")
        client.publish(KEY, b"calibration of the client")
        time.sleep(0.01)
    group.publish(COMMAND, encode_string("end"))
    group.publish(topics.IMU.key("rig0", "imu0"), b"end")
    assert until(lambda: "end" in commands and b"end" in heard)
    time.sleep(0.3)  # what was put before the end over another link
    assert ("from the client" in commands) is may_command
    assert (b"imu of the client" in heard) is may_publish
    assert (b"calibration of the client" in heard) is may_publish
    answers = {s.payload for s in router.latest(KEY)}  # nor can it answer in our place
    assert answers == ({b"calibration of the client"} if may_publish else set())


def test_the_site_cannot_command_its_robots(tmp_path):
    """What comes down the link to a site's router is somebody else's, too."""
    port = free_port()
    users = tmp_path / "users.txt"
    users.write_text("robot1:secret\n")
    credentials = {"user": "robot1", "password": "secret", "password_file": str(users)}
    site = open_bus(mode="router", tcp_port=port, publishers=["robot1"], **credentials)
    robot = open_bus(
        mode="router", socket=tmp_path / "z.sock", connect=[f"tcp/127.0.0.1:{port}"], **credentials
    )
    key = topics.CALIBRATION.key("robot1", "cam0")
    commands, seen = commanded(robot), []
    site.subscribe("vical/**", lambda s: seen.append(s.key))
    assert until(lambda: robot.publish(key, b"x") or key in seen)
    for _ in range(20):
        site.publish(COMMAND, encode_string("stop"))
        time.sleep(0.01)
    local = open_bus(mode="client", socket=tmp_path / "z.sock", user="robot1", password="secret")
    assert until(lambda: local.publish(COMMAND, encode_string("end")) or "end" in commands)
    assert "stop" not in commands
    for bus in (local, robot, site):
        bus.close()
