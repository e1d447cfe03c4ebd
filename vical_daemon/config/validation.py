"""Builds dataclasses from a parsed YAML document, and reports all problems at once.

Understands int, float, bool, str, Literal, `X | None`, `tuple[X, ...]`, `tuple[X, Y]`, `dict[str, X]`,
`Annotated[X, Bound(...)]` and nested dataclasses. A field with metadata `hidden` cannot be set in a file.
The error for an unknown key suggests the nearest known one.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from vical_daemon.config.strict_yaml import ConfigError, Document, Value, describe

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Bound:
    """Bounds of a value.

    Attributes:
        low: Smallest allowed number.
        high: Largest allowed number.
        above: The number must be larger than this.
        pattern: Regular expression that the whole text must match.
        hint: Valid values, in words.
    """

    low: float | None = None
    high: float | None = None
    above: float | None = None
    pattern: str | None = None
    hint: str = ""


class _MistakeError(Exception):
    """An invalid value; the message has the path but no line yet."""

    def __init__(self, path: str, text: str) -> None:
        super().__init__(text)
        self.path = path


def build(document: Document, kind: type[T], path: str = "") -> T:
    """Make a dataclass from a document, or from its section at `path` (one top-level key).

    Raises:
        ConfigError: With the first problem as message and all of them in `problems`.
    """
    problems: list[str] = []
    section = document.root[path] if path else document.root
    value = _build_struct(section, kind, path, document, problems)
    if problems:
        raise ConfigError(problems[0], problems)
    assert isinstance(value, kind)
    return value


def mistake(document: Document, path: str, text: str) -> str:
    """Return ``path: text (file line N)``."""
    return f"{path}: {text} ({document.where(path)})" if path else f"{text} ({document.name})"


def _build_struct(value: Value, kind: type[Any], path: str, document: Document, problems: list[str]) -> Any:
    if not isinstance(value, dict):
        problems.append(mistake(document, path, f"expected a section, found {describe(value)}"))
        return None
    hints = get_type_hints(kind, include_extras=True)
    fields = {f.name: f for f in dataclasses.fields(kind) if not f.metadata.get("hidden")}
    arguments: dict[str, Any] = {}
    for key, item in value.items():
        child = f"{path}.{key}" if path else key
        if key not in fields:
            problems.append(mistake(document, child, f"unknown key{_suggest(key, list(fields))}"))
            continue
        before = len(problems)
        built = _build(item, hints[key], child, document, problems)
        if len(problems) == before:
            arguments[key] = built
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in value:
            problems.append(mistake(document, f"{path}.{name}" if path else name, "missing"))
    return kind(**arguments) if not problems else None


def _build(value: Value, hint: Any, path: str, document: Document, problems: list[str]) -> Any:
    try:
        return _convert(value, hint, path, document, problems)
    except _MistakeError as error:
        problems.append(mistake(document, error.path, str(error)))
        return None


def _convert(value: Value, hint: Any, path: str, document: Document, problems: list[str]) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        built = _convert(value, arguments[0], path, document, problems)
        for bound in arguments[1:]:
            if built is not None:
                _check_bound(built, bound, path)
        return built
    if origin in (Union, UnionType):
        if value is None and NoneType in arguments:
            return None
        (inner,) = [a for a in arguments if a is not NoneType]
        return _convert(value, inner, path, document, problems)
    if origin is Literal:
        if value not in arguments or isinstance(value, bool):
            choices = ", ".join(str(a) for a in arguments)
            wrong = "is not" if len(arguments) == 1 else "is none of"
            raise _MistakeError(path, f"{describe(value)} {wrong} {choices}")
        return value
    if origin is tuple:
        return _convert_list(value, arguments, path, document, problems)
    if origin is dict:
        if not isinstance(value, dict):
            raise _MistakeError(path, f"expected a section, found {describe(value)}")
        for key in value:
            _build(key, arguments[0], f"{path}.{key}", document, problems)
        return {k: _build(v, arguments[1], f"{path}.{k}", document, problems) for k, v in value.items()}
    if dataclasses.is_dataclass(hint):
        return _build_struct(value, hint, path, document, problems)  # type: ignore[arg-type]
    return _convert_scalar(value, hint, path)


def _convert_list(
    value: Value, arguments: tuple[Any, ...], path: str, document: Document, problems: list[str]
) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise _MistakeError(path, f"expected a list like [a, b], found {describe(value)}")
    if arguments[-1] is Ellipsis:
        kinds = [arguments[0]] * len(value)
    else:
        kinds = list(arguments)
        if len(value) != len(kinds):
            rows = ": each must be a list like [a, b]" if get_origin(kinds[0]) is tuple else ""
            raise _MistakeError(path, f"expected {len(kinds)} values, found {len(value)}{rows}")
    return tuple(
        _build(v, k, f"{path}.{i}", document, problems)
        for i, (v, k) in enumerate(zip(value, kinds, strict=True))
    )


def _convert_scalar(value: Value, kind: Any, path: str) -> bool | int | float | str:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float and number:
        result = float(value)  # type: ignore[arg-type]
        if not math.isfinite(result):
            raise _MistakeError(path, "must be a finite number")
        return result
    if kind is int and number and float(value).is_integer():  # type: ignore[arg-type]
        return int(value)  # type: ignore[arg-type]
    if kind is bool and isinstance(value, bool):
        return value
    if kind is str and isinstance(value, str):
        return value
    if kind is str and isinstance(value, int | float):
        raise _MistakeError(path, f"expected text, found {describe(value)}; put it in quotes")
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
    raise _MistakeError(path, f"expected {names[kind]}, found {describe(value)}")


def _check_bound(value: Any, bound: Bound, path: str) -> None:
    hint = f"; {bound.hint}" if bound.hint else ""
    if isinstance(value, tuple):
        for item in value:
            _check_bound(item, bound, path)
    elif isinstance(value, str):
        if bound.pattern is not None and not re.fullmatch(bound.pattern, value):
            raise _MistakeError(path, f"{value[:60]!r} is not accepted{hint}")
    elif bound.low is not None and value < bound.low:
        raise _MistakeError(path, f"{value:g} is below {bound.low:g}{hint}")
    elif bound.high is not None and value > bound.high:
        raise _MistakeError(path, f"{value:g} is above {bound.high:g}{hint}")
    elif bound.above is not None and value <= bound.above:
        raise _MistakeError(path, f"{value:g} must be above {bound.above:g}{hint}")


def _suggest(word: str, known: list[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else f" (known: {', '.join(known)})"
