"""Access control of a router that listens on a network, loopback included.

Clients of the unix socket may do everything; file permissions control who can open it. All others may
only subscribe and query, unless named.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

_WRITING = ["put", "delete", "declare_queryable", "reply", "liveliness_token"]
_READING = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
# `**` does not match chunks that begin with @: rmw_zenoh's graph, and the caches of advanced publishers.
_EVERYTHING = ["**", "@ros2_lv/**", "**/@adv/**"]
_NAMES = ("usernames", "cert_common_names")
COMMANDS = "vical/*/command/*"


def access_rules(commanders: Sequence[str] = (), publishers: Sequence[str] = ()) -> dict[str, Any]:
    """Return zenoh's ``access_control`` section; the router drops what no rule allows.

    Args:
        commanders: Users of the password file, or names in client certificates, who may send commands.
        publishers: The same, who may publish and answer queries on every key.
    """

    def allow(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
        return {
            "id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys
        }  # fmt: skip

    rules = [
        allow("sending", "egress", _READING + _WRITING, _EVERYTHING),
        allow("reading", "ingress", _READING, _EVERYTHING),
        allow("writing", "ingress", _WRITING, _EVERYTHING),
        allow("commanding", "ingress", ["put"], [COMMANDS]),
    ]
    subjects: list[dict[str, Any]] = [
        {"id": "everybody"},
        {"id": "unix socket", "link_protocols": ["unixsock-stream"]},
    ]
    policies = [
        {"rules": ["sending", "reading"], "subjects": ["everybody"]},
        {"rules": ["writing", "commanding"], "subjects": ["unix socket"]},
    ]
    for rule, names in (("commanding", commanders), ("writing", publishers)):
        if names:
            named: list[dict[str, Any]] = [{"id": f"{rule}: {kind}", kind: list(names)} for kind in _NAMES]
            subjects += named
            policies.append({"rules": [rule], "subjects": [s["id"] for s in named]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
