"""A machine for studies of the service: this system's files under an overlay, booted by systemd-nspawn."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Self

_REPOSITORY = Path(__file__).resolve().parents[3]


class MachineError(Exception):
    """The machine cannot be made or does not do what it should."""


class Machine:
    """A booted container; a context manager. Needs root, systemd-nspawn and a kernel with overlayfs.

    Attributes:
        root: Its root folder; may be changed before `boot`.
    """

    def __init__(self) -> None:
        missing = [tool for tool in ("systemd-nspawn", "nsenter", "mount") if shutil.which(tool) is None]
        if os.getuid() or missing:
            what = f"{', '.join(missing)} missing (Debian: systemd-container)" if missing else "not root"
            raise MachineError(f"no real systemd here: {what}")
        self._base = Path(tempfile.mkdtemp(prefix="vical-machine-"))
        self.root = self._base / "root"
        self._nspawn: subprocess.Popen[bytes] | None = None
        self._leader = 0

    def __enter__(self) -> Self:
        _call("mount", "-t", "tmpfs", "tmpfs", str(self._base))
        for name in ("up", "work", "root"):
            (self._base / name).mkdir()
        layers = f"lowerdir=/,upperdir={self._base / 'up'},workdir={self._base / 'work'}"
        _call("mount", "-t", "overlay", "overlay", "-o", layers, str(self.root))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._nspawn is not None:
            self._nspawn.terminate()
            try:
                self._nspawn.wait(20)
            except subprocess.TimeoutExpired:
                self._nspawn.kill()
                self._nspawn.wait()
        for folder in (self.root, self._base):
            subprocess.run(["umount", "-l", str(folder)], check=False)
        shutil.rmtree(self._base, ignore_errors=True)

    def boot(self, timeout_s: float = 90.0) -> float:
        """Boot to basic.target; return how long it took, s."""
        begin_s = time.monotonic()
        with (self._base / "console").open("wb") as log:
            self._nspawn = subprocess.Popen(
                [
                    "systemd-nspawn", "-q", "-D", str(self.root), "--boot", "--register=no", "--keep-unit",
                    "--private-network", f"--machine=vical{os.getpid()}", "--console=pipe",
                    f"--bind-ro={_REPOSITORY}",  # a checkout below /tmp would be hidden by the machine's own
                    "systemd.unit=basic.target",
                ],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
        while time.monotonic() - begin_s < timeout_s:
            time.sleep(0.3)
            children = Path(f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children").read_text().split()
            if children:
                self._leader = int(children[0])
                if self.run("systemctl", "is-active", "basic.target", check=False).strip() == "active":
                    return time.monotonic() - begin_s
        raise MachineError("the machine does not boot: " + (self._base / "console").read_text()[-500:])

    def run(self, *words: str, check: bool = True) -> str:
        """Run a command inside and return its output."""
        command = ["nsenter", "-t", str(self._leader), "-a", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if check and done.returncode:
            raise MachineError(f"{' '.join(words)}: {done.stderr.strip() or done.stdout.strip()}")
        return done.stdout

    def show(self, unit: str, *names: str) -> list[str]:
        """Return properties of a unit."""
        text = self.run("systemctl", "show", unit, *[f"-p{name}" for name in names])
        values = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
        return [values.get(name, "") for name in names]


def _call(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise MachineError(f"{' '.join(words)}: {done.stderr.strip()}")
