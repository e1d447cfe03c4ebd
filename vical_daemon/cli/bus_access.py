"""How a command comes to the bus: as its host, as a client of the rig's router, or of somebody else's."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from vical_daemon.bus.interface import Bus
from vical_daemon.bus.local_bus import open_local_bus
from vical_daemon.bus.socket_paths import own_socket
from vical_daemon.bus.zenoh_bus import BusError, ZenohBus, open_bus
from vical_daemon.bus.zenoh_commands import CommandJournal
from vical_daemon.config.model import BusConfig, Config, load
from vical_daemon.config.paths import LOOPBACK_PORT, make_private
from vical_daemon.service import notify

_log = logging.getLogger(__name__)
_HOSTS = {"imu", "camera"}
_RETRY_S = 0.5
_QUIET_S = 2.0


class HostedSocket:
    """The socket of the bus that this process hosts: without it nobody can join, also none that restarts.

    It is removed with the folder of a login session that ended (`XDG_RUNTIME_DIR`), or by a cleaner of /tmp.

    Args:
        path: Where it is.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._said = path, False
        self._inode = path.stat().st_ino

    @classmethod
    def of(cls, bus: Bus, config: Config) -> Self | None:
        """Return the socket of a bus that this process hosts; None: it hosts none."""
        return cls(socket_path(config.bus)) if isinstance(bus, ZenohBus) and bus.is_router else None

    def lost(self) -> str:
        """Say that it was removed, or replaced by another process's, and can be made anew; else ""."""
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                return ""
        text = f"the socket of the bus at {self._path} was removed: no process can join"
        try:
            make_private(self._path.parent)
        except OSError as error:
            if not self._said:
                self._said = True
                _log.error("%s; it cannot be made again (%s)", text, error)
            return ""
        return text


def socket_path(bus: BusConfig) -> Path:
    """Where the router of a rig listens."""
    return Path(bus.socket) if bus.socket else own_socket()


def open_for_roles(config: Config, roles: Sequence[str], stop: threading.Event) -> Bus | None:
    """Open the bus for a process with these roles: the one that acquires hosts it, others are clients.

    A client waits for its router as long as it takes (None when stopped meanwhile): services start
    in any order. A process with only one of the acquiring roles hosts the bus unless another one does.

    Raises:
        BusError: The bus cannot be hosted.
    """
    make_private(socket_path(config.bus).parent)
    bus: ZenohBus | None = None
    if _HOSTS & set(roles):
        try:
            bus = _host(config)
            CommandJournal(bus.session)
        except BusError:
            if set(roles) >= _HOSTS:
                raise
            _log.info("the bus is hosted by another process: joining it")
    bus = bus or _wait_for_router(config, stop)
    if bus is not None:
        _log.info("on the bus as zenoh id %s", bus.session.info.zid())  # the journal of commands names it
    if bus is not None and config.ros2 is not None:
        from vical_daemon.bus.zenoh_ros2 import Ros2Publisher

        node = f"{config.rig}_{min(roles, default='vical')}"
        bus.mirror_to(Ros2Publisher(bus.session, node, config.ros2.domain, config.ros2_namespace))
    return bus


def open_client(config_path: str | None, endpoint: str | None) -> Bus:
    """Open the bus for a command that only listens or asks.

    Args:
        config_path: The rig's YAML; None: whatever bus is on this computer.
        endpoint: A router to use instead, e.g. ``tcp/127.0.0.1:7447``.

    Raises:
        BusError: Nobody hosts a bus there, or it is not for this user.
    """
    bus = load(config_path).bus if config_path else BusConfig()
    credentials = _credentials(bus)
    if endpoint:
        return open_bus(mode="client", connect=[endpoint], **credentials)
    sockets = [Path(bus.socket)] if bus.socket else []
    return open_local_bus(sockets, bus.loopback_port if config_path else LOOPBACK_PORT, **credentials)


def _host(config: Config) -> ZenohBus:
    bus = config.bus
    if bus.user and not bus.password_file:
        raise BusError(
            "a router with bus.user asks everybody for a password, its own processes too: "
            "set bus.password_file, with a line for this user (certificates need no password)"
        )
    return open_bus(
        mode="router",
        socket=socket_path(bus),
        tcp_port=bus.loopback_port,
        listen=bus.listen,
        connect=bus.connect,
        password_file=bus.password_file,
        commanders=bus.commanders,
        publishers=bus.publishers,
        **_credentials(bus),
    )


def _wait_for_router(config: Config, stop: threading.Event) -> ZenohBus | None:
    path, begin_s, reported = socket_path(config.bus), time.monotonic(), False
    while not stop.is_set():
        try:
            return open_bus(mode="client", socket=path, **_credentials(config.bus))
        except BusError as error:
            if not reported and time.monotonic() - begin_s > _QUIET_S:  # the host may start at the same time
                _log.info("waiting for the bus: %s", error)
                reported = True
        notify.ready("waiting for the bus")  # or systemd takes a late router for our failure
        notify.watchdog()
        stop.wait(_RETRY_S)
    return None


def _credentials(bus: BusConfig) -> dict[str, Any]:
    return {
        "tls_ca": bus.tls_ca,
        "tls_certificate": bus.tls_certificate,
        "tls_key": bus.tls_key,
        "user": bus.user,
        "password": bus.password,
    }
