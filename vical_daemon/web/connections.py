"""Limits the open connections of the page, and the log lines of malformed requests."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable

from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.web import RequestPayloadError

from vical_daemon.bus.log_limit import LogLimit

CONNECTIONS_LIMIT = 128
"""Open connections: twice the viewers that are admitted (32 of values, 32 of pictures)."""
IDLE_S = 5.0
"""Longest time for a request header, and longest time without a request, s."""
UNSENT_S = 30.0
"""Longest time for a client to fetch the rest of an answer, s."""
BODY_S = 5.0
"""Longest time for a request body, s."""
REPORT_S = 60.0
"""Shortest time between two log lines about malformed requests, s."""
_FULL = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class Gate:
    """Limits connections. A new connection above the limit closes the one that has been idle longest.

    So half-open connections cannot block the page. If all connections are being served, the new one is
    refused.

    Args:
        make: Returns the protocol of a new connection.
        limit: Open connections.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        make: Callable[[], asyncio.Protocol],
        limit: int = CONNECTIONS_LIMIT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._make, self._limit, self._clock = make, limit, clock
        self._open: dict[asyncio.Protocol, asyncio.Transport] = {}
        self._idle: dict[asyncio.Protocol, float] = {}  # since when; the oldest first
        self.refused = 0

    def __call__(self) -> asyncio.Protocol:
        """Return the protocol of a new connection, for `loop.create_server`."""
        return _Guarded(self._make(), self)

    @property
    def open(self) -> int:
        """Number of open connections."""
        return len(self._open)

    def admit(self, protocol: asyncio.Protocol, transport: asyncio.Transport) -> bool:
        """Admit a connection, closing an idle one if necessary; False: no room."""
        if len(self._open) >= self._limit:
            self.refused += 1
            oldest = next(iter(self._idle), None)
            if oldest is None:
                return False
            self._end(oldest)
        self._open[protocol] = transport
        self._idle[protocol] = self._clock()
        return True

    def sweep(self) -> None:
        """Close connections that have been idle for too long."""
        now_s = self._clock()
        for protocol, since_s in list(self._idle.items()):
            unsent = self._open[protocol].get_write_buffer_size()
            if now_s - since_s > (UNSENT_S if unsent else IDLE_S):
                self._end(protocol)

    def _end(self, protocol: asyncio.Protocol) -> None:
        transport = self._open[protocol]
        self.leave(protocol)
        transport.abort()

    def leave(self, protocol: asyncio.Protocol) -> None:
        """Forget a connection; may be called twice."""
        self._open.pop(protocol, None)
        self._idle.pop(protocol, None)

    def busy(self, protocol: asyncio.Protocol) -> None:
        """Note that a request of this connection is being answered: no time limit."""
        self._idle.pop(protocol, None)

    def idle(self, protocol: asyncio.Protocol) -> None:
        """Note that the answer was sent."""
        if protocol in self._open:
            self._idle[protocol] = self._clock()


class _Guarded(asyncio.Protocol):
    """Wraps aiohttp's protocol, which gets only admitted connections."""

    def __init__(self, inner: asyncio.Protocol, gate: Gate) -> None:
        self._inner, self._gate = inner, gate
        self._admitted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._admitted = self._gate.admit(self._inner, transport)
        if self._admitted:
            self._inner.connection_made(transport)
        else:
            transport.write(_FULL)
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._admitted:
            self._gate.leave(self._inner)
            self._inner.connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._admitted:
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return self._inner.eof_received() if self._admitted else None

    def pause_writing(self) -> None:
        if self._admitted:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        if self._admitted:
            self._inner.resume_writing()


_FOREIGN = (HttpProcessingError, RequestPayloadError, ConnectionError, TimeoutError, UnicodeError)


class Malformed(logging.Filter):
    """Counts malformed requests and logs at most one line per `REPORT_S` about them.

    Errors in our own code keep their traceback, at the same rate.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._limits = {foreign: LogLimit(1, REPORT_S, clock) for foreign in (True, False)}
        self.count = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """See `logging.Filter.filter`."""
        error = record.exc_info[1] if record.exc_info else None
        if error is None:
            return True
        foreign = isinstance(error, _FOREIGN)
        self.count += foreign
        more = self._limits[foreign].admit()
        if more is None:
            return False
        if foreign:
            text = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            record.msg, record.args = "malformed request refused: %s%s", (text, more)
            record.exc_info, record.levelno, record.levelname = None, logging.INFO, "INFO"
        return True


def http_logger(malformed: Malformed) -> logging.Logger:
    """Return the logger for aiohttp, with the filter."""
    logger = logging.Logger("vical_daemon.web.http")
    logger.parent = logging.getLogger(__name__)
    logger.addFilter(malformed)
    return logger
