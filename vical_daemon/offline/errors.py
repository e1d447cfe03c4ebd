"""Why a use case on files cannot go on, and how it reports what is unusual."""

from __future__ import annotations

from collections.abc import Callable

from vical_daemon.logs import Stream

Warn = Callable[[str], None]
"""Takes one line for a person about input that is unusual; the work goes on."""


class InputError(Exception):
    """The input cannot be used; the message is one line: what, where, what to try."""

    exit_code = 1


class OptionError(InputError):
    """An option is missing, or does not fit the input."""

    exit_code = 2


def ignore(line: str) -> None:
    """Take a warning, and do nothing."""


def size_unknown(stream: Stream) -> str:
    """Say why the image size is not known, and what to do."""
    give = f"with --initial and a file with `{stream.name}: {{resolution: [width, height]}}`"
    if stream.kind == "compressed":
        return (
            "its first image is no JPEG, PNG, PGM, PPM or BMP, or is damaged: convert it (video like H.264 "
            f"is not read), or give its size {give}"
        )
    return f"the image size is not in the recording: give it {give}"
