"""Files that a person asked for: the earlier one is kept where the new one cannot be written."""

import errno
import os
import resource
import stat
from pathlib import Path

import pytest

from vical_daemon.cli import main
from vical_daemon.cli.errors import describe_known
from vical_daemon.logs.mcap import LogError, LogFolder
from vical_daemon.service.atomic_file import why_refused, write_output


@pytest.fixture
def small_files():
    """No file of this process may grow beyond 2000 bytes: what a full disk does, with EFBIG for ENOSPC."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_what_does_not_fit_leaves_the_earlier_file(tmp_path: Path, small_files: None) -> None:
    path = tmp_path / "camchain.yaml"
    write_output(path, "earlier")
    with pytest.raises(OSError, match="camchain") as refused:
        write_output(path, "x" * 10_000)
    assert refused.value.errno == errno.EFBIG
    assert describe_known(refused.value) == (f"{path}: File too large", 1)
    assert path.read_text() == "earlier" and list(tmp_path.iterdir()) == [path]


def test_a_command_on_a_full_disk_is_one_line(tmp_path: Path, small_files: None, capfd) -> None:
    path = tmp_path / "board.svg"
    assert main(["target", "--type", "checkerboard", "-o", str(path)]) == 1
    assert capfd.readouterr().err == f"vical: error: {path}: cannot be written (File too large)\n"
    assert not list(tmp_path.iterdir())


def test_links_are_followed_modes_kept_and_devices_written_to(tmp_path: Path) -> None:
    real, link = tmp_path / "real", tmp_path / "link"
    real.write_text("earlier")
    real.chmod(0o600)
    link.symlink_to(real)
    write_output(link, "new")
    assert link.is_symlink() and real.read_text() == "new"
    assert stat.S_IMODE(real.stat().st_mode) == 0o600
    write_output(Path("/dev/null"), b"anything")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        write_output(Path("/dev/full"), "x")
    reading, writing = os.pipe()
    write_output(Path(f"/dev/fd/{writing}"), "to a pipe, as -o /dev/stdout in a pipeline")
    assert os.read(reading, 100).startswith(b"to a pipe")
    os.close(reading)
    os.close(writing)
    with pytest.raises(FileNotFoundError):
        write_output(tmp_path / "missing" / "x", "x")
    assert not (tmp_path / "missing").exists()


def test_names_of_files_that_are_no_text_do_not_stop_a_report(tmp_path: Path) -> None:
    write_output(tmp_path / "r.html", "made from " + os.fsdecode(b"\xff.mcap"))
    assert (tmp_path / "r.html").read_text() == "made from ?.mcap"


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES])
def test_what_the_sandbox_of_the_service_refuses_names_the_setting(code: int, monkeypatch) -> None:
    refused = OSError(code, os.strerror(code), "/data/logs")
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert why_refused(refused) == os.strerror(code)
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/vical")
    assert why_refused(refused).startswith(
        f"{os.strerror(code)}; outside of /var/lib/vical the service needs "
    )
    assert why_refused(OSError(errno.ENOSPC, "full")) == "full"


def test_the_recorder_says_so(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/vical")

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(LogError, match=r"cannot record into .*: Read-only file system; .* ReadWritePaths="):
        LogFolder(tmp_path / "log").lock()
