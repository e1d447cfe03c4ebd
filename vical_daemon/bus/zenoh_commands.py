"""Logs every command on the bus, with its sender, in the process that hosts the bus.

The timestamp of a message names the zenoh session that published it. The sender sets this id, so a member of
the group can forge it. The router itself knows the link: kind of socket, address, and the name in a client
certificate (zenoh 1.10 does not report the user of a unix socket or of a password).
"""

from __future__ import annotations

import logging
from typing import Any

from vical_daemon.bus.log_limit import LogLimit
from vical_daemon.bus.messages import MessageError, decode_string
from vical_daemon.bus.topics import parse_key
from vical_daemon.bus.zenoh_rights import COMMANDS

_log = logging.getLogger(__name__)


class CommandJournal:
    """Logs commands, at most 30 lines in 10 s.

    Args:
        session: The session of the router.
    """

    def __init__(self, session: Any) -> None:
        self._session = session
        self._limit = LogLimit(30, 10.0)
        self._subscriber = session.declare_subscriber(COMMANDS, self._take)

    def _take(self, received: Any) -> None:
        more = self._limit.admit()
        if more is None:
            return
        parsed = parse_key(str(received.key_expr))
        payload = received.payload.to_bytes()
        try:
            word = repr(decode_string(payload)[:40])
        except MessageError:
            word = f"{len(payload)} bytes that are not a command"
        to = f"{parsed.rig}/{parsed.name}" if parsed else str(received.key_expr)[:80]
        _log.info("command to %s: %s, from %s%s", to, word, self._origin(received), more)

    def _origin(self, received: Any) -> str:
        if received.timestamp is None:
            return "a session that does not say who it is"
        sender = str(received.timestamp.get_id())
        if sender == str(self._session.info.zid()):
            return f"this process, or a session that does not say who it is (zenoh id {sender})"
        links = [link for link in self._session.info.links() if str(link.zid) == sender]
        if not links:
            return f"zenoh id {sender}, its link is closed by now or leads through another router"
        protocol, _, place = str(links[0].dst).partition("/")
        way = "unix socket" if protocol == "unixsock-stream" else f"{protocol} {place}"
        user = links[0].auth_identifier
        return f"zenoh id {sender}, {way}" + (f", user {user}" if user else "")

    def close(self) -> None:
        """Stop."""
        self._subscriber.undeclare()
