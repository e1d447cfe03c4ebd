"""Output for terminals and pipes that cannot show every character: never a traceback, always readable."""

from __future__ import annotations

import codecs
import io
import sys

_READABLE = {"±": "+-", "°": " deg", "µ": "u", "×": "x", "→": "->", "…": "...", "·": "-", "–": "-", "—": "-"}
_READABLE |= {"━": "=", "╸": "=", "╺": "=", "─": "-", "│": "|", "•": "*"}  # of progress bars and tables
_HANDLER = "vical.readable"


def readable(error: UnicodeError) -> tuple[str, int]:
    """Replace what an encoding lacks by what stands for it in ASCII, else by a question mark."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_READABLE.get(c, "?") for c in error.object[error.start : error.end]), error.end


def accept_any_encoding() -> None:
    """Make stdout and stderr replace what they cannot encode."""
    codecs.register_error(_HANDLER, readable)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None as a service without output, or somebody's own
            stream.reconfigure(errors=_HANDLER)
