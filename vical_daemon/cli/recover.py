"""`vical recover LOG`: an unfinished or damaged MCAP made whole."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json

_EPILOG = """\
examples:
  vical recover log.mcap.part -o log.mcap
  vical recover /var/lib/vical/log        all unfinished files of a folder
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument("log", metavar="LOG", help="an .mcap or .mcap.part file, or a folder with parts")
    parser.add_argument("-o", "--output", metavar="OUT", help="name of the repaired file (not for a folder)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Recover one file, or every part in a folder."""
    from vical_daemon.logs.mcap import LogFolder, recover, recover_folder

    path = Path(args.log)
    if path.is_dir():
        if args.output:
            raise CliError("-o is for one file; the parts of a folder keep their names", EXIT_USAGE)
        folder = LogFolder(path)
        if not folder.lock():
            raise CliError(
                f"a recorder is writing into {path}; it recovers parts by itself, or stop it first"
            )
        try:
            done = recover_folder(path)
        finally:
            folder.unlock()
    else:
        done = [recover(path, Path(args.output) if args.output else None)]
    for item in done:
        for warning in item.warnings:
            print(warning, file=sys.stderr)
    if args.json:
        found = [
            {
                "source": str(r.source),
                "output": str(r.output),
                "messages": r.messages,
                "was_complete": r.was_complete,
            }
            for r in done
        ]
        print(json.dumps({"recovered": found}))
    else:
        for item in done:
            what = "complete, nothing to recover: " if item.was_complete else ""
            print(f"{item.output}: {what}{item.messages} messages")
        if not done:
            print("nothing to recover")
    return 0
