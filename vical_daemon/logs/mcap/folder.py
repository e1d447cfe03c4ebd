"""The folder of a recorder: one writer at a time, quota, reserve, and recovery after a crash."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import shutil
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from vical_daemon.logs.mcap.files import LogError, describe
from vical_daemon.logs.mcap.recover import Recovery, recover_folder
from vical_daemon.service.atomic_file import atomic_write, why_refused

_LOCK, _RUNS = ".recorder.lock", ".recorder.runs"
# Only files of this form are ever deleted: rig_YYYYmmddTHHMMSSZ_run_segment.mcap
_OURS = re.compile(r"[A-Za-z]\w*_(\d{8}T\d{6}Z)_([0-9a-f]{6})_(\d{4,})(\.recovered)?\.mcap(\.part)?")


class LogFolder:
    """A folder of segments ``rig_20261121T022842Z_ab12cd_0000.mcap``.

    The lock lives in the kernel: it goes away with the process that holds it, however that ends, and
    a second recorder that stands by takes over.
    """

    def __init__(self, path: Path, *, quota_bytes: int = 0, reserve_bytes: int = 0) -> None:
        """Remember the folder.

        Args:
            path: The folder; created by `lock`.
            quota_bytes: The oldest finished segments are deleted beyond this; 0: no limit.
            reserve_bytes: Space that must stay free on the disk.
        """
        self.path = path
        self._quota_bytes = quota_bytes
        self._reserve_bytes = reserve_bytes
        self._lock_fd = -1
        self._finished_bytes: int | None = None  # of all finished segments; None: not known
        self._open_segment: Path | None = None
        self._runs: list[str] = []  # marks, oldest first; []: not read yet
        self.deleted = 0

    @property
    def locked(self) -> bool:
        """Whether this process holds the lock of the folder."""
        return self._lock_fd >= 0

    def lock(self) -> bool:
        """Take the lock of this folder; False if another process holds it.

        Raises:
            LogError: The folder cannot be made, written or locked.
        """
        if self.locked and self.in_place():
            return True
        self.unlock()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            descriptor = _open_lock(self.path / _LOCK)
        except OSError as error:
            raise LogError(f"cannot record into {self.path}: {why_refused(error)}") from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return False
        except OSError as error:
            os.close(descriptor)
            raise LogError(
                f"cannot lock {self.path / _LOCK}: {describe(error)}; mount this disk with locks, or record "
                "onto another"
            ) from None
        self._lock_fd = descriptor
        return True

    def in_place(self) -> bool:
        """Whether the folder is still the one that was locked: not moved, deleted, or hidden by a mount."""
        try:
            here = (self.path / _LOCK).stat()
        except OSError:
            return False
        return self.locked and os.path.samestat(here, os.fstat(self._lock_fd))

    def unlock(self) -> None:
        """Let another recorder take over; may be called twice."""
        self._finished_bytes, self._runs = None, []
        if self._lock_fd >= 0:
            os.close(self._lock_fd)
            self._lock_fd = -1

    def recover(self) -> list[Recovery]:
        """Recover the parts that a killed recorder left; call it with the lock held."""
        done = recover_folder(self.path)
        self._finished_bytes = None
        return done

    def begin_run(self, rig: str, unix_ns: int) -> str:
        """Return the first part of the segment names of a new run, and note that it is the newest.

        A file lists the marks of all runs in the order in which they began: a computer without a
        battery-backed clock may date a run years before the one that it follows.

        Args:
            rig: First part of the names.
            unix_ns: When it begins.
        """
        mark = secrets.token_hex(3)
        here = (_OURS.fullmatch(path.name) for path in self.path.glob("*.mcap*"))
        present = {match[2] for match in here if match}
        self._runs = [*(run for run in self._listed() if run in present), mark]
        with suppress(OSError):  # of a full disk: the segment will report it
            atomic_write(self.path / _RUNS, "".join(f"{run}\n" for run in self._runs).encode())
        begin = datetime.fromtimestamp(unix_ns * 1e-9, UTC)
        return f"{rig}_{begin:%Y%m%dT%H%M%SZ}_{mark}"

    def _listed(self) -> list[str]:
        """Marks of the runs in the order in which they began; [] if that is not known."""
        if not self._runs:
            with suppress(OSError):
                text = (self.path / _RUNS).read_text(encoding="ascii", errors="replace")
                self._runs = re.findall(r"^[0-9a-f]{6}$", text, re.MULTILINE)
        return self._runs

    def segments(self) -> list[Path]:
        """Finished segments of vical, oldest first.

        Runs that `.recorder.runs` lists are in its order. Others (copied, or of an older version) come before
        them, by the dates in their names. The time of a file would be that of its recovery or copy, and it
        steps with the wall clock.
        """
        order: dict[str, int] = {}
        for run in self._listed():
            order.setdefault(run, len(order))
        dated: list[tuple[int, str, str, int, Path]] = []
        for path in self.path.glob("*.mcap"):
            match = _OURS.fullmatch(path.name)
            if match:
                begin, run, segment = match.group(1, 2, 3)
                dated.append((order.get(run, -1), begin, run, int(segment), path))
        return [path for *_, path in sorted(dated)]

    def enforce_quota(self, open_segment: Path | None = None, open_bytes: int = 0) -> list[Path]:
        """Delete the oldest segments until all, with the open one, fit; returns what was deleted.

        May be called often: the folder is read only when another segment is open, or the sum is too large.
        """
        if not self._quota_bytes:
            return []
        if open_segment != self._open_segment:
            self._finished_bytes, self._open_segment = None, open_segment
        if self._finished_bytes is not None and self._finished_bytes + open_bytes <= self._quota_bytes:
            return []
        sizes = {path: _size(path) for path in self.segments()}
        total, deleted = sum(sizes.values()), []
        for path in sizes:
            if total + open_bytes <= self._quota_bytes:
                break
            path.unlink(missing_ok=True)
            total -= sizes[path]
            deleted.append(path)
        self._finished_bytes = total
        self.deleted += len(deleted)
        return deleted

    def free_bytes(self) -> int:
        """Free space on the disk, bytes."""
        return shutil.disk_usage(self.path).free

    def has_room(self, *, resuming: bool = False) -> bool:
        """Whether the reserve is free; to resume, 10 % more must be free (hysteresis)."""
        return self.free_bytes() > self._reserve_bytes * (1.1 if resuming else 1.0)


def _open_lock(path: Path) -> int:
    """Open the lock file; for reading if another user (root, once) made it. Over NFS a lock needs writing."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except PermissionError:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)


def _size(path: Path) -> int:
    """Return the size of a file, bytes; 0 if somebody has just removed it."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0
