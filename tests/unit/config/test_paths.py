"""Where the service's files lie when the environment of a user is not as it should be."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from vical_daemon.config.paths import make_private, runtime_directory, state_directory


@pytest.fixture(autouse=True)
def no_own_folders(monkeypatch, tmp_path):
    for name in ("VICAL_RUNTIME_DIR", "RUNTIME_DIRECTORY", "VICAL_STATE_DIR", "STATE_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


@pytest.mark.parametrize("value", ["relative/path", ":", ""])
def test_relative_folders_of_the_session_count_as_none(monkeypatch, tmp_path, value):
    """Or a calibration would be stored below the folder that a command happens to be started in."""
    monkeypatch.setenv("XDG_STATE_HOME", value)
    monkeypatch.setenv("XDG_RUNTIME_DIR", value)
    assert state_directory() == tmp_path / ".local" / "state" / "vical"
    assert runtime_directory() == Path(tempfile.gettempdir()) / f"vical-{os.getuid()}"


def test_a_session_folder_that_is_not_there_or_not_ours_is_not_used(monkeypatch, tmp_path):
    """`su` and cron leave the variable of another session, or one whose folder was removed."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime_directory() == tmp_path / "vical"
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "gone"))
    assert runtime_directory().name == f"vical-{os.getuid()}"
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert runtime_directory().name == "vical-12345"


def test_a_folder_that_cannot_be_made_names_the_setting():
    with pytest.raises(OSError, match=r"set VICAL_RUNTIME_DIR or bus\.socket"):
        make_private(Path("/proc/nope/vical"))
