"""The `vical` command: one module per subcommand; importing this package imports nothing heavy.

A subcommand is a module `vical_daemon.cli.<name>` with `add_arguments(parser)` and `run(args) -> int`,
listed in `table` with its one line of help. Only the module of the command that was typed is imported.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import textwrap
from collections.abc import Sequence
from importlib import import_module

from vical_daemon.cli import errors, leaving, options, plain_output, table

logging.raiseExceptions = False  # a log that cannot be written (full disk, closed terminal) is no traceback

# The filter's matrices are small: a BLAS thread pool costs more than it gives and makes runs
# depend on the machine. It must be set before numpy is imported.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

_INTRO = "vical calibrates cameras against an IMU while the robot runs, with an uncertainty for every number."
_TEACHING = """\
Start here:
  vical demo                                    compare the estimate with the truth, without hardware
  vical calibrate LOG --target target.yaml      calibrate from your own recording
  vical init                                    write a config from what is plugged in, and check it
  vical run -c vical.yaml                       acquire, stamp, record, calibrate, publish

Every command takes --json (only machine-readable output on stdout) and --help.

Exit codes:
  0   done
  1   a known failure, with one line on stderr
  2   wrong usage or config
  3   done, but not `converged`; `merge`: a recording disagrees
  4   `verify`, `compare`: changed
  5   `verify`: cannot tell; `compare`: not comparable
"""

_SEVERAL = ("inputs", "logs", "sources")
"""Arguments of which a command takes any number."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line (the console script `vical`).

    Args:
        argv: Words after `vical`; None: those of this process.

    Returns:
        The exit code.
    """
    code = _run(list(sys.argv[1:] if argv is None else argv))
    if argv is None and leaving.threads_remain():
        return leaving.leave(code)
    return code


def _run(words: list[str]) -> int:
    """Run one command; its exit code."""
    plain_output.open_closed_streams()
    plain_output.accept_any_encoding()
    try:
        code = _dispatch(words)
        sys.stdout.flush()
    except BrokenPipeError:
        _silence_stdout()
        return errors.EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        print("vical: interrupted", file=sys.stderr)
        return errors.EXIT_INTERRUPTED
    except Exception as error:
        return _report(error)
    return code


def build_parser(selected: str | None) -> tuple[argparse.ArgumentParser, dict[str, table.Command]]:
    """Make the parser; only the module of the `selected` command is imported and adds its arguments."""
    commands = table.available()
    parser = options.VicalParser(prog="vical", description=_INTRO, add_help=False)
    parser.add_argument("-h", "--help", action="store_true", help="show this help")
    parser.add_argument("--version", action="store_true", help="show the version")
    subparsers = parser.add_subparsers(dest="_command", metavar="COMMAND", parser_class=options.VicalParser)
    for name, command in commands.items():
        child = subparsers.add_parser(
            name,
            help=command.summary,
            description=command.summary[0].upper() + command.summary[1:] + ".",
            formatter_class=options.HelpFormatter,
        )
        if name == selected:
            import_module(command.module).add_arguments(child)
            for leaf in options.leaves(child):
                options.add_json(leaf)
                options.add_verbosity(leaf)
    return parser, commands


def help_text(commands: dict[str, table.Command]) -> str:
    """Return the grouped overview that `vical --help` prints."""
    width = options.help_width()
    lines = ["usage: vical COMMAND [options]", "", options.fit(_INTRO, width), ""]
    for group in dict.fromkeys(command.group for command in commands.values()):
        lines.append(f"{group}:")
        for c in commands.values():
            if c.group == group:
                head = f"  {c.name:<16} "
                lines += textwrap.wrap(c.summary, width, initial_indent=head, subsequent_indent=" " * 19)
        lines.append("")
    return "\n".join(lines) + "\n" + options.fit(_TEACHING, width) + "\n"


def _dispatch(words: list[str]) -> int:
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    _refuse_empty(words)
    selected = _selected(words)
    parser, commands = build_parser(selected)
    if selected is not None and selected not in commands:
        meant = table.ELSEWHERE.get(selected)
        hint = f": {meant}" if meant else options.suggest(selected, list(commands))
        raise errors.CliError(f"{selected!r} is not a command{hint} (see `vical --help`)", errors.EXIT_USAGE)
    args, more = parser.parse_known_args(words)
    several = next((value for name in _SEVERAL if isinstance(value := getattr(args, name, None), list)), None)
    if several is not None and not any(word.startswith("-") for word in more):
        several += more  # those behind an option, which argparse leaves over
        more = []
    if more:
        near = _nearest_option(parser, selected, more[0])
        help_of = " ".join(filter(None, ["vical", selected]))
        text = f"{selected or 'vical'}: unexpected argument {more[0]!r}{near} (see `{help_of} --help`)"
        raise errors.CliError(text, errors.EXIT_USAGE)
    if args.version:
        from importlib.metadata import version

        print(f"vical {version('vical')}")
        return 0
    if args._command is None:
        print(help_text(commands), end="", file=sys.stdout if args.help else sys.stderr)
        return 0 if args.help else errors.EXIT_USAGE
    _set_up_logging(args)
    options.check_outputs(args)
    return int(import_module(commands[args._command].module).run(args))


def _refuse_empty(words: list[str]) -> None:
    """Refuse empty words (a variable of the shell is not set): an empty --target would mean no board."""
    for i, word in enumerate(words):
        option, equals, value = word.partition("=")
        if word and not (option.startswith("--") and equals and not value):
            continue
        before = words[i - 1] if i and words[i - 1].startswith("-") else ""
        name = option or before or f"argument {i}"
        raise errors.CliError(f"{name} is empty; is the shell's variable set?", errors.EXIT_USAGE)


def _nearest_option(parser: argparse.ArgumentParser, selected: str | None, word: str) -> str:
    """Suggest an option of the selected command that is spelt like a word it does not take."""
    known = [
        option
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction) and selected in action.choices
        for leaf in options.leaves(action.choices[selected])
        for option in leaf._option_string_actions
    ]
    return options.suggest(word, known) if word.startswith("-") else ""


def _selected(words: list[str]) -> str | None:
    return next((word for word in words if not word.startswith("-")), None)


def _set_up_logging(args: argparse.Namespace) -> None:
    level = logging.DEBUG if args.verbose else logging.ERROR if args.quiet else logging.INFO
    time_of_day = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "  # the journal has its own
    line = f"{time_of_day}%(levelname).1s %(name)s: %(message)s"
    logging.basicConfig(level=level, stream=sys.stderr, format=line, datefmt="%H:%M:%S")
    if not args.verbose:  # libraries talk about themselves at INFO
        for library in ("asyncio", "aiohttp", "rosbags"):
            logging.getLogger(library).setLevel(logging.WARNING)
        logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns of a home that it cannot write to


def _report(error: Exception) -> int:
    """Turn any failure into one line on stderr; a bug also leaves its traceback in a file."""
    line, code = errors.describe(error)
    prefix = "" if line.startswith("internal error") else "error: "
    print(f"vical: {prefix}{line}", file=sys.stderr)
    return code


def _silence_stdout() -> None:
    """Point stdout at nothing, so that the interpreter's last flush does not complain as well."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
