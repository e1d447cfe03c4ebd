"""The page against those who mean harm: foreign names, half-open connections, junk instead of requests."""

import json
import logging
import socket
import threading
import time
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest

from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import decode_diagnostics
from vical_daemon.config.model import CameraConfig, Config, ImuConfig, WebConfig
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.web import role as web
from vical_daemon.web.connections import CONNECTIONS_LIMIT, IDLE_S

pytestmark = pytest.mark.system


def place(page):
    parts = urlsplit(page.address)
    return parts.hostname, parts.port


def say(page, data, timeout_s=30.0):
    """Send bytes; return all that comes back until the page closes."""
    with socket.create_connection(place(page), timeout=timeout_s) as connection:
        connection.sendall(data)
        got = b""
        try:
            while part := connection.recv(65536):
                got += part
        except ConnectionResetError:
            pass
        return got


def get(page, path, host):
    lines = [f"GET {path} HTTP/1.1", *([f"Host: {name}" for name in host]), "Connection: close", "", ""]
    return say(page, "\r\n".join(lines).encode())


def counters(page):
    (sample,) = page.bus.latest("vical/rig0/status/web")
    return decode_diagnostics(sample.payload).statuses[0].values


def until(condition, timeout_s=60.0):
    end_s = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.05)
    return bool(condition())


@pytest.mark.parametrize("path", ["/", "/api/state", "/events", "/metrics", "/camera/cam0.mjpg"])
def test_a_foreign_name_gets_nothing(fed, path):
    for host in (["evil.example"], ["127.0.0.1.evil.example:8080"], [], ["localhost", "evil.example"]):
        answer = get(fed, path, host)
        assert answer.split(b" ")[1] in (b"421", b"400")
        assert b"cam0" not in answer.split(b"\r\n\r\n", 1)[1]
        assert b"converged" not in answer
    assert get(fed, "/metrics", ["localhost:1"]).startswith(b"HTTP/1.1 200")


def test_commands_need_the_right_name_too(served):
    body = b'{"command": "reset"}'
    head = (
        "POST /api/command HTTP/1.1\r\nHost: {}\r\nAuthorization: Bearer open sesame\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    assert say(served, head.format("evil.example").encode() + body).startswith(b"HTTP/1.1 421")
    assert served.commands == []
    assert say(served, head.format("localhost").encode() + body).startswith(b"HTTP/1.1 200")
    assert len(served.commands) == 1


def test_more_names_can_be_allowed(web_feed):
    stop, ready, addresses = threading.Event(), threading.Event(), []
    config = Config(
        imus={"imu0": ImuConfig(port="none")},
        cameras={"cam0": CameraConfig(uri="none")},
        web=WebConfig(enabled=True, port=0, hosts=("robot7.example",)),
    )
    options = {"clock": private_clock(), "ready": lambda address: (addresses.append(address), ready.set())}
    thread = threading.Thread(target=web.run, args=(config, LocalBus(), stop), kwargs=options)
    thread.start()
    assert ready.wait(60)

    class Page:
        address = addresses[0]

    answers = [get(Page, "/metrics", [name])[:12] for name in ("robot7.example:80", "robot8.example")]
    stop.set()
    thread.join(60)
    assert answers == [b"HTTP/1.1 200", b"HTTP/1.1 421"]


def test_four_hundred_half_open_connections_shut_nobody_out(served):
    held = []
    try:
        for k in range(400):
            connection = socket.create_connection(place(served), timeout=30)
            held.append(connection)
            if k % 2:
                connection.sendall(b"GET / HTTP/1.1\r\nHost: localh")
        assert until(lambda: int(counters(served)["connections"]) <= CONNECTIONS_LIMIT)
        begin_s = time.monotonic()
        assert get(served, "/metrics", ["localhost"]).startswith(b"HTTP/1.1 200")
        assert time.monotonic() - begin_s < IDLE_S + 10
        assert until(lambda: int(counters(served)["connections_refused"]) >= 400 - CONNECTIONS_LIMIT)
        assert until(lambda: int(counters(served)["connections"]) == 0, IDLE_S + 30)
        for connection in held:  # the other side is notified
            connection.settimeout(10)
            try:
                assert connection.recv(10) == b""
            except ConnectionResetError:
                pass
    finally:
        for connection in held:
            connection.close()


def test_who_drips_its_request_is_let_go(served):
    with socket.create_connection(place(served), timeout=30) as slow:
        slow.sendall(b"GET / HTTP/1.1\r\n")
        begin_s, ended = time.monotonic(), False
        while not ended and time.monotonic() - begin_s < IDLE_S + 60:
            try:
                slow.sendall(b"X")
                time.sleep(0.2)
            except OSError:
                ended = True
        assert ended
    head = b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer open sesame\r\n"
    answer = say(served, head + b"Content-Length: 100\r\n\r\n{", timeout_s=90)
    assert answer.startswith(b"HTTP/1.1 408")


def test_junk_instead_of_requests_leaves_no_traceback(served, caplog):
    rng = np.random.default_rng(0)
    junk = [
        b"\x16\x03\x01\x02\x00\x01\x00" * 9,  # TLS
        b"\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nno colon\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer open sesame\r\n"
        b"Transfer-Encoding: chunked\r\n\r\nnot hex\r\n",
        b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer \xff\xfe\r\n"
        b"Content-Length: 2\r\n\r\n{}",
        b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer open sesame\r\n"
        b"Content-Type: application/json; charset=nonsense\r\nContent-Length: 2\r\n\r\n{}",
        b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer open sesame\r\n"
        b"Content-Length: 60000\r\n\r\n" + b"[" * 60000,
        b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer open sesame\r\n"
        b"Content-Length: 4000\r\n\r\n" + b"[" * 4000,
        b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer open sesame\r\n"
        b'Content-Length: 15\r\n\r\n{"command": []}',
        b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer open sesame\r\n"
        b"Content-Encoding: gzip\r\nContent-Length: 3\r\n\r\nabc",
        b"GET /%ff%fe%00 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /camera/%ff/events HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET http://[bad/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET //////:99999999/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"OPTIONS * HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"CONNECT localhost:1 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n\x81\x00",
        b"GET /" + b"a" * 20000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"X: y\r\n" * 5000 + b"\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nRange: bytes=9-1\r\nIf-Modified-Since: x\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nCookie: \x7f=\xff; ;;=\r\nAccept-Encoding: \xff\r\n\r\n",
        *(rng.bytes(int(n)) for n in rng.integers(1, 400, 40)),
    ]
    with caplog.at_level(logging.DEBUG):
        for data in junk:
            with socket.create_connection(place(served), timeout=30) as connection:
                try:
                    connection.sendall(data)
                    connection.shutdown(socket.SHUT_WR)
                    while connection.recv(65536):
                        pass
                except OSError:
                    pass
        assert until(lambda: int(counters(served)["requests_malformed"]) > 0)
    for record in caplog.records:
        if record.levelno > logging.DEBUG:
            assert not record.exc_info, record.getMessage()
            assert "Traceback" not in record.getMessage()
    assert len([r for r in caplog.records if r.levelno >= logging.WARNING]) <= 5
    assert served.commands == []
    with urlopen(served.address + "api/state") as answer:
        assert json.load(answer)["rig"] == "rig0"
