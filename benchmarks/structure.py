"""Size and shape of the code: files, constants, import edges, cycles, size of an install."""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

HERE = Path(__file__).parents[1]
_CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")
_PLAIN = {0.0, 0.5, 1.0, 2.0, 1e3, 1e-3, 1e6, 1e-6, 1e9, 1e-9}  # halves, doubles and changes of unit
_QUANTILES = {"chdtri", "chdtrc", "ndtri", "ndtr"}  # scipy.special: of a chi-square or normal variable


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks structure", description=__doc__)
    parser.add_argument("--tree", type=Path, default=HERE, help="a checkout (default: this one)")
    parser.add_argument("--longest", action="store_true", help="list files over 400 lines, functions over 55")
    args = parser.parse_args(argv)
    daemon = Sources(args.tree / "vical_daemon")
    estimation = Sources(daemon.root / "estimation")
    edges = import_edges(daemon)
    rows = {
        "modules at the root of vical_daemon": len(list(daemon.root.glob("*.py"))),
        "top-level parts": len({part for edge in edges for part in edge}),
        "import edges between parts": len(edges),
        "cycles between parts": len(cycles(edges)),
        "estimation: files": len(estimation.trees),
        "estimation: lines": sum(estimation.lines.values()),
        "estimation: classes": sum(isinstance(n, ast.ClassDef) for n in estimation.nodes()),
        "estimation: named constants": sum(
            1 for tree in estimation.trees.values() for _ in named_constants(tree)
        ),
        "estimation: inline floats": sum(
            1 for tree in estimation.trees.values() for _ in inline_floats(tree)
        ),
        "estimation: calls of chi-square and normal quantiles": sum(map(_is_quantile, estimation.nodes())),
        "longest file, lines": max(daemon.lines.values()),
        "longest function, lines": max(n for n, _ in functions(daemon)),
    }
    if args.tree == HERE:
        count, size_mb = install()
        rows["packages of an install"], rows["size of an install, MB"] = count, round(size_mb)
    print("| | |\n|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value} |")
    if args.longest:
        for path, lines in sorted(daemon.lines.items(), key=lambda item: -item[1]):
            if lines > 400:
                print(f"{lines:5d} {path}")
        for lines, name in sorted(functions(daemon), reverse=True):
            if lines > 55:
                print(f"{lines:5d} {name}")
    return 0


class Sources:
    """The modules below a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        texts = {path.relative_to(root): path.read_text() for path in sorted(root.rglob("*.py"))}
        self.trees = {path: ast.parse(text) for path, text in texts.items()}
        self.lines = {path: len(text.splitlines()) for path, text in texts.items()}

    def nodes(self) -> Iterator[ast.AST]:
        """All nodes of all modules."""
        for tree in self.trees.values():
            yield from ast.walk(tree)


def named_constants(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Names in capitals that a module gives to numbers or to tuples of numbers, and where."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets, value = [node.target], node.value
        else:
            continue
        for target in targets:
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
            for name, number in pairs:
                if isinstance(name, ast.Name) and _CONSTANT.fullmatch(name.id) and _is_number(number):
                    yield name.id, node


def unexplained_constants(tree: ast.Module, text: str) -> Iterator[tuple[str, int]]:
    """Named constants, and their lines, that no comment explains and no docstring below.

    A comment stands on a line of the constant, or above it and what else is assigned right there.
    """
    lines = ["", *text.splitlines(), ""]
    assigned = {node.end_lineno: node for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)}
    for name, node in named_constants(tree):
        first, last = node.lineno, node.end_lineno or node.lineno
        own = "#" in "".join(lines[first : last + 1]) or lines[last + 1].startswith('"""')
        while first - 1 in assigned:
            first = assigned[first - 1].lineno
        if not own and not lines[first - 1].startswith("#"):
            yield name, node.lineno


def _is_number(node: ast.expr) -> bool:
    """Whether an expression is made of numbers alone."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(map(_is_number, node.elts))
    return isinstance(node, ast.Call) and bool(node.args) and all(map(_is_number, node.args))


def inline_floats(tree: ast.Module) -> Iterator[float]:
    """Floats in functions, but for halves, doubles and changes of unit."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for node in ast.walk(function):
                if (
                    isinstance(node, ast.Constant)
                    and isinstance(node.value, float)
                    and node.value not in _PLAIN
                ):
                    yield node.value


def _is_quantile(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _QUANTILES


def functions(sources: Sources) -> list[tuple[int, str]]:
    """Length in lines and name of every function."""
    return [
        ((node.end_lineno or node.lineno) - node.lineno + 1, f"{path}:{node.name}")
        for path, tree in sources.trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]


def import_edges(sources: Sources) -> set[tuple[str, str]]:
    """Which part of the package imports which; imports in functions and for type checking count."""
    edges = set()
    for path, tree in sources.trees.items():
        here = path.parts[0].removesuffix(".py")
        for node in ast.walk(tree):
            names: list[str] = []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
                if node.module == sources.root.name:
                    names = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            for name in names:
                parts = name.split(".")
                if parts[0] == sources.root.name and len(parts) > 1 and parts[1] != here:
                    edges.add((here, parts[1]))
    return edges


def cycles(edges: set[tuple[str, str]]) -> list[str]:
    """Parts that can be reached from themselves."""
    following: dict[str, set[str]] = {}
    for a, b in edges:
        following.setdefault(a, set()).add(b)
    found = []
    for start in following:
        seen: set[str] = set()
        waiting = list(following[start])
        while waiting:
            part = waiting.pop()
            if part not in seen:
                seen.add(part)
                waiting += following.get(part, ())
        if start in seen:
            found.append(start)
    return found


def install() -> tuple[int, float]:
    """How many packages a user's install of vical has besides vical; their size without bytecode, MB."""
    waiting, found = _requires("vical"), {}
    while waiting:
        name = waiting.pop()
        if name not in found:
            files = metadata.files(name) or []
            sizes = [Path(str(f.locate())).stat().st_size for f in files if Path(str(f.locate())).is_file()]
            found[name] = sum(sizes)
            waiting += _requires(name)
    return len(found), sum(found.values()) * 1e-6


def _requires(name: str) -> list[str]:
    """What a package needs on this machine, without its extras."""
    from packaging.requirements import Requirement

    needs = [Requirement(text) for text in metadata.requires(name) or []]
    return [need.name for need in needs if need.marker is None or need.marker.evaluate({"extra": ""})]


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))
