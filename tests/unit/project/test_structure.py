"""The limits of CONTRIBUTING.md: lengths of files and functions, a root of three modules, no cycle."""

import ast
from pathlib import Path

import pytest

from benchmarks.structure import Sources, cycles, functions, import_edges, inline_floats, named_constants

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("folder", ["vical_daemon", "drivers", "mocks"])
def test_no_file_exceeds_500_lines_and_no_function_60(folder):
    sources = Sources(ROOT / folder)
    assert len(sources.trees) > 40
    assert {str(path): n for path, n in sources.lines.items() if n > 500} == {}
    assert {name: n for n, name in functions(sources) if n > 60} == {}


def test_the_root_has_three_modules_and_the_parts_no_cycle():
    sources = Sources(ROOT / "vical_daemon")
    assert sorted(p.name for p in sources.root.glob("*.py")) == ["__init__.py", "__main__.py", "client.py"]
    edges = import_edges(sources)
    assert ("calibrate", "estimation") in edges
    assert cycles(edges) == []


def test_a_cycle_is_found_wherever_it_is_entered():
    assert sorted(cycles({("a", "b"), ("b", "c"), ("c", "b"), ("d", "a")})) == ["b", "c"]


def test_constants_are_numbers_with_names_in_capitals():
    lines = ["A, _B = 1.0, (2, 3)", "C: float = -float(4)", "D = 'x'", "E = A", "f = 1.0", "def g(x):"]
    tree = ast.parse("\n".join([*lines, "    return 3.7 * x + 0.5 + 1e-9"]))
    assert list(named_constants(tree)) == ["A", "_B", "C"]
    assert list(inline_floats(tree)) == [3.7]
