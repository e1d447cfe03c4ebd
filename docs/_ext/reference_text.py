"""Text of the reference pages, made from the code: topics, settings, commands, modules. Needs no Sphinx."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import os
import re
import types
import typing
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "vical_daemon": ROOT / "vical_daemon",
    "vical_drivers": ROOT / "drivers" / "vical_drivers",
    "vical_mocks": ROOT / "mocks" / "vical_mocks",
}


def topics_table() -> str:
    """The table of keys."""
    from vical_daemon.bus import topics

    lines = [
        "| key | type | rate | priority | when full | recorded | last kept |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in topics.TOPICS:
        rate = f"{row.rate_hz:g} Hz" if row.rate_hz else "on demand"
        lines.append(
            f"| `{row.pattern}` | {row.type_name} | {rate} | {row.priority} | {row.congestion.lower()} | "
            f"{'yes' if row.recorded else 'no'} | {'yes' if row.keep_last else 'no'} |"
        )
    return "\n".join(lines)


def messages_text() -> str:
    """Definitions of our own messages."""
    from vical_daemon.bus.messages.schemas import DEFINITIONS

    return "\n\n".join(f"### {name}\n\n```text\n{text.rstrip()}\n```" for name, text in DEFINITIONS.items())


def causes_table() -> str:
    """The table of causes."""
    from vical_daemon.estimation.events import Cause
    from vical_daemon.estimation.wording import cause_text

    lines = ["| cause | text |", "|---|---|"]
    lines += [f"| `{cause}` | {cause_text(cause, 1.0)} |" for cause in Cause if cause]
    return "\n".join(lines)


def config_text() -> str:
    """Every setting with type, default, bounds and meaning, from the dataclasses that check it."""
    from vical_daemon.config.model import Config

    return "\n\n".join(_section(Config, "", []))


def _section(kind: type, path: str, done: list[type]) -> list[str]:
    if kind in done:
        return []
    done.append(kind)
    meaning, attributes = _docstring(kind)
    title = f"`{path}`" if path else "Top level"
    lines = [f"## {title}", meaning, "| key | type | default | meaning |\n|---|---|---|---|"]
    below: list[str] = []
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        if field.name == "path" and not path:
            continue
        child = f"{path}.{field.name}" if path else field.name
        text, inner = _type(hints[field.name])
        lines[-1] += f"\n| `{field.name}` | {text} | {_default(field)} | {attributes.get(field.name, '')} |"
        if inner is not None:
            key = f"{child}.NAME" if text.startswith("sections") else child
            below += _section(inner, key, done)
    return ["\n\n".join(lines), *below]


def _docstring(kind: type) -> tuple[str, dict[str, str]]:
    """Split a Google-style docstring into its text and its attributes."""
    text = inspect.getdoc(kind) or ""
    head, _, tail = text.partition("Attributes:")
    attributes: dict[str, str] = {}
    name = ""
    for line in tail.splitlines():
        found = re.match(r"\s{4}(\w+): (.*)", line)
        if found:
            name = found.group(1)
            attributes[name] = found.group(2)
        elif name and line.strip():
            attributes[name] += " " + line.strip()
    return " ".join(head.split()), {k: _plain(v) for k, v in attributes.items()}


def _type(hint: Any) -> tuple[str, type | None]:
    """Describe a type in words; also the dataclass inside it."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        text, inner = _type(arguments[0])
        return f"{text}{_bound(arguments[1])}", inner
    if origin in (typing.Union, types.UnionType):
        text, inner = _type(next(a for a in arguments if a is not type(None)))
        return text, inner
    if origin is typing.Literal:
        return "one of " + ", ".join(f"`{a}`" for a in arguments), None
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"list of {_type(arguments[0])[0]}", None
        return f"list of {len(arguments)}", None
    if origin is dict:
        inner = arguments[1] if dataclasses.is_dataclass(arguments[1]) else None
        return ("sections by name" if inner else "keys and values"), inner
    if dataclasses.is_dataclass(hint):
        return "section", hint
    names = {float: "number", int: "whole number", bool: "true or false", str: "text"}
    return names.get(hint, getattr(hint, "__name__", str(hint))), None


def _bound(bound: Any) -> str:
    parts = []
    low, high, above = (getattr(bound, k, None) for k in ("low", "high", "above"))
    if above is not None:
        parts.append(f"> {above:g}")
    if low is not None:
        parts.append(f"≥ {low:g}")
    if high is not None:
        parts.append(f"≤ {high:g}")
    return f", {' and '.join(parts)}" if parts else ""


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        return "" if field.default is None else f"`{field.default}`"
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
        return "" if dataclasses.is_dataclass(value) or not value else f"`{value}`"
    return "**required**"


def commands_text() -> str:
    """`--help` of every command and subcommand."""
    from vical_daemon import cli
    from vical_daemon.cli import options, table

    os.environ["COLUMNS"] = "96"
    parts = []
    for name, command in table.available().items():
        parser, _ = cli.build_parser(name)
        actions = [a for a in parser._actions if hasattr(a, "choices") and isinstance(a.choices, dict)]
        child = actions[0].choices[name]
        parts.append(f"## vical {name}\n\n{command.summary[0].upper()}{command.summary[1:]}.")
        leaves = [child, *(p for p in options.leaves(child) if p is not child)]
        parts += [f"```text\n{leaf.format_help().rstrip()}\n```" for leaf in leaves]
    return "\n\n".join(parts)


def modules_text() -> str:
    """Every module with its first line and its public names, read without importing anything."""
    parts = []
    for package, folder in PACKAGES.items():
        parts.append(f"## {package}")
        rows = ["| module | content | public names |", "|---|---|---|"]
        for path in sorted(folder.rglob("*.py")):
            rows += _module_row(package, folder, path)
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _module_row(package: str, folder: Path, path: Path) -> list[str]:
    relative = path.relative_to(folder).with_suffix("")
    if path.name.startswith("_") and path.name != "__init__.py":
        return []
    name = ".".join([package, *(p for p in relative.parts if p != "__init__")])
    tree = ast.parse(path.read_text(encoding="utf-8"))
    first = (ast.get_docstring(tree) or "").strip().splitlines()
    kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    public = [n.name for n in tree.body if isinstance(n, kinds) and not n.name.startswith("_")]
    if not first and not public:
        return []
    names = ", ".join(f"`{n}`" for n in public)
    return [f"| `{name}` | {_plain(first[0]) if first else ''} | {names} |"]


def _plain(text: str) -> str:
    """Text of a docstring as Markdown in a table cell."""
    return text.replace("``", "`").replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
