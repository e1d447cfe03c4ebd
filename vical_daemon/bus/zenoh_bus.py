"""The bus between processes and hosts: zenoh, with the delivery rules of the topics table.

One process of a rig (`acquire`) hosts the router; the others are its clients over a unix socket that is open
to the user and group of the host. Multicast is off. No process listens on a network, loopback included,
unless an endpoint is configured; clients of that endpoint may only read (`zenoh_rights`).
"""

from __future__ import annotations

import itertools
import logging
import secrets
import struct
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import zenoh

from vical_daemon.bus.interface import Handler, Sample, SampleQueue
from vical_daemon.bus.topics import Congestion, Priority, Topic, parse_key
from vical_daemon.bus.zenoh_rights import access_rules
from vical_daemon.bus.zenoh_session import (
    ENDPOINT,
    RETRY,
    BusError,
    add_security,
    base_config,
    closed_to_others,
    free_socket,
    open_session,
)

__all__ = ["BusError", "ZenohBus", "ZenohSubscription", "open_bus"]

_log = logging.getLogger(__name__)
_NUMBER = struct.Struct("<4sIQ")  # mark, publisher, number
_MARK = b"vic1"


def open_bus(
    *,
    mode: str,
    socket: Path | str | None = None,
    tcp_port: int = 0,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    tls_ca: str | None = None,
    tls_certificate: str | None = None,
    tls_key: str | None = None,
    password_file: str | None = None,
    user: str | None = None,
    password: str | None = None,
    commanders: Sequence[str] = (),
    publishers: Sequence[str] = (),
) -> ZenohBus:
    """Open the bus.

    Args:
        mode: ``router`` (hosts the bus of a rig or a site) or ``client``.
        socket: Unix socket: where the router listens (for its own user and group), where a client connects.
        tcp_port: Loopback port that the router listens on as well; 0: none. A client without socket and
            endpoints connects to it.
        listen: Further endpoints of the router, e.g. ``tls/0.0.0.0:7447``. Clients of these, of `tcp_port`
            and of `connect` may only subscribe and query, unless named below.
        connect: Endpoints of other routers (a site's), e.g. ``tls/site.example:7447``.
        tls_ca: Certificate authority, PEM file; with it TLS requires a certificate of both sides.
        tls_certificate: Own certificate, PEM file.
        tls_key: Its private key, PEM file.
        password_file: Router: ``user:password`` lines of the users who may connect.
        user: Own user name.
        password: Own password.
        commanders: Router: users, or names in client certificates, who may put commands.
        publishers: Router: users, or names in client certificates, who may publish and answer on all keys.

    Raises:
        BusError: No router, wrong password, socket in use, or settings that zenoh refuses.
    """
    if mode not in ("router", "client"):
        raise ValueError(f"mode {mode!r}: router or client")
    for endpoint in (*listen, *connect):
        if not ENDPOINT.fullmatch(endpoint):
            raise BusError(f"{endpoint!r} is no endpoint: write it like tcp/127.0.0.1:7447 or tls/robot:7447")
    local = [f"unixsock-stream/{socket}"] if socket else []
    if tcp_port:
        local.append(f"tcp/127.0.0.1:{tcp_port}")
    config: dict[str, Any] = base_config(router=mode == "router")
    config |= {"mode": mode, **_endpoints(mode, local, listen, connect)}
    add_security(config, tls_ca, tls_certificate, tls_key, password_file, user, password)
    if mode == "client":
        return ZenohBus(open_session(config), is_router=False)
    if socket:
        free_socket(Path(socket))
    if tcp_port or listen or connect:
        config["access_control"] = access_rules(commanders, publishers)
    with closed_to_others():
        return ZenohBus(open_session(config, router=True), is_router=True)


def _endpoints(
    mode: str, local: Sequence[str], listen: Sequence[str], connect: Sequence[str]
) -> dict[str, Any]:
    """Where a router listens and what it connects to, or the router that a client connects to."""
    if mode == "router":
        routers = {"endpoints": list(connect), "timeout_ms": -1, "exit_on_failure": False, **RETRY}
        return {"listen": {"endpoints": [*local, *listen]}, "connect": routers}
    endpoints = list(connect) or local[:1]
    if not endpoints:
        raise BusError("no router to connect to: give a socket or an endpoint like tcp/127.0.0.1:7447")
    return {"connect": {"endpoints": endpoints, "timeout_ms": 0, **RETRY}}


class _KeyPublisher:
    """The publisher of one key, with its sequence numbers, and its last value if that is kept."""

    def __init__(self, session: Any, key: str, publisher_id: int) -> None:
        parsed = parse_key(key)
        topic: Topic | None = parsed.topic if parsed else None
        self._key = key
        self._publisher_id = publisher_id
        self._lock = threading.Lock()
        self._numbers = itertools.count()  # its `next` needs no lock
        self._last: tuple[bytes, bytes] | None = None
        self._keep = topic is not None and topic.keep_last
        self._publisher = session.declare_publisher(
            key,
            encoding=f"application/cdr;{topic.type_name}" if topic else "application/octet-stream",
            priority=getattr(zenoh.Priority, topic.priority if topic else Priority.DATA),
            congestion_control=getattr(
                zenoh.CongestionControl, topic.congestion if topic else Congestion.DROP
            ),
            express=False,
        )
        self._queryable = session.declare_queryable(key, self._answer) if self._keep else None

    def put(self, payload: bytes) -> None:
        """Number and send one message."""
        if self._keep:
            with self._lock:  # so that the kept value is the one with the highest number
                number = _NUMBER.pack(_MARK, self._publisher_id, next(self._numbers))
                self._last = (payload, number)
        else:
            number = _NUMBER.pack(_MARK, self._publisher_id, next(self._numbers))
        self._publisher.put(payload, attachment=number)

    def _answer(self, query: Any) -> None:
        with query:
            last = self._last
            if last is not None:
                query.reply(self._key, last[0], attachment=last[1])

    def close(self) -> None:
        if self._queryable is not None:
            self._queryable.undeclare()
        self._publisher.undeclare()


class ZenohSubscription:
    """Subscription of a `ZenohBus`; zenoh's thread only delivers samples."""

    def __init__(self, handler: Handler | None, depth: int) -> None:
        self._handler = handler
        self._queue = SampleQueue(depth)
        self._gaps = 0
        self._failures = 0
        self._expected: dict[tuple[str, int], int] = {}
        self._subscriber: Any = None

    def declare(self, session: Any, key_expression: str) -> None:
        """Start receiving."""
        self._subscriber = session.declare_subscriber(key_expression, self._take)

    @property
    def dropped(self) -> int:
        """Samples lost on the way (gaps in the sequence) or to a full queue."""
        return self._queue.dropped + self._gaps

    def _take(self, received: Any) -> None:
        try:
            sample = self._read(received)
            if self._handler is None:
                self._queue.put(sample)
            else:
                self._handler(sample)
        except Exception:
            self._failures += 1
            if self._failures == 1:  # once: junk must not fill the journal
                _log.exception("handler of %s failed", received.key_expr)

    def _read(self, received: Any) -> Sample:
        key = str(received.key_expr)
        publisher, number = _numbers(received.attachment)
        if number is None:
            return Sample(key, received.payload.to_bytes(), 0)
        source = (key, publisher)
        expected = self._expected.get(source)
        if expected is not None and number > expected:
            self._gaps += number - expected
        if expected is None and len(self._expected) >= 4096:
            self._expected.clear()  # a sender invents keys: forget them, to bound memory
        self._expected[source] = number + 1
        return Sample(key, received.payload.to_bytes(), number)

    def recv(self, timeout_s: float | None = None) -> Sample | None:
        """Return the next sample, or None after the timeout or once closed."""
        return self._queue.recv(timeout_s)

    def close(self) -> None:
        """Leave; may be called twice."""
        subscriber, self._subscriber = self._subscriber, None
        if subscriber is not None:
            with suppress(zenoh.ZError):
                subscriber.undeclare()
        self._queue.close()


def _numbers(attachment: Any) -> tuple[int, int | None]:
    """Return (publisher, number) of a sample of vical, (0, None) of any other."""
    raw = attachment.to_bytes() if attachment is not None else b""
    if len(raw) != _NUMBER.size or raw[:4] != _MARK:
        return 0, None
    _, publisher, number = _NUMBER.unpack(raw)
    return publisher, number


class Mirror(Protocol):
    """Publishes the messages of a bus in another form too, e.g. under ROS 2's names."""

    def publish(self, key: str, payload: bytes) -> None:
        """Send one message."""
        ...

    def close(self) -> None:
        """Leave; may be called twice."""
        ...


class ZenohBus:
    """`Bus` over a zenoh session; made by `open_bus`."""

    def __init__(self, session: Any, *, is_router: bool) -> None:
        self._session = session
        self._is_router = is_router
        self._publisher_id = secrets.randbits(32)
        self._lock = threading.Lock()
        self._publishers: dict[str, _KeyPublisher] = {}
        self._subscriptions: list[ZenohSubscription] = []
        self._mirror: Mirror | None = None
        self._closed = False

    @property
    def session(self) -> Any:
        """The zenoh session, for ROS 2 keys and liveliness."""
        return self._session

    @property
    def is_router(self) -> bool:
        """Whether this process hosts the bus."""
        return self._is_router

    @property
    def connected(self) -> bool:
        """Whether a client has its router now (it reconnects by itself); always true for a router."""
        return self._is_router or bool(self._session.info.routers_zid())

    @property
    def protocol(self) -> str:
        """What this client is connected over, as "tls" or "unixsock-stream"; empty: not connected."""
        links = self._session.info.links()
        return str(links[0].dst).partition("/")[0] if links else ""

    def mirror_to(self, mirror: Mirror) -> None:
        """Publish every message there as well; closed with the bus."""
        self._mirror = mirror

    def publish(self, key: str, payload: bytes) -> None:
        """See `Bus.publish`; without a router the sample is lost, and leaves a gap in the numbers."""
        publisher = self._publishers.get(key)
        if publisher is None:
            with self._lock:
                if self._closed:
                    return
                publisher = self._publishers.get(key)
                if publisher is None:
                    publisher = self._publishers[key] = _KeyPublisher(self._session, key, self._publisher_id)
        # 1000 times a second on a small computer: `try` costs nothing, `suppress` two calls.
        try:
            publisher.put(payload)
        except zenoh.ZError:  # closing, or no link at this moment
            pass
        if self._mirror is not None:
            with suppress(zenoh.ZError):
                self._mirror.publish(key, payload)

    def subscribe(
        self,
        key_expression: str,
        handler: Handler | None = None,
        *,
        depth: int = 1024,
    ) -> ZenohSubscription:
        """See `Bus.subscribe`."""
        subscription = ZenohSubscription(handler, depth)
        subscription.declare(self._session, key_expression)
        with self._lock:
            self._subscriptions.append(subscription)
        return subscription

    def latest(self, key_expression: str, timeout_s: float = 1.0) -> list[Sample]:
        """See `Bus.latest`: queries every publisher of a matching key."""
        newest: dict[str, Sample] = {}
        replies = self._session.get(
            key_expression,
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.LATEST,
        )
        for reply in replies:
            received = reply.ok
            if received is None:
                continue
            key = str(received.key_expr)
            _, number = _numbers(received.attachment)
            newest[key] = Sample(key, received.payload.to_bytes(), number or 0)
        return [sample for _, sample in sorted(newest.items())]

    def close(self) -> None:
        """Leave; may be called twice."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            subscriptions, publishers = list(self._subscriptions), list(self._publishers.values())
        for subscription in subscriptions:
            subscription.close()
        if self._mirror is not None:
            with suppress(zenoh.ZError):
                self._mirror.close()
        with suppress(zenoh.ZError):
            for publisher in publishers:
                publisher.close()
            self._session.close()
