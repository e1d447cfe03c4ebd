"""Files that a user names: only regular ones, never more than a limit, never waited for."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
from vical_drivers.user_files import open_file, read_file, read_text


def test_a_regular_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("größe\n", encoding="utf-8")
    size = path.stat().st_size
    assert read_text(path, size) == "größe\n"
    with open_file(path) as file:
        assert file.read() == path.read_bytes()
    link = tmp_path / "link"
    link.symlink_to(path)
    assert read_file(link, size) == path.read_bytes()


def test_a_file_beyond_the_limit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "big.yaml"
    path.write_bytes(bytes(1001))
    with pytest.raises(OSError, match="larger than 1 kB") as caught:
        read_file(path, 1000)
    assert caught.value.filename == str(path)
    with path.open("wb") as file:
        file.truncate(10**12)  # sparse: takes no room on the disk
    with pytest.raises(OSError, match="larger than 1 MB"):
        open_file(path, 10**6)


def test_a_file_that_states_no_size_is_read_to_the_limit() -> None:
    path = Path("/proc/self/smaps")
    assert path.stat().st_size == 0
    with pytest.raises(OSError, match="larger than"):
        read_file(path, 100)


def test_what_a_disk_refuses_while_it_is_read_names_the_file() -> None:
    with pytest.raises(OSError, match="Input/output error") as caught:
        read_file(Path("/proc/self/mem"), 100)
    assert caught.value.filename == "/proc/self/mem"


@pytest.mark.parametrize("kind", ["folder", "pipe", "socket", "device"])
def test_what_is_no_file_is_named_and_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / kind
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)  # nobody at its other end: to open it would wait for ever
    elif kind == "socket":
        os.mknod(path, stat.S_IFSOCK | 0o600)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(OSError, match=f"is a {kind}, a file is needed") as caught:
        read_file(path, 1000)
    assert caught.value.filename == str(path)


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        with pytest.raises(OSError, match="a device"):
            open_file(Path("/dev/zero"))
    assert len(list(Path("/proc/self/fd").iterdir())) == before
