"""`vical target`: a board to print, to scale, and its target YAML."""

from __future__ import annotations

import argparse
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_json
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.vision.target import Target

_OPTIONS: dict[str, dict[str, Any]] = {
    "aprilgrid": {"tag_cols": 6, "tag_rows": 6, "tag_size": None, "tag_spacing": 0.3},
    "checkerboard": {"cols": 8, "rows": 7, "square": None},
}
"""Options of each kind of board with their defaults."""
_FLAGS = {
    "tagCols": "--tag-cols",
    "tagRows": "--tag-rows",
    "tagSize": "--tag-size",
    "tagSpacing": "--tag-spacing",
    "targetCols": "--cols",
    "targetRows": "--rows",
    "rowSpacingMeters": "--square",
    "colSpacingMeters": "--square",
}
"""The option behind each key of a target file."""

EPILOG = """examples:
  vical target --type aprilgrid -o board.pdf                      6 x 6 tags, as large as A4 takes
  vical target --type aprilgrid --paper a0 --tag-size 88mm -o board.pdf
  vical target --type checkerboard --cols 8 --rows 7 --square 30mm -o board.svg
  vical target --from board.yaml -o board.pdf                     print an existing target file

Print at 100 %, measure the printed ruler, and correct the target file if it is off."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.epilog = EPILOG
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--type", choices=("aprilgrid", "checkerboard"), help="kind of board")
    what.add_argument(
        "--from", dest="source", type=Path, metavar="FILE", help="draw the board of an existing target file"
    )
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FILE", help="file to print, .pdf or .svg"
    )
    parser.add_argument(
        "--yaml", type=Path, metavar="FILE", help="target file to write (default: next to the board)"
    )
    parser.add_argument(
        "--force", action="store_true", help="overwrite an existing target file with other contents"
    )
    parser.add_argument(
        "--paper", default="a4", help="a5 ... a0, letter, legal, tabloid or WxH in mm (default a4)"
    )
    grid = parser.add_argument_group("aprilgrid")
    grid.add_argument("--tag-cols", type=int, metavar="N", help="tags along x (default 6)")
    grid.add_argument("--tag-rows", type=int, metavar="N", help="tags along y (default 6)")
    grid.add_argument(
        "--tag-size",
        metavar="LENGTH",
        help="edge of a tag, in m, or with a unit: 30mm (default: as large as fits)",
    )
    grid.add_argument(
        "--tag-spacing", type=float, metavar="X", help="gap between tags over tag size (default 0.3)"
    )
    squares = parser.add_argument_group("checkerboard")
    squares.add_argument("--cols", type=int, metavar="N", help="inner corners along x (default 8)")
    squares.add_argument("--rows", type=int, metavar="N", help="inner corners along y (default 7)")
    squares.add_argument(
        "--square",
        metavar="LENGTH",
        help="edge of a square, in m, or with a unit: 30mm (default: as large as fits)",
    )
    add_json(parser)


@dataclass(frozen=True, slots=True)
class Made:
    """A board that was written.

    Attributes:
        target: It.
        size_mm: Width and height of the page, mm.
        yaml_path: Where its target file is.
        description: One line for a person.
    """

    target: Target
    size_mm: tuple[float, float]
    yaml_path: Path
    description: str


def run(args: argparse.Namespace) -> int:
    """Write the board and its YAML."""
    _report(args, make(args))
    return 0


def make(args: argparse.Namespace) -> Made:
    """Write the board and its YAML, and print nothing.

    Raises:
        CliError: The board does not fit, or a file cannot or must not be written.
    """
    from vical_daemon.vision.board_sheet import SheetError, describe, lay_out
    from vical_daemon.vision.sheet_files import to_pdf, to_svg
    from vical_daemon.vision.target import TargetError

    kind = args.out.suffix.lower()
    if kind not in (".pdf", ".svg"):
        raise CliError(f"-o {args.out}: the name must end in .pdf or .svg", exit_code=2)
    yaml_path = args.yaml or args.out.with_suffix(".yaml")
    try:
        target = _target(args)
        sheet = lay_out(target, args.paper)
    except (SheetError, TargetError) as error:
        raise CliError(str(error), exit_code=2) from None
    write_yaml = _must_write(args, yaml_path, target)
    try:
        if kind == ".pdf":
            write_output(args.out, to_pdf(sheet, describe(target)))
        else:
            write_output(args.out, to_svg(sheet))
        if write_yaml:
            write_output(yaml_path, target.to_yaml())
    except OSError as error:
        raise CliError(f"{error.filename or args.out}: cannot be written ({error.strerror})") from None
    return Made(target, sheet.size_mm, yaml_path, describe(target).removeprefix("vical "))


def _must_write(args: argparse.Namespace, yaml_path: Path, target: Target) -> bool:
    """Tell whether the YAML must be written; False: it holds this target already, perhaps with notes.

    Raises:
        CliError: It says something else, and nobody said --force.
    """
    from vical_daemon.vision.target import TargetError, load_target

    if not yaml_path.exists():
        return True
    if args.source is not None and os.path.realpath(yaml_path) == os.path.realpath(args.source):
        return False
    with suppress(TargetError):
        if load_target(yaml_path) == target:
            return False
    if not args.force:
        raise CliError(
            f"{yaml_path} exists with other contents (measured sizes?); choose another name "
            "with -o or --yaml, print it with --from, or overwrite it with --force"
        )
    return True


def _target(args: argparse.Namespace) -> Target:
    from vical_daemon.vision.board_sheet import largest_on
    from vical_daemon.vision.target import AprilGrid, Checkerboard, load_target

    given = _options(args)
    if args.source is not None:
        return load_target(args.source)
    wanted = given.pop("tag_size" if args.type == "aprilgrid" else "square")
    size = parse_length_m(wanted) if wanted is not None else 0.02
    board: Target
    if args.type == "aprilgrid":
        board = AprilGrid(given["tag_cols"], given["tag_rows"], size, given["tag_spacing"])
    else:
        board = Checkerboard(given["cols"], given["rows"], size, size)
    _check(board)
    return board if wanted is not None else largest_on(board, args.paper)


def _options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options of the kind of board that is made.

    Raises:
        CliError: One of the other kind was given: ignoring it would print another board than was asked for.
    """
    for kind, options in _OPTIONS.items():
        for name in options:
            if getattr(args, name) is not None and kind != args.type:
                flag, ours = f"--{name.replace('_', '-')}", _OPTIONS.get(args.type, {})
                hint = f"; its options: {', '.join('--' + o.replace('_', '-') for o in ours)}" if ours else ""
                what = args.type or "a board from a file"
                raise CliError(f"{flag} is for {kind}, not for {what}{hint}", exit_code=2)
    defaults = _OPTIONS.get(args.type, {})
    return {k: v if getattr(args, k) is None else getattr(args, k) for k, v in defaults.items()}


def _check(board: Target) -> None:
    """Refuse what the target file's reader would refuse, with the same words but for the option's name."""
    from vical_daemon.vision.target import TargetError, parse_target

    try:
        parse_target(board.to_yaml(), Path("board"))
    except TargetError as error:
        raise CliError(
            f"{_FLAGS[error.key]}: {error.what}" if error.key else str(error), exit_code=2
        ) from None


def parse_length_m(text: str) -> float:
    """Read "0.03", "30mm" or "3cm" as metres.

    >>> parse_length_m("30mm")
    0.03
    """
    number, scale = text.strip().lower(), 1.0
    for unit, factor in (("mm", 1e-3), ("cm", 1e-2), ("m", 1.0)):
        if number.endswith(unit):
            number, scale = number.removesuffix(unit), factor
            break
    try:
        return round(float(number) * scale, 9)
    except ValueError:
        raise CliError(f"length {text!r}: give metres, or a number with mm or cm", exit_code=2) from None


def _report(args: argparse.Namespace, made: Made) -> None:
    width, height = made.size_mm
    if args.json:
        row = {
            "board": str(args.out),
            "yaml": str(made.yaml_path),
            "kind": made.target.kind,
            "points": len(made.target.points_m),
            "page_mm": [width, height],
        }
        print(json.dumps(row))
        return
    print(f"{args.out}: {made.description}, page {width:g} x {height:g} mm")
    print(f"{made.yaml_path}: target file for --target")
    print(
        "Print at 100 %, glue it to something flat, measure the ruler. Correct the target file if it is off."
    )
