"""The processes of `vical run` without a name, as children of a terminal."""

from __future__ import annotations

import logging
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vical_daemon.cli.errors import CliError

_log = logging.getLogger(__name__)
STOP_S = 45  # longer than the roles of any process may take together, see `process_sets.PATIENCE_S`
_HURRIED_STOP_S = 2.0  # enough to close a log on a disk that is not busy
_SETTLED_S = 10.0  # what fails sooner has a wrong config or a port that is taken: again would not help
_PAUSE_S = 0.5  # RestartSec= of the units
_AGAIN_S = 10.0  # between attempts of a process that ran before and does not start any more
_POLL_S = 0.05


@dataclass(slots=True)
class _Child:
    process: subprocess.Popen[bytes] | None  # None: it failed to start again
    since_s: float  # of the start, or of the failure, CLOCK_MONOTONIC
    again: bool = False  # it ran before


class Children:
    """Starts each process, starts it again when it ends, and ends all of them.

    Args:
        command: Gives the words that start a process, by its name.
        settled_s: A child that ends sooner when it is started first ends all.
        again_s: One that ends as soon when it is started again is tried after this time; the others go on.
    """

    def __init__(
        self,
        command: Callable[[str], Sequence[str]],
        settled_s: float = _SETTLED_S,
        again_s: float = _AGAIN_S,
    ) -> None:
        self._command, self._settled_s, self._again_s = command, settled_s, again_s
        self._children: dict[str, _Child] = {}

    def start(self, name: str) -> int:
        """Start a process in a session of its own: ^C in the terminal reaches the parent alone.

        Returns:
            Its process id.
        """
        process = subprocess.Popen(self._command(name), start_new_session=True)
        self._children[name] = _Child(process, time.monotonic(), again=name in self._children)
        return process.pid

    def tend(self, stop: threading.Event) -> None:
        """Start again what has ended.

        Raises:
            CliError: A child failed soon after its start.
        """
        for name, child in self._children.items():
            code = child.process.poll() if child.process is not None else 0
            if code is None or stop.is_set():
                continue
            age_s = time.monotonic() - child.since_s
            if child.process is None:
                if age_s > self._again_s:
                    self.start(name)
                continue
            how = f"ended with code {code}" if code >= 0 else f"was killed by {signal.Signals(-code).name}"
            if age_s >= self._settled_s:
                _log.warning("process %s %s: starting it again", name, how)
                if not stop.wait(_PAUSE_S):
                    self.start(name)
            elif child.again:
                later = "it is tried again every %g s, the others go on"
                _log.error("process %s %s soon after its start: " + later, name, how, self._again_s)
                child.process, child.since_s = None, time.monotonic()
            else:
                raise CliError(f"process {name} {how}; see its messages above")

    def stop(self, hurry: threading.Event) -> None:
        """End all, consumers last to first started: acquire, which hosts the bus, goes last.

        Args:
            hurry: When set, nobody waits for anybody: all are asked at once, and killed after 2 s.
        """
        processes = [child.process for child in self._children.values() if child.process is not None]
        for process in reversed(processes):
            if not hurry.is_set():
                process.terminate()
                _wait(process, time.monotonic() + STOP_S, hurry)
        left = [process for process in processes if process.poll() is None]
        for process in left:
            process.terminate()
        end_s = time.monotonic() + _HURRIED_STOP_S
        for process in left:
            if not _wait(process, end_s):
                process.kill()
                process.wait()


def _wait(process: subprocess.Popen[bytes], end_s: float, hurry: threading.Event | None = None) -> bool:
    """Wait until a process has ended, `end_s` (CLOCK_MONOTONIC) has come or `hurry` is set; True: ended."""
    while process.poll() is None:
        if time.monotonic() > end_s or (hurry is not None and hurry.is_set()):
            return False
        time.sleep(_POLL_S)
    return True
