"""The bus between processes and hosts: zenoh, with the delivery rules of the topics table.

One process of a rig (`acquire`) hosts the router; the others are its clients over a unix socket. Nothing
multicasts, and nothing listens beyond loopback unless an endpoint says so. The traps that shaped these
settings are listed in docs/bus.md.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import re
import resource
import secrets
import socket as sockets
import struct
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from vical_daemon.bus import Handler, Sample, SampleQueue
from vical_daemon.topics import Congestion, Priority, Topic, parse_key

_log = logging.getLogger(__name__)
_NUMBER = struct.Struct("<4sIQ")  # mark, publisher, number
_MARK = b"vic1"
_SOURCE_PLACE = re.compile(r"[.,]?\s+at /\S+\.rs:\d+\.?")
_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|wss|serial|unixsock-stream|unixpipe|vsock)/.+")
_PAYLOAD_LIMIT = 256 * 2**20
# Batches of 64 kB: without shared memory an image of 360 kB takes six of "data".
_QUEUE_SIZES = {
    "control": 2, "real_time": 16, "interactive_high": 2, "interactive_low": 2,
    "data_high": 4, "data": 16, "data_low": 2, "background": 2,
}  # fmt: skip


class BusError(Exception):
    """The bus cannot be opened; the message is one line that says what to try."""


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
    readers: Sequence[str] = (),
) -> ZenohBus:
    """Open the bus.

    Args:
        mode: ``router`` (hosts the bus of a rig or a site) or ``client``.
        socket: Unix socket: where the router listens, where a client connects.
        tcp_port: Loopback port that the router listens on as well; 0: none. A client without socket and
            endpoints connects to it.
        listen: Further endpoints of the router, e.g. ``tls/0.0.0.0:7447``.
        connect: Endpoints of other routers (a site's), e.g. ``tls/site.example:7447``.
        tls_ca: Certificate authority, PEM file; with it TLS demands a certificate of both sides.
        tls_certificate: Own certificate, PEM file.
        tls_key: Its private key, PEM file.
        password_file: Router: ``user:password`` lines of those who may connect.
        user: Own user name.
        password: Own password.
        readers: Router: users who may subscribe and ask, never publish or answer.

    Raises:
        BusError: No router there, wrong password, socket in use, or settings that zenoh refuses.
    """
    if mode not in ("router", "client"):
        raise ValueError(f"mode {mode!r}: router or client")
    for endpoint in (*listen, *connect):
        if not _ENDPOINT.fullmatch(endpoint):
            raise BusError(f"{endpoint!r} is no endpoint: write it like tcp/127.0.0.1:7447 or tls/robot:7447")
    local = [f"unixsock-stream/{socket}"] if socket else []
    if tcp_port:
        local.append(f"tcp/127.0.0.1:{tcp_port}")
    config: dict[str, Any] = _base_config()
    if mode == "router":
        if socket:
            _free_socket(Path(socket))
        config |= {"mode": "router", "listen": {"endpoints": [*local, *listen]}}
        config["connect"] = {"endpoints": list(connect), "timeout_ms": -1, "exit_on_failure": False, **_RETRY}
    else:
        endpoints = list(connect) or local[:1]
        if not endpoints:
            raise BusError("no router to connect to: give a socket or an endpoint like tcp/127.0.0.1:7447")
        config |= {"mode": "client", "connect": {"endpoints": endpoints, "timeout_ms": 0, **_RETRY}}
    _add_security(config, tls_ca, tls_certificate, tls_key, password_file, user, password)
    if readers:
        config["access_control"] = _read_only(readers)
    return ZenohBus(_open(config), is_router=mode == "router")


_RETRY = {"retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}}


def _base_config() -> dict[str, Any]:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    roomy = soft == resource.RLIM_INFINITY or soft >= 64 * 2**20
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": {"router": True, "peer": True, "client": True}},
        "transport": {
            "shared_memory": {
                "enabled": True,
                # the pool is locked into memory: it must fit under LimitMEMLOCK, 8 MiB by default
                "transport_optimization": {"enabled": True, "pool_size": 2**24 if roomy else 2**22},
            },
            "link": {
                "tx": {
                    "queue": {
                        "size": _QUEUE_SIZES,
                        "congestion_control": {"block": {"wait_before_close": 1_000_000}},
                    }
                },
                "rx": {"max_message_size": _PAYLOAD_LIMIT},
            },
        },
    }


def _add_security(
    config: dict[str, Any],
    tls_ca: str | None,
    certificate: str | None,
    key: str | None,
    password_file: str | None,
    user: str | None,
    password: str | None,
) -> None:
    for path in (tls_ca, certificate, key, password_file):
        if path and not os.access(path, os.R_OK):
            raise BusError(f"{path} cannot be read; see tls_ca, tls_certificate, tls_key and password_file")
    if tls_ca or certificate or key:
        tls: dict[str, Any] = {"enable_mtls": bool(tls_ca and certificate)}
        if tls_ca:
            tls["root_ca_certificate"] = tls_ca
        if certificate and key:
            tls |= {
                "listen_certificate": certificate, "listen_private_key": key,
                "connect_certificate": certificate, "connect_private_key": key,
            }  # fmt: skip
        config["transport"]["link"]["tls"] = tls
    if password_file or user:
        given = {"dictionary_file": password_file, "user": user, "password": password}
        config["transport"]["auth"] = {"usrpwd": {k: v for k, v in given.items() if v}}


def _read_only(readers: Sequence[str]) -> dict[str, Any]:
    """Return access rules: these users may subscribe and ask, everything else is refused them."""
    rule = {
        "id": "no writing",
        "permission": "deny",
        "flows": ["ingress"],
        "messages": ["put", "delete", "declare_queryable", "reply", "liveliness_token"],
        "key_exprs": ["**"],
    }
    return {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [{"id": "readers", "usernames": list(readers)}],
        "policies": [{"rules": ["no writing"], "subjects": ["readers"]}],
    }


def _free_socket(path: Path) -> None:
    """Remove the socket of a router that was killed.

    Raises:
        BusError: Somebody answers there, or the folder is not ours.
    """
    probe = sockets.socket(sockets.AF_UNIX)
    try:
        probe.connect(str(path))
    except FileNotFoundError:
        return
    except ConnectionRefusedError:
        with suppress(FileNotFoundError):
            path.unlink()
        return
    except OSError as error:
        raise BusError(f"{path}: {error.strerror}; set bus.socket to a path that this user may use") from None
    finally:
        probe.close()
    raise BusError(
        f"another process already hosts the bus at {path}; stop it first (systemctl status vical-acquire)"
    )


def _open(config: dict[str, Any]) -> Any:
    """Open a session; where the kernel forbids locked memory, without shared memory."""
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        text = str(error)
        if "shm" not in text.lower() and "shared memory" not in text.lower():
            raise BusError(_explain(config, text)) from None
    _log.warning("no shared memory on the bus (LimitMEMLOCK?): images take twice the processor time")
    config["transport"]["shared_memory"] = {"enabled": False}
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        raise BusError(_explain(config, str(error))) from None


def _explain(config: dict[str, Any], text: str) -> str:
    """Say in one line what is wrong and what to try; places in zenoh's own source help nobody."""
    detail = " ".join(_SOURCE_PLACE.sub("", text).split())[:200]
    if config["mode"] == "client":
        endpoints = config["connect"]["endpoints"]
        where = ", ".join(endpoint.removeprefix("unixsock-stream/") for endpoint in endpoints)
        if any(_answers(endpoint) for endpoint in endpoints):
            return (
                f"no bus at {where}: a router is there but refuses us; check user and password, certificates"
            )
        words = f"no bus at {where}: nothing answers; start `vical run -c FILE` (or vical.target) there"
        return words if detail.startswith("Unable to connect") else f"{words} ({detail})"
    where = ", ".join(config["listen"]["endpoints"])
    return f"cannot host the bus at {where}: is another router running there? ({detail})"


def _answers(endpoint: str) -> bool:
    """Whether anybody accepts connections at an endpoint (of the kinds that can be tried simply)."""
    protocol, _, place = endpoint.partition("/")
    try:
        if protocol == "unixsock-stream":
            with sockets.socket(sockets.AF_UNIX) as probe:
                probe.settimeout(0.5)
                probe.connect(place)
                return True
        host, _, port = place.partition("#")[0].rpartition(":")
        if protocol not in ("tcp", "tls") or not port.isdigit():
            return False
        with sockets.create_connection((host.strip("[]"), int(port)), timeout=0.5):
            return True
    except OSError:
        return False


class _Outlet:
    """The publisher of one key, its numbering, and its last value where that is kept."""

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
        if self._keep:
            with self._lock:  # the last one is that with the highest number
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
    """Subscription of a `ZenohBus`; zenoh's thread only hands samples over."""

    def __init__(self, handler: Handler | None, depth: int, newest_wins: bool) -> None:
        self._handler = handler
        self._queue = SampleQueue(depth, newest_wins)
        self._gaps = 0
        self._failures = 0
        self._expected: dict[tuple[str, int], int] = {}
        self._subscriber: Any = None

    def declare(self, session: Any, key_expression: str) -> None:
        """Begin to receive."""
        self._subscriber = session.declare_subscriber(key_expression, self._take)

    @property
    def dropped(self) -> int:
        """Samples lost on the way (gaps in their numbers) or to a full queue."""
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
            if self._failures == 1:  # once: whoever sends junk must not fill the journal
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
            self._expected.clear()  # somebody invents keys: forget, rather than grow
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
    """Return (publisher, number) of a sample of ours, (0, None) of anything else."""
    raw = attachment.to_bytes() if attachment is not None else b""
    if len(raw) != _NUMBER.size or raw[:4] != _MARK:
        return 0, None
    _, publisher, number = _NUMBER.unpack(raw)
    return publisher, number


class ZenohBus:
    """`Bus` over a zenoh session; made by `open_bus`."""

    def __init__(self, session: Any, *, is_router: bool) -> None:
        self._session = session
        self._is_router = is_router
        self._publisher_id = secrets.randbits(32)
        self._lock = threading.Lock()
        self._outlets: dict[str, _Outlet] = {}
        self._subscriptions: list[ZenohSubscription] = []
        self._closed = False

    @property
    def session(self) -> Any:
        """The zenoh session, for what goes beyond a `Bus` (ROS 2 keys, liveliness)."""
        return self._session

    @property
    def connected(self) -> bool:
        """Whether a client has its router at this moment (it comes back by itself); a router: always."""
        return self._is_router or bool(self._session.info.routers_zid())

    def publish(self, key: str, payload: bytes) -> None:
        """See `Bus.publish`; without a router the sample is lost, and the number tells so."""
        outlet = self._outlets.get(key)
        if outlet is None:
            with self._lock:
                if self._closed:
                    return
                outlet = self._outlets.get(key)
                if outlet is None:
                    outlet = self._outlets[key] = _Outlet(self._session, key, self._publisher_id)
        try:
            outlet.put(payload)
        except zenoh.ZError:  # closing, or no link at this moment
            return

    def subscribe(
        self,
        key_expression: str,
        handler: Handler | None = None,
        *,
        depth: int = 1024,
        newest_wins: bool = False,
    ) -> ZenohSubscription:
        """See `Bus.subscribe`."""
        subscription = ZenohSubscription(handler, depth, newest_wins)
        subscription.declare(self._session, key_expression)
        with self._lock:
            self._subscriptions.append(subscription)
        return subscription

    def latest(self, key_expression: str, timeout_s: float = 1.0) -> list[Sample]:
        """See `Bus.latest`: asks every publisher of a matching key."""
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
            subscriptions, outlets = list(self._subscriptions), list(self._outlets.values())
        for subscription in subscriptions:
            subscription.close()
        with suppress(zenoh.ZError):
            for outlet in outlets:
                outlet.close()
            self._session.close()
