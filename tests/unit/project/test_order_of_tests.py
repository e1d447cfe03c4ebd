"""The order in which workers of xdist collect and run the files of tests."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import conftest

TESTS = Path(conftest.__file__).parent


def collected(worker: int, *args: str) -> list[str]:
    config = SimpleNamespace(args=list(args), workerinput={"workerid": f"gw{worker}", "workercount": 4})
    conftest.pytest_configure(config)
    return config.args


def test_each_worker_collects_all_files_and_begins_at_another() -> None:
    each = [collected(k, str(TESTS / "unit"), str(TESTS / "unit/project")) for k in range(4)]
    every = {str(file) for file in (TESTS / "unit").rglob("test_*.py")}
    assert all(len(files) == len(every) and set(files) == every for files in each)
    assert len({files[0] for files in each}) == 4


@pytest.mark.parametrize("args", [["tests/unit/test_client.py"], ["tests/unit", "tests/x.py::test_it[a]"]])
def test_files_and_tests_that_are_asked_for_stay_as_they_are(args: list[str]) -> None:
    assert collected(1, *args) == args


def test_files_that_go_first_exist() -> None:
    names = {file.name for file in TESTS.rglob("test_*.py")}
    assert [name for name in conftest.LONGEST_FIRST if name not in names] == []
    assert len(set(conftest.LONGEST_FIRST)) == len(conftest.LONGEST_FIRST)
