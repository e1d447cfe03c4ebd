"""A session is opened with enough files, or not at all: zenoh panics where it may open no more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import resource, sys
from vical_daemon.bus.zenoh_bus import BusError, open_bus
soft, hard = int(sys.argv[2]), int(sys.argv[3])
resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
try:
    open_bus(mode="router", socket=sys.argv[1]).close()
except BusError as error:
    print(error)
print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
"""


def limited(tmp_path: Path, soft: int, hard: int) -> list[str]:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "bus"), str(soft), str(hard)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert "panic" not in done.stderr.lower()
    return done.stdout.splitlines()


@pytest.mark.parametrize("soft", [20, 64, 256])
def test_a_low_soft_limit_is_raised_as_far_as_the_hard_one_goes(tmp_path: Path, soft: int) -> None:
    assert limited(tmp_path, soft, 1000) == ["1000"]


def test_a_low_hard_limit_is_one_line_that_says_how_to_raise_it(tmp_path: Path) -> None:
    assert limited(tmp_path, 20, 20) == [
        "this process may open 20 files, the bus needs 64: raise the limit "
        "(ulimit -n 1024, or LimitNOFILE=1024 in a unit)",
        "20",
    ]
