"""Opens zenoh sessions: settings, security, the router's socket, and one-line errors.

docs/bus.md explains the settings.
"""

from __future__ import annotations

import json
import logging
import os
import re
import resource
import socket as sockets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import zenoh

from vical_daemon.bus.socket_paths import Reach, reach, why_closed

_log = logging.getLogger(__name__)
_SOURCE_PLACE = re.compile(r"[.,]?\s+at /\S+\.rs:\d+\.?")
ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|wss|serial|unixsock-stream|unixpipe|vsock)/.+")
"""Endpoints that zenoh accepts."""
_PAYLOAD_LIMIT = 256 * 2**20
RETRY = {"retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}}
"""How a session reconnects to its router."""
_STARTING_MS = 3000
"""How long a client tries again where something accepts connections but refuses a session, ms. A router that
starts on a busy computer does so for a moment. A wrong password is reported after this time."""
_POOL_BYTES = 4 * 2**20
"""Shared memory of a router, bytes: three images of 1.3 MP. Every receiver of the same user locks it, so it
stays below the usual limit of 8 MiB of other programs. Images that do not fit are copied."""
_ENOUGH_LOCKED_BYTES = 64 * 2**20
"""Limit of locked memory from which memory is shared, bytes: ten routers' pools with their bookkeeping
(5.4 MiB each, measured: tests/system/test_shared_memory.py)."""
_WANTED_FILES = 1024
"""Open files that a process asks for, as far as its hard limit goes: `select`, which pyserial uses, takes no
more (FD_SETSIZE of select.h)."""
_LEAST_FILES = 64
"""Open files without which no session is opened: zenoh ends a process that cannot open one more (a panic).
The router of an emulated rig with three clients has 43 open, and two more for each further one (measured)."""
_CAP_IPC_LOCK = 14
"""Number of the capability in linux/capability.h."""
_LOCKED = (
    "this process may lock too little memory to share them; to share: ulimit -l unlimited, or "
    "LimitMEMLOCK=infinity in a unit"
)
_NO_SHM = (
    "there is no /dev/shm, or it is full or read-only; to share: mount it (in a container: --shm-size 64m)"
)
_warned = False
# Batches of 64 kB: without shared memory an image of 360 kB takes six of "data".
_QUEUE_SIZES = {
    "control": 2, "real_time": 16, "interactive_high": 2, "interactive_low": 2,
    "data_high": 4, "data": 16, "data_low": 2, "background": 2,
}  # fmt: skip


class BusError(Exception):
    """The bus cannot be opened; the message is one line with a remedy."""


def can_share_memory() -> bool:
    """Return whether this process may lock enough memory to share images instead of copying them.

    zenoh locks every segment that it maps, its own and those of its senders. At the limit it silently drops
    the messages that it cannot map. So memory is shared only if the limit has room for
    several routers (docs/bus.md, "Shared memory").
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return soft == resource.RLIM_INFINITY or soft >= _ENOUGH_LOCKED_BYTES or _may_lock_anything()


def _may_lock_anything() -> bool:
    """Return whether the kernel exempts this process from the limit (CAP_IPC_LOCK, which root has)."""
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    found = re.search(r"^CapEff:\s*([0-9a-f]+)", status, re.MULTILINE)
    return found is not None and bool(int(found[1], 16) >> _CAP_IPC_LOCK & 1)


def _warn_of_copies(why: str) -> None:
    """Log once per process that images are copied, why, and what to do."""
    global _warned
    if not _warned:
        _warned = True
        _log.info("the bus copies images, because %s (costs processor time, loses nothing)", why)


def base_config(*, router: bool = False) -> dict[str, Any]:
    """Return the settings of all sessions; only a router shares memory."""
    shared = can_share_memory()
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": {"router": True, "peer": True, "client": True}},
        "transport": {
            "shared_memory": {
                "enabled": shared,
                "transport_optimization": {"enabled": shared and router, "pool_size": _POOL_BYTES},
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


def add_security(
    config: dict[str, Any],
    tls_ca: str | None,
    certificate: str | None,
    key: str | None,
    password_file: str | None,
    user: str | None,
    password: str | None,
) -> None:
    """Add certificates and passwords to the settings; see `zenoh_bus.open_bus` for each.

    Raises:
        BusError: A file cannot be read.
    """
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


@contextmanager
def closed_to_others() -> Iterator[None]:
    """Create files and sockets for this user and group only, while the context lasts.

    The umask applies to the whole process: a router is opened before the roles start.
    """
    before = os.umask(0o007)
    try:
        yield
    finally:
        os.umask(before)


def free_socket(path: Path) -> None:
    """Remove the socket of a router that was killed.

    Raises:
        BusError: A router answers there, or the folder belongs to another user.
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
        raise BusError(
            f"{path}: {error.strerror or error}; set bus.socket to a path that this user may use"
        ) from None
    finally:
        probe.close()
    raise BusError(
        f"another process already hosts the bus at {path}; stop it first (systemctl status vical-acquire)"
    )


def open_session(config: dict[str, Any], *, router: bool = False) -> Any:
    """Open a session, without shared memory if the process may lock too little; a router says so.

    Raises:
        BusError: No router, or too few files that the process may open.
    """
    _allow_files()
    shared = config["transport"]["shared_memory"]["enabled"]
    if router and not shared:
        _warn_of_copies(_LOCKED)
    try:
        return _open(config)
    except zenoh.ZError as error:
        text = str(error)
        if not shared or ("shm" not in text.lower() and "shared memory" not in text.lower()):
            raise BusError(_explain(config, text)) from None
    if router:
        _warn_of_copies(_NO_SHM)
    config["transport"]["shared_memory"] = {"enabled": False}
    try:
        return _open(config)
    except zenoh.ZError as error:
        raise BusError(_explain(config, str(error))) from None


def _allow_files() -> None:
    """Raise the limit of open files as far as a session may need.

    Raises:
        BusError: The hard limit is too low.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < _WANTED_FILES:  # RLIM_INFINITY is -1
        soft = _WANTED_FILES if hard == resource.RLIM_INFINITY else min(hard, _WANTED_FILES)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if 0 <= soft < _LEAST_FILES:
        raise BusError(
            f"this process may open {soft} files, the bus needs {_LEAST_FILES}: raise the limit "
            f"(ulimit -n {_WANTED_FILES}, or LimitNOFILE={_WANTED_FILES} in a unit)"
        )


def _open(config: dict[str, Any]) -> Any:
    """Open a session; a client tries again for a while if its router is there but not ready yet."""
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        if config["mode"] != "client" or not any(map(_answers, config["connect"]["endpoints"])):
            raise
    patient = config | {"connect": config["connect"] | {"timeout_ms": _STARTING_MS}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(patient)))


def _explain(config: dict[str, Any], text: str) -> str:
    """Return one line with the cause and a remedy, without the source lines that zenoh adds."""
    detail = " ".join(_SOURCE_PLACE.sub("", text).split())[:200]
    if config["mode"] == "client":
        endpoints = config["connect"]["endpoints"]
        where = ", ".join(endpoint.removeprefix("unixsock-stream/") for endpoint in endpoints)
        for protocol, _, place in (endpoint.partition("/") for endpoint in endpoints):
            if protocol == "unixsock-stream" and reach(Path(place)) is Reach.CLOSED:
                return why_closed(Path(place))
        if any(_answers(endpoint) for endpoint in endpoints):
            return (
                f"no bus at {where}: a router is there but refuses us; check user and password, certificates"
            )
        words = f"no bus at {where}: nothing answers; start `vical run -c FILE` (or vical.target) there"
        return words if detail.startswith("Unable to connect") else f"{words} ({detail})"
    where = ", ".join(config["listen"]["endpoints"])
    return f"cannot host the bus at {where}: is another router running there? ({detail})"


def _answers(endpoint: str) -> bool:
    """Return whether a process accepts connections at an endpoint (tcp, tls or unix socket)."""
    protocol, _, place = endpoint.partition("/")
    try:
        if protocol == "unixsock-stream":
            return reach(Path(place)) is Reach.OPEN
        host, _, port = place.partition("#")[0].rpartition(":")
        if protocol not in ("tcp", "tls") or not port.isdigit():
            return False
        with sockets.create_connection((host.strip("[]"), int(port)), timeout=0.5):
            return True
    except OSError:
        return False
