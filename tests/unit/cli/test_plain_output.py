"""Commands whose output cannot be encoded, and homes and folders that cannot be written."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from vical_daemon.cli.plain_output import readable
from vical_daemon.config.paths import state_directory

ENCODINGS = ["ascii", "latin-1", "cp437", "utf-8"]


def vical(*words, cwd=None, **environment):
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONUTF8", "PYTHONIOENCODING", "LC_ALL")}
    done = subprocess.run(
        [sys.executable, "-m", "vical_daemon", *words],
        env={k: v for k, v in {**kept, **environment}.items() if v is not None},
        cwd=cwd,
        capture_output=True,
        timeout=300,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_closed_streams_are_no_error_and_no_file_takes_their_place(closed):
    command = f'"{sys.executable}" -m vical_daemon completion bash {closed}'
    done = subprocess.run(command, shell=True, capture_output=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_script_in_between_does_not_take_the_place_of_a_closed_stream(tmp_path):
    """A shell reads its script by the lowest free number: errors ended in `Bad file descriptor`."""
    script = tmp_path / "vical"
    script.write_text(f'#!/bin/bash\nexec "{sys.executable}" -m vical_daemon "$@"\n')
    script.chmod(0o755)
    done = subprocess.run(
        f'"{script}" info --nonsense 2>&-', shell=True, capture_output=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (2, b"")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_what_an_encoding_lacks_is_replaced(encoding):
    script = (
        "from vical_daemon.cli.plain_output import accept_any_encoding as f; import sys; f();"
        "print('1 ± 2 mm → 3° … \\u2603'); print('±', file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONIOENCODING": encoding},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0
    text = done.stdout.decode(encoding).strip()
    if encoding == "ascii":
        assert text == "1 +- 2 mm -> 3 deg ... ?"
        assert done.stderr.strip() == b"+-"
    if encoding == "utf-8":
        assert text == "1 ± 2 mm → 3° … ☃"


def test_only_failures_to_encode_are_replaced():
    with pytest.raises(UnicodeDecodeError):
        readable(UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid"))


@pytest.mark.parametrize("words", [("--help",), ("demo", "--help"), ("info", "nowhere±.mcap"), ("devices",)])
def test_commands_in_a_posix_locale(words):
    code, out, err = vical(
        *words, PYTHONUTF8="0", LC_ALL="C", PYTHONIOENCODING="ascii", PYTHONCOERCECLOCALE="0"
    )
    assert code in (0, 1)
    assert b"Unicode" not in out + err
    assert b"Traceback" not in out + err


def test_without_a_home_there_is_a_place_for_state(monkeypatch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    for name in ("XDG_STATE_HOME", "VICAL_STATE_DIR", "STATE_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    assert state_directory().is_absolute()


@pytest.fixture
def closed(tmp_path):
    """A folder in which nothing can be created (root may all the same)."""
    folder = tmp_path / "closed"
    folder.mkdir()
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    yield folder
    folder.chmod(stat.S_IRWXU)


@pytest.mark.parametrize("home", ["closed", "none", "missing"])
def test_the_result_of_a_calibration_needs_no_home(closed, tmp_path, home):
    if os.getuid() == 0:
        pytest.skip("root may write everywhere; runs as an ordinary user")
    homes = {"closed": str(closed), "none": None, "missing": str(tmp_path / "nowhere")}
    words = ("demo", "--seconds", "12", "--json", "--quiet", "--out", str(tmp_path / "out"))
    code, out, err = vical(*words, cwd=closed, HOME=homes[home], XDG_STATE_HOME=None)
    assert code in (0, 1)  # twelve seconds may be too few to converge
    assert b'"cameras"' in out
    assert b"Traceback" not in err
    assert b"matplotlib" not in err.lower()
    code, out, err = vical(
        "export", str(tmp_path / "out" / "result.json"), "--format", "kalibr", "-o", str(closed / "f.yaml")
    )
    assert code == 1
    *warnings, error = err.decode().strip().splitlines()
    assert error.startswith("vical: error: ")
    assert all(line.startswith("vical: warning: not converged") for line in warnings)
