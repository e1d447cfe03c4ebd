"""The frame of the command line: help without imports, one-line errors, exit codes, pipes."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import pytest
from vical_drivers.errors import DeviceNotFoundError

import vical_daemon.cli as cli
from vical_daemon.cli import options, table
from vical_daemon.cli.errors import CliError, describe_known

HEAVY = (
    "numpy",
    "scipy",
    "cv2",
    "zenoh",
    "rosbags",
    "mcap",
    "foxglove",
    "matplotlib",
    "rich",
    "aiohttp",
    "yaml",
)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch):
    """Install a subcommand `probe` whose run() does what the test says."""

    def install(run, add_arguments=lambda parser: None) -> None:
        entry = table.Command("probe", "Tests", "for this test only")
        module = types.ModuleType(entry.module)
        module.run, module.add_arguments = run, add_arguments
        monkeypatch.setitem(sys.modules, entry.module, module)
        monkeypatch.setattr(table, "available", lambda: {"probe": entry})

    return install


def _raiser(error: BaseException):
    def run(args: argparse.Namespace) -> int:
        raise error

    return run


def test_help_lists_only_present_commands_and_needs_no_heavy_import() -> None:
    code = (
        "import sys, json; from vical_daemon.cli import main; rc = main(['--help']);"
        f"print(json.dumps([rc, [m for m in {HEAVY!r} if m in sys.modules]]), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stderr) == [0, []]
    for name in table.available():
        assert f"  {name} " in done.stdout
    assert "vical demo" in done.stdout


def test_no_command_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    out, err = capsys.readouterr()
    assert out == "" and "usage: vical COMMAND" in err


def test_unknown_command_names_the_nearest(command, capsys: pytest.CaptureFixture[str]) -> None:
    command(lambda args: 0)
    assert cli.main(["prob"]) == 2
    err = capsys.readouterr().err
    assert "did you mean probe?" in err and err.count("\n") == 1


@pytest.mark.parametrize("word", table.ELSEWHERE)
def test_words_of_other_programs_lead_to_ours(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    """`vical start` was asked whether it meant target."""
    assert cli.main([word]) == 2
    err = capsys.readouterr().err
    assert f"vical: error: '{word}' is not a command: {table.ELSEWHERE[word]}" in err
    for named in re.findall(r"`vical (\w+)", err):
        assert named in table.available()


def test_help_is_a_command_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["help"]) == 0
    assert "First steps:" in capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        cli.main(["help", "target"])
    assert left.value.code == 0
    assert "usage: vical target" in capsys.readouterr().out


def test_every_leaf_takes_json_even_if_the_module_forgot(command) -> None:
    def nested(parser: argparse.ArgumentParser) -> None:
        subparsers = parser.add_subparsers(dest="what", required=True)
        for name in ("one", "two"):
            options.add_json(subparsers.add_parser(name))

    seen = []
    command(lambda args: seen.append((args.what, args.json)) or 0, nested)
    assert cli.main(["probe", "two", "--json"]) == 0
    assert seen == [("two", True)]
    command(lambda args: seen.append(args.json) or 3)
    assert cli.main(["probe", "--json"]) == 3
    assert seen[-1] is True


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (CliError("no such board", 2), 2, "no such board"),
        (CliError("two\nlines"), 1, "two lines"),
        (DeviceNotFoundError("/dev/ttyX: nothing there"), 1, "/dev/ttyX: nothing there"),
        (
            FileNotFoundError(2, "No such file or directory", "log.mcap"),
            1,
            "log.mcap: No such file or directory",
        ),
    ],
)
def test_known_errors_are_one_line(command, capsys, error, code, line) -> None:
    command(_raiser(error))
    assert cli.main(["probe"]) == code
    assert capsys.readouterr().err == f"vical: error: {line}\n"


def test_a_bug_leaves_its_traceback_in_a_file(command, capsys, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("LOGS_DIRECTORY", raising=False)
    command(_raiser(KeyError("gyro")))
    assert cli.main(["probe"]) == 1
    err = capsys.readouterr().err
    (log,) = (tmp_path / "vical").iterdir()
    assert err.count("\n") == 1 and "Traceback" not in err and str(log) in err
    assert "Traceback" in log.read_text() and "KeyError" in log.read_text()


def test_bad_option_is_one_line_with_the_help_to_read(command, capsys) -> None:
    command(lambda args: 0, lambda parser: parser.add_argument("--rate", type=int))
    with pytest.raises(SystemExit) as stop:
        cli.main(["probe", "--rate", "fast"])
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "vical probe --help" in err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["x"], "probe: unexpected argument 'x' (see `vical probe --help`)"),
        (["--targt", "x"], "probe: unexpected argument '--targt'; did you mean --target?"),
        (["--target", ""], "--target is empty; is the shell's variable set?"),
        (["--target="], "--target is empty; is the shell's variable set?"),
        ([""], "argument 1 is empty; is the shell's variable set?"),
    ],
)
def test_an_argument_too_many_is_named_with_the_help_of_its_command(command, capsys, words, line) -> None:
    command(lambda args: 0, lambda parser: parser.add_argument("--target"))
    assert cli.main(["probe", *words]) == 2
    err = capsys.readouterr().err
    assert line in err and err.count("\n") == 1


def test_wrong_choice_suggests_the_nearest(command, capsys) -> None:
    command(lambda args: 0, lambda parser: parser.add_argument("--format", choices=["kalibr", "ros"]))
    with pytest.raises(SystemExit):
        cli.main(["probe", "--format", "kalbir"])
    assert "did you mean kalibr?" in capsys.readouterr().err


def test_interrupt_exits_130(command, capsys) -> None:
    command(_raiser(KeyboardInterrupt()))
    assert cli.main(["probe"]) == 130


def test_broken_pipe_is_quiet() -> None:
    code = (
        "import sys, types; import vical_daemon.cli as cli; from vical_daemon.cli import table;"
        "m = types.ModuleType('vical_daemon.cli.probe'); m.add_arguments = lambda p: None;"
        "m.run = lambda a: [print('x' * 1000) for _ in range(10000)] and 0;"
        "sys.modules[m.__name__] = m;"
        "table.available = lambda: {'probe': table.Command('probe', 'T', 's')}; sys.exit(cli.main(['probe']))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.read(10)
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert process.wait(20) == 141 and err == b""


def test_a_bug_is_not_described_as_known() -> None:
    assert describe_known(ValueError("x")) is None
    assert describe_known(OSError("no file named")) is None


def test_table_names_are_unique_and_each_module_keeps_the_convention() -> None:
    names = [c.name for c in table.COMMANDS]
    assert len(names) == len(set(names))
    for name in table.available():
        _, commands = cli.build_parser(name)
        module = sys.modules[commands[name].module]
        assert callable(module.add_arguments) and callable(module.run)
    assert all(c.summary and "\n" not in c.summary for c in table.COMMANDS)


@pytest.mark.parametrize("journal", [False, True])
def test_log_lines_carry_the_time_where_no_journal_adds_it(journal: bool) -> None:
    code = (
        "import argparse, logging, vical_daemon.cli as cli;"
        "cli._set_up_logging(argparse.Namespace(verbose=False, quiet=False));"
        "logging.getLogger('vical_daemon.x').info('hello')"
    )
    environment = {k: v for k, v in os.environ.items() if k != "JOURNAL_STREAM"}
    environment |= {"JOURNAL_STREAM": "8:1234"} if journal else {}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    expected = "I vical_daemon.x: hello" if journal else r"\d\d:\d\d:\d\d I vical_daemon.x: hello"
    assert re.fullmatch(expected, done.stderr.strip())


@pytest.mark.parametrize("columns", [60, 80, 120])
@pytest.mark.parametrize("name", [None, *table.COMMANDS], ids=lambda c: c.name if c else "vical")
def test_help_fits_the_terminal(
    name: table.Command | None,
    columns: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    words = [name.name] if name else []
    with contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
    lines = capsys.readouterr().out.splitlines()
    lines = lines[lines.index("") :]  # argparse breaks no line of the usage within a group
    assert len(lines) > 5
    too_long = [line for line in lines if len(line) > columns]
    assert all(line.startswith("  vical ") for line in too_long), too_long  # examples, to be copied


def test_an_option_given_twice_is_not_taken_silently(capsys):
    """Kalibr's camchain and imu.yaml are two files, and people name two cameras: only the last counted."""
    words = ["calibrate", "no_such.mcap", "--camera", "cam0", "--initial", "camchain.yaml"]
    assert cli.main([*words, "--initial", "imu.yaml", "--camera", "cam0"]) == 2
    first, last = capsys.readouterr().err.splitlines()
    assert first == "vical: warning: --initial is given twice: imu.yaml is used, camchain.yaml is not"
    assert "imu.yaml: no such file" in last
