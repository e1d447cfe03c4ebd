"""Who may do what on the bus: nothing beyond loopback, TLS with certificates, passwords, read-only users."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest

from vical_daemon import topics
from vical_daemon.zenoh_bus import BusError, open_bus

pytestmark = pytest.mark.system
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


def test_passwords_and_read_only_users(tmp_path):
    users = tmp_path / "users.txt"
    users.write_text("robot:geheim\nviewer:schau\n")
    port = free_port()
    router = open_bus(
        mode="router", socket=tmp_path / "z.sock", tcp_port=port,
        password_file=str(users), readers=["viewer"],
        user="robot", password="geheim",
    )  # fmt: skip
    endpoint = [f"tcp/127.0.0.1:{port}"]
    for wrong in ({}, {"user": "robot", "password": "falsch"}, {"user": "nobody", "password": "geheim"}):
        with pytest.raises(BusError, match="user and password"):
            open_bus(mode="client", connect=endpoint, **wrong)
    robot = open_bus(mode="client", socket=tmp_path / "z.sock", user="robot", password="geheim")
    viewer = open_bus(mode="client", connect=endpoint, user="viewer", password="schau")
    heard: list[bytes] = []
    subscription = robot.subscribe("vical/**", lambda s: heard.append(s.payload))
    seen: list[bytes] = []
    watching = viewer.subscribe(KEY, lambda s: seen.append(s.payload))
    assert until(lambda: robot.publish(KEY, b"from robot") or b"from robot" in seen)
    assert [s.payload for s in viewer.latest(KEY)] == [b"from robot"]
    for _ in range(20):
        viewer.publish(KEY, b"forged")
        viewer.publish(topics.COMMAND.key("rig0", "record"), b"stop")
        time.sleep(0.01)
    robot.publish(KEY, b"end")
    assert until(lambda: b"end" in heard)
    assert set(heard) == {b"from robot", b"end"}
    assert {s.payload for s in robot.latest(KEY)} == {b"end"}  # nor can it answer in our place
    for item in (subscription, watching):
        item.close()
    for bus in (viewer, robot, router):
        bus.close()
