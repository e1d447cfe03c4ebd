"""Which `Host` headers the page answers to.

A page on the internet may point its own name at 127.0.0.1 and read, through the visitor's browser, whatever
is served there (DNS rebinding). The browser names the page's host in the request: an unknown name is refused.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Iterable

_HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?")


class AllowedHosts:
    """Names and addresses under which the page may be asked for.

    Always allowed: ``localhost``, loopback addresses, this computer's host name (also with ``.local``), and
    the address at which the connection arrived.

    Args:
        more: Further names, from the config.
    """

    def __init__(self, more: Iterable[str] = ()) -> None:
        own = socket.gethostname().lower()
        short = own.split(".")[0]
        self._names = {"localhost", own, short, f"{short}.local", *(name.lower() for name in more)} - {""}

    def allows(self, header: str, arrived_at: str = "") -> bool:
        """Whether a request with this `Host` header is for us; the port does not matter (tunnels change it).

        Args:
            header: As it came.
            arrived_at: Own address of the connection.

        >>> AllowedHosts(["robot7.example"]).allows("robot7.example:8080")
        True
        >>> AllowedHosts().allows("evil.example:8080")
        False
        """
        match = _HOST.fullmatch(header)
        if match is None:
            return False
        name = match["name"].strip("[]").lower().removesuffix(".")
        if name in self._names or name.endswith(".localhost"):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or name == arrived_at.split("%")[0]
