"""Every study starts: its module can be imported, its options are described, and the code it names exists."""

import ast
import importlib
from pathlib import Path

import pytest

from benchmarks.__main__ import studies

ROOT = Path(__file__).resolve().parents[3]
MODULES = sorted((ROOT / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("name", studies())
def test_its_options_are_described(name, capsys):
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"benchmarks.{name}").main(["--help"])
    assert ended.value.code == 0
    assert f"benchmarks {name}" in capsys.readouterr().out


def test_the_code_that_results_depend_on_exists():
    named = [
        argument.value
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "fingerprint"
        for argument in node.args
        if isinstance(argument, ast.Constant)
    ]
    assert len(named) > 20
    assert [path for path in named if not (ROOT / path).exists()] == []
