"""Why a use case on files cannot go on, and how it reports what is unusual."""

from __future__ import annotations

from collections.abc import Callable

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
