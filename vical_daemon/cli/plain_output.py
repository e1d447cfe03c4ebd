"""Output for terminals and pipes that cannot show every character: never a traceback, always readable."""

from __future__ import annotations

import codecs
import fcntl
import io
import os
import sys

_READABLE = {"±": "+-", "°": " deg", "µ": "u", "×": "x", "→": "->", "…": "...", "·": "-", "–": "-", "—": "-"}
_READABLE |= {"━": "=", "╸": "=", "╺": "=", "─": "-", "│": "|", "•": "*"}  # of progress bars and tables
_HANDLER = "vical.readable"


def readable(error: UnicodeError) -> tuple[str, int]:
    """Replace what an encoding lacks by what stands for it in ASCII, else by a question mark."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_READABLE.get(c, "?") for c in error.object[error.start : error.end]), error.end


def open_closed_streams() -> None:
    """Point standard streams that are closed (``vical … >&-``) at nothing.

    The next file that is opened would take their numbers, and libraries in C print into it. If a script in
    between (of pyenv, or one's own) started this program, that file is the script, which nothing can be
    written to.
    """
    for number in (0, 1, 2):
        try:
            access = fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
        else:
            if number > 0 and access == os.O_RDONLY:
                nothing = os.open(os.devnull, os.O_RDWR)
                os.dup2(nothing, number)
                os.close(nothing)
    sys.stdout = sys.stdout or os.fdopen(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", encoding="utf-8", closefd=False)


def accept_any_encoding() -> None:
    """Make stdout and stderr replace what they cannot encode."""
    codecs.register_error(_HANDLER, readable)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None as a service without output, or somebody's own
            stream.reconfigure(errors=_HANDLER)
