"""A command ends, whatever the threads of libraries still do."""

import subprocess
import sys

PROGRAM = """
import atexit, sys, threading, time
from vical_daemon.cli import main
atexit.register(print, "the interpreter shuts down")
if sys.argv.pop(1) == "busy":
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
sys.exit(main())
"""


def _run(kind: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, kind, *words], capture_output=True, text=True, check=False, timeout=60
    )


def test_no_thread_is_killed_by_an_interpreter_that_shuts_down():
    for kind, words in (("busy", False), ("alone", True)):
        done = _run(kind, "completion", "bash")
        assert done.returncode == 0 and "complete" in done.stdout
        assert ("the interpreter shuts down" in done.stdout) is words


def test_the_exit_code_is_kept():
    assert _run("busy", "info", "nowhere.mcap").returncode == 1
