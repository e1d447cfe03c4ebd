"""Recovery where nothing can be written says so, and what to do."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from vical_daemon.bus import messages as m
from vical_daemon.logs.mcap import LogError, LogWriter, recover


def test_a_read_only_disk_is_named_with_the_way_around_it(tmp_path, monkeypatch):
    writer = LogWriter(tmp_path / "a.mcap")
    writer.write("vical/rig0/imu/imu0", m.encode_imu(1, "imu0", (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)), 1)
    writer.flush()
    (tmp_path / "cut.mcap").write_bytes(writer.part_path.read_bytes())
    writer.close()

    def refuse(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    plain_open = Path.open
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        patch.setattr(
            Path, "open", lambda path, mode="r": (refuse if "w" in mode else plain_open)(path, mode)
        )
        with pytest.raises(
            LogError, match=r"cannot write .*: Read-only file system; write it elsewhere with -o"
        ):
            recover(tmp_path / "cut.mcap")
    assert recover(tmp_path / "cut.mcap", tmp_path / "there.mcap").messages == 1
