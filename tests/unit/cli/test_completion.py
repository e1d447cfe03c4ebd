"""`vical completion`: the script that a shell sources; asked as the shell would."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from vical_daemon.cli import completion, main, table

_ASK = {
    "bash": 'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _vical; '
    'printf "%s\\n" "${COMPREPLY[@]}"',
    # bashcompinit gives the arrays of bash to the function, and `compgen` of its own
    "zsh": 'autoload -U compinit && compinit -u -D; source "$1"; shift; words=("$@"); COMP_WORDS=("$@"); '
    'COMP_CWORD=$(($# - 1)); typeset -a COMPREPLY; _vical; print -rl -- "${COMPREPLY[@]}"',
}


@pytest.fixture(params=completion.SHELLS)
def ask(request, tmp_path, capsys, monkeypatch):
    """What a shell proposes for a command line whose last word is not complete."""
    shell = shutil.which(request.param)
    if shell is None:
        pytest.skip(f"no {request.param} on this computer")
    assert main(["completion", request.param]) == 0
    path = tmp_path / "vical.completion"
    path.write_text(capsys.readouterr().out)
    folder = tmp_path / "here"
    folder.mkdir()
    (folder / "run.mcap").write_bytes(b"")
    (folder / "run two.mcap").write_bytes(b"")
    (folder / "photo.png").write_bytes(b"")
    (folder / "mav0").mkdir()
    (folder / "board.yaml").write_text("target_type: aprilgrid\n")
    (folder / "vical.yaml").write_text("rig: rig0\n")

    def words(*line: str) -> set[str]:
        flags = ["-f"] if request.param == "zsh" else ["--norc", "--noprofile"]
        command = [shell, *flags, "-c", _ASK[request.param], "ask", str(path), "vical", *line]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=True)
        assert not done.stderr
        return set(done.stdout.split("\n")) - {""}

    return words


def test_commands_and_subcommands(ask) -> None:
    assert ask("ca") == {"camera", "calibrate"}
    assert set(table.available()) <= ask("")
    assert ask("imu", "st") == {"stream"}
    assert ask("run", "re") == {"record"}


def test_options_and_their_choices(ask) -> None:
    assert ask("calibrate", "--est") == {"--estimate"}
    assert ask("export", "store", "--format", "k") == {"kalibr"}
    assert ask("imu", "stream", "/dev/x", "--protocol", "m") == {"mip"}
    assert ask("calibrate", "--skip", "") == set()  # a number


def test_what_lies_here(ask) -> None:
    assert ask("calibrate", "") == {"run.mcap", "run two.mcap", "mav0"}
    assert ask("calibrate", "run.mcap", "r") == {"run.mcap", "run two.mcap"}
    assert ask("calibrate", "run.mcap", "--target", "") == {"board.yaml", "mav0"}
    assert ask("run", "-c", "v") == {"vical.yaml"}


def test_every_argument_has_a_kind_that_the_script_knows() -> None:
    known = {"logs", "results", "targets", "configs", "files", "ports", "cameras", "roles", "nothing", ""}
    for command in table.available().values():
        for _, parser in completion._leaves(command):
            kinds = {completion._of_leaf(parser)[1], *(kind for _, kind in completion._with_values(parser))}
            assert all(kind in known or kind.startswith("=") for kind in kinds), (command.name, kinds)


def test_json_holds_the_script(capsys) -> None:
    assert main(["completion", "bash", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"shell": "bash", "script": completion.script("bash")}
    assert Path(__file__).name not in completion.script("bash")
