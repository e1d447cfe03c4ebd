"""YAML with the line number of every value, and without the surprises of YAML 1.1.

PyYAML's resolver reads ``1e-3`` as a string, ``12:30`` as 750 and ``010`` as 8. Here the first is the
number it means, and the other two are refused. Duplicate keys are refused, and so are aliases: a settings
file does not need them, and a hostile one can use them to fill memory. Knows no schema.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from vical_drivers.user_files import read_text

MAX_BYTES = 250_000  # 3 s to parse; a rig of ten cameras with every key takes 20 kB
MAX_DEPTH = 32
_OPENING = (
    yaml.FlowSequenceStartToken,
    yaml.FlowMappingStartToken,
    yaml.BlockSequenceStartToken,
    yaml.BlockMappingStartToken,
)
_CLOSING = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken, yaml.BlockEndToken)
_NUMBER = re.compile(r"[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)([eE][-+]?\d+)?$")
_SEXAGESIMAL = re.compile(r"[-+]?\d+(:[0-5]?\d)+(\.\d*)?$")
_LEADING_ZERO = re.compile(r"[-+]?0\d+$")
_BOOLS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}

Value = None | bool | int | float | str | list["Value"] | dict[str, "Value"]


class ConfigError(Exception):
    """A settings file that cannot be used; the message is one line with path, bound, file and line.

    Args:
        message: The first problem.
        problems: All problems, for `vical check`.
    """

    exit_code = 2

    def __init__(self, message: str, problems: list[str] | None = None) -> None:
        super().__init__(message)
        self.problems = problems or [message]


@dataclass(slots=True)
class Document:
    """A parsed file.

    Attributes:
        name: File name for messages.
        root: Its content.
        lines: Line number (from 1) of every value, by path like ``imus.imu0.rate_hz``.
    """

    name: str
    root: dict[str, Value] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)

    def where(self, path: str) -> str:
        """Return ``vical.yaml line 7`` for a path, or its nearest parent that has a line."""
        while path and path not in self.lines:
            path = path.rpartition(".")[0]
        return f"{self.name} line {self.lines[path]}" if path in self.lines else self.name


def read(path: Path) -> Document:
    """Read a file.

    Raises:
        ConfigError: It is missing, unreadable, too large, not YAML, or not a mapping.
    """
    try:
        text = read_text(path, MAX_BYTES)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file in UTF-8") from None
    return parse(text, path.name)


def parse(text: str, name: str) -> Document:
    """Parse text; `name` is used in messages.

    Raises:
        ConfigError: Not YAML, or YAML that this module refuses.
    """
    document = Document(name)
    text = text.replace("%YAML:1.0", "# %YAML")  # OpenCV's first line, as in OpenVINS's: no directive of YAML
    try:
        refuse_hostile(text, name)
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        value = None if node is None else _convert(node, "", document)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "cannot be read"
        if "'\\t'" in problem:
            problem = "a tab; indent with spaces"
        raise ConfigError(f"{name}{line}: not valid YAML: {problem}") from None
    if value is None:
        value = {}
    if not isinstance(value, dict):
        raise ConfigError(f"{name}: expected `key: value` lines, found {describe(value)}")
    document.root = value
    return document


def refuse_hostile(text: str, name: str) -> None:
    """Refuse hostile YAML by its tokens, before anything is built from them.

    Raises:
        ConfigError: Aliases, or too deep nesting.
        yaml.YAMLError: Not YAML.
    """
    depth = 0
    for token in yaml.scan(text):
        if isinstance(token, yaml.AliasToken):
            raise ConfigError(f"{name}: YAML aliases (*name) are not accepted, repeat the value")
        if isinstance(token, _OPENING):
            depth += 1
        elif isinstance(token, _CLOSING):
            depth -= 1
        if depth > MAX_DEPTH:
            raise ConfigError(f"{name}: nested too deeply")


def describe(value: Value) -> str:
    """Name a value for a message: ``the text 'abc'``, ``a list``, ``a section``, ``nothing``."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a section"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return f"the text {value[:60]!r}" if isinstance(value, str) else f"the number {value:g}"


def _convert(node: yaml.Node, path: str, document: Document) -> Value:
    document.lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        return _convert_mapping(node, path, document)
    if isinstance(node, yaml.SequenceNode):
        return [_convert(item, f"{path}.{i}", document) for i, item in enumerate(node.value)]
    return _convert_scalar(node, path, document)


def _convert_mapping(node: yaml.MappingNode, path: str, document: Document) -> dict[str, Value]:
    result: dict[str, Value] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise ConfigError(f"{document.name} line {line}: a key must be a plain word")
        key = key_node.value
        child = f"{path}.{key}" if path else key
        if key in result:
            raise ConfigError(f"{child}: given twice ({document.name} line {line})")
        document.lines[child] = line
        result[key] = _convert(value_node, child, document)
    return result


def _convert_scalar(node: yaml.Node, path: str, document: Document) -> Value:
    text = str(node.value)
    quoted = getattr(node, "style", None) in ("'", '"', "|", ">")
    if "\0" in text:  # no path, no name
        raise ConfigError(f"{path}: a zero byte is not accepted ({document.where(path)})")
    if quoted:
        return text
    at = f"({document.where(path)})"
    if node.tag not in _PLAIN_TAGS:
        raise ConfigError(f"{path}: the YAML tag {node.tag} is not accepted {at}")
    if _SEXAGESIMAL.match(text):
        raise ConfigError(f"{path}: {text} would be read as base 60; write a plain number or quote it {at}")
    if _LEADING_ZERO.match(text):
        raise ConfigError(f"{path}: {text} would be read as octal; drop the leading zero or quote it {at}")
    if _NUMBER.match(text):
        return _number(text)
    if text.lower() in _BOOLS:
        return _BOOLS[text.lower()]
    if text.lower() in (".inf", "-.inf", "+.inf", ".nan"):
        return math.nan if "nan" in text.lower() else math.copysign(math.inf, -1 if text[0] == "-" else 1)
    return None if text in ("", "~") or text.lower() == "null" else text


_PLAIN_TAGS = frozenset(
    f"tag:yaml.org,2002:{kind}"
    for kind in ("str", "int", "float", "bool", "null", "timestamp", "merge", "value")
)


def _number(text: str) -> int | float:
    digits = text.replace("_", "")
    if digits.lstrip("+-").isdigit() and len(digits) < 20:
        return int(digits)
    return float(digits)
