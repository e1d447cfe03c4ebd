"""^C while `vical` still loads its modules: the process ends without a traceback."""

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

_PROGRAM = """
import os, signal, sys

class Press:  # ^C at the moment at which a module is looked for
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Press())
{before}
from vical_daemon.__main__ import main
sys.argv = ["vical", *{words!r}]
sys.exit(main())
"""


# a process that a script starts with `&` begins with ^C ignored, and so do its children
_USUAL = "signal.signal(signal.SIGINT, signal.default_int_handler)"


def _run(module: str, words: list[str], before: str = _USUAL) -> subprocess.CompletedProcess[str]:
    program = _PROGRAM.format(module=module, words=words, before=before)
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.parametrize("module", ["vical_daemon.cli", "vical_daemon.cli.table"])
def test_before_the_command_line_is_there(module: str) -> None:
    ended = _run(module, ["--help"])
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, "", "")


def test_while_a_command_is_loaded() -> None:
    ended = _run("vical_daemon.cli.info", ["info", "none.mcap"])
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "vical: interrupted\n")


def test_ignored_as_its_parent_wants() -> None:
    ended = _run("vical_daemon.cli.table", ["--version"], "signal.signal(signal.SIGINT, signal.SIG_IGN)")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("vical ")


def test_the_console_script_is_that_function() -> None:
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"vical": "vical_daemon.__main__:main"}
