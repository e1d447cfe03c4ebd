"""A share of one core for some processes, by the kernel's control groups (version 2 or 1)."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import TracebackType
from typing import Self

PERIOD_US = 20_000
"""The kernel stops a group until the next period once its quota is used up: short, as a slow core that
computes all the time is not stopped at all."""
_ROOT = Path("/sys/fs/cgroup")


class CpuQuota:
    """A context in which processes can be limited to a share of one core.

    Args:
        share: Of one core; 0: no limit.

    Attributes:
        folders: Of the group; empty where there is none.
        problem: Why there is none.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self.folders: list[Path] = []
        self.problem = ""

    def __enter__(self) -> Self:
        if not self._share:
            return self
        name, quota_us = f"vical-bench-{os.getpid()}", round(self._share * PERIOD_US)
        second = (_ROOT / "cgroup.controllers").exists()
        folder = (_ROOT if second else _ROOT / "cpu") / name
        try:
            folder.mkdir()
            self.folders.append(folder)
            if second:
                (_ROOT / "cgroup.subtree_control").write_text("+cpu")
                (folder / "cpu.max").write_text(f"{quota_us} {PERIOD_US}")
                (folder / "cpu.weight").write_text("10000")
            else:
                (folder / "cpu.cfs_period_us").write_text(str(PERIOD_US))
                (folder / "cpu.cfs_quota_us").write_text(str(quota_us))
                (folder / "cpu.shares").write_text("262144")
        except OSError as error:
            self.problem = f"no control group for CPU time ({error}); run as root on a kernel that has them"
            self._remove()
        return self

    def join(self) -> None:
        """Put the calling process into the group; what it starts belongs to it as well."""
        for folder in self.folders:
            (folder / "cgroup.procs").write_text(str(os.getpid()))
        if self.folders:
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

    def _remove(self) -> None:
        for folder in self.folders:
            for _ in range(50):  # the kernel may not yet have noticed that its processes are gone
                try:
                    folder.rmdir()
                    break
                except OSError:
                    time.sleep(0.1)
        self.folders.clear()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._remove()
