"""Signals that end a process of the daemon, and the promise that it never outlives its parent."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_PR_SET_PDEATHSIG = 1  # prctl(2)


@contextmanager
def stop_signals(hurry: Callable[[int], None], limit_s: int = 0) -> Iterator[threading.Event]:
    """Give an event that SIGTERM, SIGINT and SIGHUP set.

    SIGHUP never hurries: a terminal that closes may send it twice. Where it is ignored (nohup), it stays so.

    Args:
        hurry: Called in the main thread with the number of a second SIGTERM or SIGINT.
        limit_s: The kernel ends the process so long after the first signal, s; 0: never.
    """
    stop = threading.Event()

    def on_signal(number: int, _frame: object) -> None:
        if stop.is_set() and number != signal.SIGHUP:
            hurry(number)
        elif not stop.is_set():
            stop.set()
            signal.alarm(limit_s)

    numbers = [signal.SIGTERM, signal.SIGINT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, on_signal) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def leave_at_once(number: int) -> None:
    """End the process without closing anything: the kernel closes devices, and logs can be recovered."""
    os._exit(128 + number)


def die_with(parent_pid: int) -> bool:
    """Ask the kernel for SIGTERM when the parent ends, whatever ends it.

    The parent may have ended before the kernel was asked; then nobody will ever send the signal.

    Args:
        parent_pid: Who started this process.

    Returns:
        False if the parent has ended already: this process must not go on.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    return os.getppid() == parent_pid
