"""`vical watch` and `vical web` wait for a bus that is not there yet, and for nothing else."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import encode_camera_info
from vical_daemon.bus.zenoh_bus import BusError, open_bus
from vical_daemon.cli import main
from vical_daemon.cli.bus_wait import wait_for_bus
from vical_daemon.cli.web import _discover

pytestmark = pytest.mark.system
NEVER = float("inf")


@pytest.fixture
def port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_bus_that_comes_later_is_joined(tmp_path: Path, port: int, capsys) -> None:
    stop, found = threading.Event(), []

    def wait() -> None:
        found.append(wait_for_bus(None, f"tcp/127.0.0.1:{port}", end_s=NEVER, stop=stop))

    waiting = threading.Thread(target=wait)
    waiting.start()
    waiting.join(1.5)
    assert waiting.is_alive()
    host = open_bus(mode="router", socket=tmp_path / "zenoh.sock", tcp_port=port)
    waiting.join(60)
    stop.set()
    assert found[0] is not None
    assert capsys.readouterr().err.count("vical: waiting: no bus at tcp/127.0.0.1:") == 1
    found[0].close()
    host.close()


def test_a_router_that_is_not_ready_yet_is_asked_again(tmp_path: Path) -> None:
    """Something accepts and closes connections at first, as a router may while it starts."""
    path, hosts, refused = tmp_path / "zenoh.sock", [], []
    starting = socket.socket(socket.AF_UNIX)
    starting.bind(str(path))
    starting.listen()

    def start() -> None:
        for _ in range(2):
            connection, _ = starting.accept()
            connection.close()
            refused.append(connection)
        starting.close()
        hosts.append(open_bus(mode="router", socket=path))

    starts = threading.Thread(target=start)
    starts.start()
    client = open_bus(mode="client", socket=path)
    starts.join(60)
    assert len(refused) == 2 and len(hosts) == 1
    client.close()
    hosts[0].close()


def test_what_refuses_for_good_is_named(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.sock"
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        threading.Thread(target=_close_every_connection, args=(other,), daemon=True).start()
        with pytest.raises(BusError, match="a router is there but refuses us"):
            open_bus(mode="client", socket=path)
        other.shutdown(socket.SHUT_RDWR)


def _close_every_connection(listener: socket.socket) -> None:
    with suppress(OSError):
        while True:
            listener.accept()[0].close()


def test_watch_gives_up_when_its_time_is_over(port: int, capsys) -> None:
    begin_s = time.monotonic()
    assert main(["watch", "--connect", f"tcp/127.0.0.1:{port}", "--timeout", "1"]) == 1
    assert time.monotonic() - begin_s >= 1.0
    waiting, error = capsys.readouterr().err.splitlines()
    assert waiting.startswith("vical: waiting: ") and error.startswith("vical: error: no bus at")


def test_what_waiting_does_not_mend_is_told_at_once() -> None:
    with pytest.raises(BusError, match="is no endpoint"):
        wait_for_bus(None, "robot7", end_s=NEVER, stop=threading.Event())


def test_the_page_waits_for_something_on_the_bus() -> None:
    bus, stop, found = LocalBus(), threading.Event(), []
    waiting = threading.Thread(target=lambda: found.append(_discover(bus, stop)))
    waiting.start()
    waiting.join(0.5)
    assert waiting.is_alive()
    info = encode_camera_info(1, "cam0", (640, 480), [500.0, 500.0, 320.0, 240.0], "radtan", [0.0] * 4)
    bus.publish(topics.CAMERA_INFO.key("rover", "cam0"), info)
    waiting.join(60)
    stop.set()
    assert found[0].rig == "rover" and list(found[0].cameras) == ["cam0"]
