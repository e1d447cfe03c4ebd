"""The limits of CONTRIBUTING.md: lengths of files and functions, a root of three modules, no cycle."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from benchmarks.structure import (
    Sources,
    cycles,
    functions,
    import_edges,
    inline_floats,
    named_constants,
    unexplained_constants,
)

ROOT = Path(__file__).parents[3]


@cache
def sources_of(folder):
    return Sources(ROOT / folder)


@pytest.mark.parametrize("folder", ["vical_daemon", "drivers", "mocks"])
def test_no_file_exceeds_500_lines_and_no_function_60(folder):
    sources = sources_of(folder)
    assert len(sources.trees) > 40
    assert {str(path): n for path, n in sources.lines.items() if n > 500} == {}
    assert {name: n for n, name in functions(sources) if n > 60} == {}


def test_the_root_has_three_modules_and_the_parts_no_cycle():
    sources = sources_of("vical_daemon")
    assert sorted(p.name for p in sources.root.glob("*.py")) == ["__init__.py", "__main__.py", "client.py"]
    edges = import_edges(sources)
    assert ("calibrate", "estimation") in edges
    assert cycles(edges) == []


OFTEN_STARTED = (
    "estimation.calibrator",
    "estimation.target_free_rig",
    "offline.compare",
    "calibrate.verify_role",
    "web.role",
)


def test_what_starts_often_loads_no_part_of_scipy_that_takes_long():
    """Of CPU time `scipy.signal` takes 0.5 s, `stats` 0.4 s, `optimize` 0.15 s, `spatial` 0.07 s and more."""
    slow = {f"scipy.{part}" for part in ("signal", "stats", "interpolate", "optimize", "spatial")}
    code = f"import sys\nfor name in {OFTEN_STARTED!r}:\n"
    code += "    __import__(f'vical_daemon.{name}')\n"
    code += f"    print(*(f'{{name}}:{{x}}' for x in {slow!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_cycle_is_found_wherever_it_is_entered():
    assert sorted(cycles({("a", "b"), ("b", "c"), ("c", "b"), ("d", "a")})) == ["b", "c"]


def test_constants_are_numbers_with_names_in_capitals():
    lines = ["A, _B = 1.0, (2, 3)", "C: float = -float(4)", "D = 'x'", "E = A", "f = 1.0", "def g(x):"]
    tree = ast.parse("\n".join([*lines, "    return 3.7 * x + 0.5 + 1e-9"]))
    assert [name for name, _ in named_constants(tree)] == ["A", "_B", "C"]
    assert list(inline_floats(tree)) == [3.7]


@pytest.mark.parametrize("folder", ["vical_daemon/estimation", "vical_daemon/vision"])
def test_each_number_with_a_name_says_what_it_is(folder):
    """CONTRIBUTING.md: every number has a unit and a source."""
    sources = sources_of(folder)
    missing = [
        f"{path}:{line} {name}"
        for path, tree in sources.trees.items()
        for name, line in unexplained_constants(tree, (sources.root / path).read_text())
    ]
    assert missing == []
