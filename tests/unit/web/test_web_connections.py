"""Who is let in at the page: names, numbers of connections, junk."""

import asyncio
import logging

import pytest
from aiohttp.http_exceptions import BadStatusLine
from aiohttp.web import RequestPayloadError

from vical_daemon.bus.log_limit import LogLimit
from vical_daemon.web.connections import IDLE_S, REPORT_S, UNSENT_S, Gate, Malformed, http_logger
from vical_daemon.web.hosts import AllowedHosts


@pytest.mark.parametrize(
    ("header", "allowed"),
    [
        ("localhost", True),
        ("localhost:8080", True),
        ("LocalHost.", True),
        ("page.localhost:1", True),
        ("127.0.0.1:8080", True),
        ("127.1.2.3", True),
        ("[::1]:8080", True),
        ("robot7.example:99", True),
        ("10.0.0.7", True),  # where the connection arrived
        ("Robot7", True),
        ("robot7.local", True),
        ("10.0.0.8", False),
        ("evil.example", False),
        ("localhost.evil.example", False),
        ("127.0.0.1.evil.example", False),
        ("evillocalhost", False),
        ("", False),
        (" ", False),
        ("localhost, evil.example", False),
        ("user@localhost", False),
        ("[::2]", False),
        ("localhost:abc", False),
    ],
)
def test_names_that_the_page_answers_to(header, allowed, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "robot7.lab.example")
    assert AllowedHosts(["robot7.example"]).allows(header, "10.0.0.7") is allowed


class Transport(asyncio.Transport):
    def __init__(self):
        super().__init__()
        self.closed, self.sent, self.unsent = False, b"", 0

    def write(self, data):
        self.sent += data

    def close(self):
        self.closed = True

    abort = close

    def get_write_buffer_size(self):
        return self.unsent


class Inner(asyncio.Protocol):
    def __init__(self):
        self.made, self.data = False, b""

    def connection_made(self, transport):
        self.made = True

    def data_received(self, data):
        self.data += data


@pytest.fixture
def gate():
    gate = Gate(Inner, limit=3, clock=lambda: gate.now_s)
    gate.now_s = 0.0
    return gate


def come(gate):
    protocol, transport = gate(), Transport()
    protocol.connection_made(transport)
    return protocol, transport


def test_the_connection_that_has_idled_longest_makes_room(gate):
    held = [come(gate) for _ in range(3)]
    gate.busy(held[0][0]._inner)
    late, late_transport = come(gate)
    assert [transport.closed for _, transport in held] == [False, True, False]
    assert gate.open == 3
    late.data_received(b"GET")
    assert late._inner.data == b"GET"
    assert not late_transport.closed
    assert gate.refused == 1


def test_where_all_are_served_the_next_one_is_told_so(gate):
    held = [come(gate) for _ in range(3)]
    for protocol, _ in held:
        gate.busy(protocol._inner)
    late, transport = come(gate)
    assert transport.sent.startswith(b"HTTP/1.1 503")
    assert transport.closed
    late.data_received(b"GET / HTTP/1.1")
    late.connection_lost(None)
    assert not late._inner.made
    assert late._inner.data == b""
    held[0][0].connection_lost(None)
    assert gate.open == 2
    assert not come(gate)[1].closed


def test_half_open_and_sleeping_connections_end(gate):
    (_, half_open), (served, streaming), (slow, unsent) = come(gate), come(gate), come(gate)
    gate.busy(served._inner)
    unsent.unsent = 1
    gate.now_s = IDLE_S + 0.1
    gate.sweep()
    assert (half_open.closed, streaming.closed, unsent.closed) == (True, False, False)
    gate.idle(served._inner)
    gate.now_s += IDLE_S + 0.1
    gate.sweep()
    assert streaming.closed
    assert not unsent.closed
    gate.now_s = UNSENT_S + 0.1
    gate.sweep()
    assert unsent.closed
    slow.connection_lost(None)  # the loop reports it later
    gate.idle(slow._inner)
    gate.sweep()
    assert gate.open == 0


def test_malformed_requests_are_one_line_and_bugs_keep_their_traceback(caplog):
    now_s = [0.0]
    malformed = Malformed(lambda: now_s[0])
    logger = http_logger(malformed)

    def fail(error):
        try:
            raise error
        except Exception:
            logger.exception("Error handling request from %s", "127.0.0.1")

    with caplog.at_level(logging.INFO):
        for k in range(50):
            fail(BadStatusLine(f"junk\n{k}") if k % 2 else RequestPayloadError("no gzip"))
        assert malformed.count == 50
        assert len(caplog.records) == 1
        now_s[0] += REPORT_S
        fail(UnicodeDecodeError("utf-8", b"\xff", 0, 1, "junk"))
        assert "49 more" in caplog.messages[-1]
        for record in caplog.records:
            assert record.exc_info is None
            assert "\n" not in record.getMessage()
        for _ in range(3):
            fail(ZeroDivisionError("ours"))
    assert [record.exc_info is not None for record in caplog.records] == [False, False, True]


def test_lines_are_limited_and_counted():
    now_s = [0.0]
    limit = LogLimit(2, 10.0, lambda: now_s[0])
    assert [limit.admit() for _ in range(5)] == ["", "", None, None, None]
    now_s[0] = 10.0
    assert [limit.admit() for _ in range(2)] == [" (3 more before it)", ""]
