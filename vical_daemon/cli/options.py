"""Options that several commands share, and the parser class that explains a mistake in one line."""

from __future__ import annotations

import argparse
import difflib
import os
import shutil
import sys
import textwrap
from pathlib import Path
from typing import Any, NoReturn

from vical_daemon.cli.errors import EXIT_USAGE, CliError

_WRITTEN = ("output", "out", "report", "yaml")
"""Options, of all commands, that name a file to write."""
RECORDING = "MCAP, ROS 1 or 2 bag, ASL/EuRoC folder, or a folder with a video and an IMU's table"
_REMARK = "   "  # between an example and what is said about it


class HelpFormatter(argparse.HelpFormatter):
    """Wraps descriptions and epilogs at the terminal's width; examples stay as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return textwrap.indent(fit(text, width - len(indent)), indent)


def help_width() -> int:
    """Return the width of help texts, columns, as argparse chooses it."""
    return shutil.get_terminal_size().columns - 2


def fit(text: str, width: int) -> str:
    r"""Wrap text at a width, columns.

    Lines without indent are joined to paragraphs. An indented line is an example: its remark, behind three
    spaces, moves below it where both do not fit.

    >>> print(fit("Two lines\nof text.\n  vical demo   without hardware", 24))
    Two lines of text.
      vical demo
          without hardware
    """
    lines: list[str] = []
    paragraph: list[str] = []
    for line in [*text.splitlines(), ""]:
        if line and not line.startswith(" "):
            paragraph.append(line)
            continue
        lines += textwrap.wrap(" ".join(paragraph), width, break_on_hyphens=False)
        paragraph = []
        example, _, remark = line.strip().partition(_REMARK)
        if len(line) <= width or not remark:
            lines.append(line)
            continue
        lines.append(f"  {example}")
        lines += textwrap.wrap(remark.strip(), width, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines).strip("\n")


class _Once(argparse.Action):
    """Stores a value; of several the last, as argparse does, but not silently."""

    def __call__(
        self,
        _parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Take one value."""
        before = getattr(namespace, self.dest, self.default)
        if option_string and before is not self.default and before != values:
            text = f"{option_string} is given twice: {values} is used, {before} is not"
            print(f"vical: warning: {text}", file=sys.stderr)
        setattr(namespace, self.dest, values)


class VicalParser(argparse.ArgumentParser):
    """An argument parser whose errors are one line and name the help to read."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        for name in (None, "store"):
            self.register("action", name, _Once)

    def error(self, message: str) -> NoReturn:
        """Print one line and exit 2."""
        hint = _nearest_choice(message)
        print(f"{self.prog}: error: {message}{hint} (see `{self.prog} --help`)", file=sys.stderr)
        raise SystemExit(EXIT_USAGE)


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add `--json` to a leaf command; harmless when it is there already."""
    if "--json" not in parser._option_string_actions:
        parser.add_argument(
            "--json",
            action="store_true",
            help="print JSON only on stdout, everything else on stderr",
        )


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Add `--verbose` and `--quiet`, which set the level of the log on stderr."""
    if "--verbose" in parser._option_string_actions or "--quiet" in parser._option_string_actions:
        return
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--verbose", action="store_true", help="log more to stderr")
    group.add_argument("--quiet", action="store_true", help="log errors only, no progress")


def add_config(parser: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Add `-c/--config FILE`, the one YAML file of a rig."""
    parser.add_argument(
        "-c",
        "--config",
        metavar="FILE",
        required=required,
        help="config of the rig (see examples/vical.yaml)",
    )


def check_port(flag: str, port: int | None) -> None:
    """Refuse a TCP port that cannot be one.

    Raises:
        CliError: It lies outside 0 (any free one) to 65535.
    """
    if port is not None and not 0 <= port <= 65535:
        raise CliError(f"{flag} {port}: a port must be 0 to 65535", EXIT_USAGE)


def is_leaf(parser: argparse.ArgumentParser) -> bool:
    """Tell whether a parser has no subcommands of its own."""
    return not any(isinstance(a, argparse._SubParsersAction) for a in parser._actions)


def leaves(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """Return the parsers of all leaf commands below (and including) `parser`."""
    if is_leaf(parser):
        return [parser]
    found: list[argparse.ArgumentParser] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                found += [leaf for leaf in leaves(child) if leaf not in found]
    return found


def suggest(word: str, known: list[str]) -> str:
    """Return `; did you mean X?`, or nothing where no known word is near.

    >>> suggest("calibarte", ["calibrate", "check"])
    '; did you mean calibrate?'
    >>> suggest("nope", ["kalibr", "opencv"])
    ''
    """
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.7)
    return f"; did you mean {near[0]}?" if near else ""


def _nearest_choice(message: str) -> str:
    """Read argparse's "invalid choice: 'x' (choose from 'a', 'b')" and suggest the nearest."""
    if "invalid choice: " not in message or "choose from " not in message:
        return ""
    word = message.split("invalid choice: ")[1].split(" (choose")[0].strip("'\"")
    choices = message.split("choose from ")[1].rstrip(")")
    return suggest(word, [c.strip(" '\"") for c in choices.split(",")])


def warn(line: str) -> None:
    """Print what is unusual, in one line on stderr."""
    print(f"vical: warning: {line}", file=sys.stderr)


def add_sensors(parser: argparse.ArgumentParser) -> None:
    """Add the board, and which camera and IMU of a recording."""
    parser.add_argument(
        "--target",
        metavar="FILE",
        help="target file of the board, Kalibr's format (default: without a board)",
    )
    parser.add_argument(
        "--camera", metavar="NAME", help="use only this camera, by name or topic (default: all)"
    )
    parser.add_argument(
        "--imu", metavar="NAME", help="which IMU, by name or topic, if the recording has several"
    )


def check_outputs(args: argparse.Namespace) -> None:
    """Refuse to write onto a file that the command reads, or two outputs into one file.

    Raises:
        CliError: One is.
    """
    values = {name: value for name, value in vars(args).items() if value}
    written = [Path(values.pop(name)) for name in _WRITTEN if isinstance(values.get(name), str | Path)]
    read = [item for value in values.values() for item in (value if isinstance(value, list) else [value])]
    for path in written:
        for name in (item for item in read if isinstance(item, str | Path)):
            if path.is_file() and Path(name).exists() and path.samefile(name):
                raise CliError(f"{path} is read by this command, and would be replaced", EXIT_USAGE)
    places = [os.path.realpath(path) for path in written if path.is_file() or not path.exists()]
    for place in places:
        if places.count(place) > 1:
            raise CliError(f"{place}: two outputs cannot be written to one file", EXIT_USAGE)


def named(name: str | None) -> tuple[str, ...]:
    """Return the sensors that an option names: one, or none."""
    return (name,) if name else ()


def add_stretch(parser: argparse.ArgumentParser) -> None:
    """Add which part of a recording is used."""
    parser.add_argument(
        "--skip", type=float, default=0.0, metavar="S", help="skip the first S seconds (default 0)"
    )
    parser.add_argument("--seconds", type=float, metavar="S", help="use at most S seconds (after --skip)")
