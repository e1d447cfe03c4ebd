"""`python -m benchmarks [NAME [options]]`: run one study, several (`a,b`), or list what there is."""

from __future__ import annotations

import ast
import importlib
import os
import sys
from pathlib import Path

# As `vical` does, before numpy is imported: a pool of BLAS threads doubles the CPU time of small matrices.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")


def studies() -> dict[str, str]:
    """Modules that have a `main`, with the first line of their docstrings (read, not imported)."""
    found: dict[str, str] = {}
    for path in sorted(Path(__file__).parent.glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        if not path.stem.startswith("_") and "main" in functions:
            found[path.stem] = (ast.get_docstring(tree) or "").splitlines()[0]
    return found


def main(argv: list[str]) -> int:
    """Run the named studies; names first, options after the last name go to each of them."""
    known = studies()
    names = [name for name in (argv[0].split(",") if argv else []) if name]
    if not names or names == ["--help"]:
        print("usage: python -m benchmarks NAME[,NAME ...] [options]   (NAME --help: its options)\n")
        for name, line in known.items():
            print(f"  {name:18s} {line}")
        return 0
    for name in names:
        if name not in known:
            print(f"no study {name!r}; there are: {', '.join(known)}", file=sys.stderr)
            return 2
    worst = 0
    for name in names:
        worst = max(worst, int(importlib.import_module(f"benchmarks.{name}").main(argv[1:]) or 0))
    return worst


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
