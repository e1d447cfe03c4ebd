"""What a process uses."""

from __future__ import annotations

import os
from pathlib import Path


def usage(pid: int) -> tuple[float, int, int]:
    """Return memory (MB), descriptors and threads of a process."""
    process = Path(f"/proc/{pid}")
    pages = int((process / "statm").read_text().split()[1])
    return (
        pages * os.sysconf("SC_PAGE_SIZE") / 2**20,
        len(list((process / "fd").iterdir())),
        len(list((process / "task").iterdir())),
    )
