"""constraints.txt: one resolution for every Python and processor that vical supports, from wheels alone.

    python .ci/constraints.py write     `make constraints`: resolve, keeping the versions that still fit
    python .ci/constraints.py check     part of `make check`: each pair resolves to exactly these versions

Nothing is built or installed. Only versions are written; the index is the one that pip is set up with.
"""

from __future__ import annotations

import functools
import itertools
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILE = ROOT / "constraints.txt"
HEADER = (
    "# Versions that are tested together, for CPython 3.11.0 to 3.14 on x86-64 and aarch64. "
    "Made by `make constraints`.\n"
)
PYTHONS = ("3.11.0", "3.12.0", "3.13.0", "3.14.0")
# glibc 2.28 (2018): older than that of any distribution with Python 3.11; the largest wheels ask for it.
PLATFORMS = ("x86_64-manylinux_2_28", "aarch64-manylinux_2_28")
OFFLINE = re.compile(
    r"error sending request|dns error|failed to lookup|Connect(ion)? (error|refused)|timed out", re.I
)


@functools.cache
def environment() -> dict[str, str]:
    """Same index and certificates as pip; never another Python from the network."""
    env = os.environ | {"UV_PYTHON_DOWNLOADS": "never"}
    command = [sys.executable, "-m", "pip", "config", "list"]
    settings = subprocess.run(command, capture_output=True, text=True).stdout
    for variable, setting in (("UV_DEFAULT_INDEX", "index-url"), ("SSL_CERT_FILE", "cert")):
        if value := re.search(rf"^\S+\.{setting}='(.+)'$", settings, re.M):
            env.setdefault(variable, value[1])
    return env


class UnreachableError(Exception):
    """The index does not answer."""


def compile_with(*options: str) -> str:
    """Resolve pyproject.toml with all its extras; ends the program where that is not possible."""
    command = [str(Path(sys.executable).parent / "uv"), "pip", "compile", "pyproject.toml", "--quiet"]
    command += ["--python", sys.executable, "--all-extras", "--only-binary", ":all:", "--no-annotate"]
    command += ["--no-header", "--no-emit-index-url", *options]
    done = subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True)
    if done.returncode == 0:
        return done.stdout
    if OFFLINE.search(done.stderr):
        raise UnreachableError
    sys.exit(
        f"{done.stderr.strip()}\nconstraints.txt does not hold for {' '.join(options)}; try: make constraints"
    )


def write() -> None:
    """Resolve anew; versions already in the file stay where they fit (`write --upgrade`: the newest)."""
    options = ["--universal", "--python-version", PYTHONS[0], "--fork-strategy", "fewest"]
    compile_with(*options, "--output-file", FILE.name, *sys.argv[2:])
    FILE.write_text(HEADER + FILE.read_text())


def check_pair(pair: tuple[str, str]) -> None:
    """One Python on one platform has wheels of exactly the versions in the file."""
    allowed = set(re.findall(r"^[^#;\s]+", FILE.read_text(), re.M))
    options = ["--python-version", pair[0], "--python-platform", pair[1], "--constraint", FILE.name]
    if missing := " ".join(sorted(set(compile_with(*options).split()) - allowed)):
        sys.exit(f"constraints.txt lacks {missing} ({', '.join(pair)}); try: make constraints")


def check() -> None:
    """Check each pair."""
    with ThreadPoolExecutor(4) as pool:  # it waits for the index most of the time
        list(pool.map(check_pair, itertools.product(PYTHONS, PLATFORMS)))
    print(f"constraints.txt holds: {len(PYTHONS)} Pythons on {len(PLATFORMS)} platforms, wheels only")


if __name__ == "__main__":
    try:
        {"write": write, "check": check}[sys.argv[1]]()
    except UnreachableError:
        print("constraints.txt: skipped, the package index cannot be reached")
