"""Strict reading of a flat target YAML: every complaint is one line with file, line, key and bound."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from pathlib import Path

import yaml
from vical_drivers.user_files import read_text

MAX_FILE_BYTES = 65_536  # a target file has ten short lines


class TargetError(ValueError):
    """A target file cannot be used; the message is one line for a person.

    Attributes:
        key: The key that is wrong; "" where it is the file as a whole.
        what: What is wrong with it, without file and line.
    """

    def __init__(self, message: str, key: str = "", what: str = "") -> None:
        super().__init__(message)
        self.key, self.what = key, what


@dataclass(frozen=True)
class TargetFile:
    """The scalars of one flat YAML mapping, with the lines they stand on.

    Attributes:
        path: Where they were read from.
        values: Raw text of each value by key.
        lines: Line of each key, from 1.
    """

    path: Path
    values: dict[str, str]
    lines: dict[str, int]

    @classmethod
    def read(cls, path: Path) -> TargetFile:
        """Read `path`.

        Raises:
            TargetError: Missing, unreadable, not YAML, not one flat mapping, or a doubled key.
        """
        return cls.parse(_read_text(path), path)

    @classmethod
    def parse(cls, text: str, path: Path) -> TargetFile:
        """Read the text of a file; `path` is only named in errors.

        Raises:
            TargetError: As `read`.
        """
        node = _compose(path, text)
        if not isinstance(node, yaml.MappingNode):
            raise TargetError(
                f"{path}: no target file: expected lines like 'tagCols: 6'; `vical target` writes one"
            )
        values: dict[str, str] = {}
        lines: dict[str, int] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            key = key_node.value
            if not isinstance(key, str) or not isinstance(value_node, yaml.ScalarNode):
                raise TargetError(
                    f"{path}: line {line}: a list or a block, not a line like 'tagCols: 6'; "
                    "is it a target file?"
                )
            if key in values:
                raise TargetError(f"{path}: {key}: given twice (lines {lines[key]} and {line}); keep one")
            values[key] = value_node.value
            lines[key] = line
        return cls(path, values, lines)

    def error(self, key: str, what: str) -> TargetError:
        """Return a one-line error about `key`."""
        where = f" (line {self.lines[key]})" if key in self.lines else ""
        return TargetError(f"{self.path}: {key}: {what}{where}", key, what)

    def only(self, *known: str) -> None:
        """Refuse keys that are not in `known`, naming the one that may be meant."""
        for key in self.values:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
                raise self.error(key, f"unknown key; {hint}")

    def text(self, key: str) -> str:
        """Return a value as text.

        Raises:
            TargetError: The key is missing or empty.
        """
        value = self.values.get(key, "").strip()
        if not value:
            state = "has no value" if key in self.values else "missing"
            raise self.error(key, f"{state}; see Kalibr's target format or let `vical target` write the file")
        return value

    def number(self, key: str, low: float, high: float, *, unit: str = "", hint: str = "") -> float:
        """Return a number within [low, high]; `1e-3`, which YAML 1.1 calls text, is a number here."""
        text = self.text(key)
        try:
            value = float(text)
        except ValueError:
            raise self.error(key, f"{text!r} is not a number") from None
        if not math.isfinite(value):
            raise self.error(key, f"{text} is not a finite number")
        unit = f" {unit}" if unit else ""
        tail = f"; {hint}" if hint else ""
        if value < low:
            raise self.error(key, f"{text} is below {low:g}{unit}{tail}")
        if value > high:
            raise self.error(key, f"{text} is above {high:g}{unit}{tail}")
        return value

    def integer(self, key: str, low: int, high: int, *, hint: str = "") -> int:
        """Return a whole number within [low, high]."""
        value = self.number(key, low, high, hint=hint)
        if value != int(value):
            raise self.error(key, f"{self.values[key]} is not a whole number")
        return int(value)

    def length(self, key: str, low_m: float, high_m: float) -> float:
        """Return a length in metres; a value that looks like millimetres is named as such."""
        hint = "lengths are in metres"
        try:
            if float(self.text(key)) > high_m:
                hint = f"lengths are in metres: {float(self.text(key)) / 1000:g} if millimetres were meant"
        except ValueError:
            pass  # no number at all: said below
        return self.number(key, low_m, high_m, unit="m", hint=hint)


def _read_text(path: Path) -> str:
    try:
        return read_text(path, MAX_FILE_BYTES)
    except FileNotFoundError:
        raise TargetError(f"{path}: no such file; `vical target` makes a board and its YAML") from None
    except UnicodeDecodeError:
        raise TargetError(f"{path}: not a text file in UTF-8; give the target YAML") from None
    except OSError as error:
        raise TargetError(f"{path}: {error.strerror or error}; give the target YAML") from None


def _compose(path: Path, text: str) -> yaml.Node | None:
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise TargetError(
            f"{path}:{line} is not YAML: {error.problem}; lines look like 'tagCols: 6'"
        ) from None
    except yaml.YAMLError as error:
        first_line = str(error).splitlines()[0]
        raise TargetError(f"{path}: not YAML: {first_line}") from None
