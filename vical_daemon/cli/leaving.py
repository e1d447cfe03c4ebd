"""The end of a process that has threads of libraries."""

from __future__ import annotations

import logging
import os
import sys
import threading
from contextlib import suppress
from typing import NoReturn


def leave(code: int) -> NoReturn:
    """End the process here: everything is closed, and what the libraries' threads still do is not wanted.

    Threads of zenoh or OpenCV that wait for the interpreter while it shuts down are killed by it in the midst
    of foreign code, which aborts the process ("exception not rethrown") and looks like a crash.
    """
    logging.shutdown()
    with suppress(OSError):  # the terminal may be closed
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def threads_remain() -> bool:
    """Whether threads are alive that the interpreter would kill."""
    return any(thread.daemon for thread in threading.enumerate() if thread is not threading.current_thread())
