"""`vical install-service`: systemd units, sandbox, user, udev rules and a first config; and their removal."""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import stat
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent

from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_json
from vical_daemon.service.atomic_file import atomic_write

_UNITS = Path("etc/systemd/system")
_HOMES = ("/home", "/root", "/run/user")
_CONFIG = Path("etc/vical/vical.yaml")
_LINKS = Path("dev/vical")
_MICROSTRAIN = 0x199B  # USB vendor, as in the rules
_TRIGGER = ("tty", "usb-serial", "video4linux", "firewire")
"""Subsystems that the rules speak of: what is plugged in already is looked at again."""
_PLACES = {
    "vical.target": _UNITS / "vical.target",
    "vical-acquire.service": _UNITS / "vical-acquire.service",
    "vical-record.service": _UNITS / "vical-record.service",
    "vical-calibrate.service": _UNITS / "vical-calibrate.service",
    "vical-web.service": _UNITS / "vical-web.service",
    "vical-.service.d/10-common.conf": _UNITS / "vical-.service.d/10-common.conf",
    "vical.sysusers": Path("etc/sysusers.d/vical.conf"),
    "70-vical.rules": Path("etc/udev/rules.d/70-vical.rules"),
}
"""Template -> where it goes, below the root folder."""


@dataclass(frozen=True, slots=True)
class Step:
    """One thing to do: write a file (`text`), remove one, or run a command."""

    action: str  # write, keep, remove or run
    what: str
    text: str = ""
    command: tuple[str, ...] = ()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.add_argument("--dry-run", action="store_true", help="show what would be done and written")
    parser.add_argument("--remove", action="store_true", help="remove everything except config and data")
    parser.add_argument("--now", action="store_true", help="also enable and start vical.target")
    parser.add_argument(
        "--root", metavar="DIR", default="/", help="install below DIR and run no command (for system images)"
    )
    parser.add_argument("--program", metavar="PATH", help="the `vical` program to run (default: this one)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Install or remove; doing it twice changes nothing."""
    root = Path(args.root)
    if not root.is_dir():
        raise CliError(f"--root {root}: no such folder", 2)
    if args.remove:
        steps = removal(root)
    else:
        program = _program(args.program)
        for path in (program, Path(sys.executable).resolve()):
            if (folder := closed_folder(path)) is not None:
                text = f"{path}: user vical may not enter {folder}; install vical below /opt"
                print(f"vical: warning: {text}", file=sys.stderr)
        steps = installation(root, program, now=args.now)
    if not args.dry_run:
        _require_rights(root)
    done = []
    for step in steps:
        if step.command and (args.root != "/" or not shutil.which(step.command[0])):
            continue
        if not args.dry_run:
            _perform(step)
        shown = {"text": step.text} if args.dry_run and step.action == "write" else {}
        done.append({"action": step.action, "what": step.what, **shown})
        if not args.json:
            print(f"{'would ' if args.dry_run else ''}{step.action:<7}{step.what}")
            print(indent(shown.get("text", ""), "    "), end="")
    if args.json:
        print(json.dumps({"dry_run": args.dry_run, "steps": done}))
    elif not args.remove and not args.dry_run and not args.now:
        print("next: edit /etc/vical/vical.yaml, `vical check -c /etc/vical/vical.yaml`,")
        print("      `systemctl enable --now vical.target`, `vical watch`")
    return 0


def templates() -> Path:
    """Return the folder of the unit templates: in the package, or in the repository it runs from.

    Raises:
        CliError: Neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "service_files", package.parent / "systemd"):
        if (folder / "vical.target").is_file():
            return folder
    raise CliError(f"the unit files are not in this installation (looked next to {package})")


def render(name: str, program: Path, interpreter: Path | None = None) -> str:
    """Return a template with the program's path; home folders stay readable only if it runs from one.

    Args:
        name: Of the template.
        program: What the units start.
        interpreter: The Python behind it; None: the one that runs now.
    """
    text = (templates() / name).read_text(encoding="utf-8")
    needed = (program, (interpreter or Path(sys.executable)).resolve())
    in_home = any(path.is_relative_to(home) for path in needed for home in _HOMES)
    protect = "read-only" if in_home else "yes"
    return text.replace("@VICAL@", _quoted(program)).replace("@PROTECT_HOME@", protect)


def _quoted(program: Path) -> str:
    """Return a path as the first word of ``ExecStart=`` (systemd.service(5), systemd.syntax(7)).

    `%` begins a specifier, within quotes as well. Variables are not replaced in the first word. systemd takes
    no quote and no backslash in it, however they are written (see `_program`).
    """
    text = str(program).replace("%", "%%")
    return text if re.fullmatch(r"[A-Za-z0-9_./%+@:,=-]+", text) else f'"{text}"'


def closed_folder(path: Path) -> Path | None:
    """Return the first folder above `path` that other users may not enter; None if all are open."""
    for folder in reversed(path.parents):
        if folder.is_dir() and not folder.stat().st_mode & stat.S_IXOTH:
            return folder
    return None


def installation(root: Path, program: Path, *, now: bool = False) -> list[Step]:
    """Return what to do to install."""
    steps = []
    for name, place in _PLACES.items():
        path, text = root / place, render(name, program)
        same = path.is_file() and path.read_text(encoding="utf-8") == text
        steps.append(Step("keep" if same else "write", str(path), text))
    config = root / _CONFIG
    example = _example().replace("imu-SERIAL", _imu_link())
    if example and not config.exists():
        steps.append(Step("write", str(config), example))
    else:
        steps.append(Step("keep", str(config)))
    steps += [_command("systemd-sysusers"), _command("systemctl", "daemon-reload")]
    steps += _udev_steps()
    if now:
        steps.append(_command("systemctl", "enable", "--now", "vical.target"))
    return steps


def removal(root: Path) -> list[Step]:
    """Return what to do to remove; the config, the user and what was recorded stay."""
    steps = [_command("systemctl", "disable", "--now", "vical.target", "vical-web.service")]
    steps += [_command("systemctl", "stop", "vical-acquire", "vical-record", "vical-calibrate")]
    steps += [Step("remove", str(root / place)) for place in _PLACES.values() if (root / place).exists()]
    folder = root / _UNITS / "vical-.service.d"
    if {path.name for path in folder.glob("*")} == {"10-common.conf"}:  # nobody else's drop-in is there
        steps.append(Step("remove", str(folder)))
    steps += [_command("systemctl", "daemon-reload"), *_udev_steps()]
    links = root / _LINKS
    if links.is_dir():  # udev takes its links away itself, if it runs
        steps += [Step("remove", str(path)) for path in (*sorted(links.iterdir()), links)]
    return steps


def _udev_steps() -> list[Step]:
    return [
        _command("udevadm", "control", "--reload"),
        _command("udevadm", "trigger", *(f"--subsystem-match={name}" for name in _TRIGGER)),
        _command("udevadm", "settle", "--timeout=10"),  # s
    ]


def _imu_link() -> str:
    """Return the name that the rules give to the IMU that is plugged in; a placeholder unless it is one."""
    from serial.tools import list_ports

    serials = {port.serial_number for port in list_ports.comports() if port.vid == _MICROSTRAIN}
    if len(serials) != 1 or not (serial := serials.pop()):
        return "imu-SERIAL"
    return "imu-" + re.sub(r"[^A-Za-z0-9#+.:=@_-]", "_", serial)  # udev(7), OPTIONS string_escape=replace


def _command(*words: str) -> Step:
    return Step("run", " ".join(words), command=words)


def _example() -> str:
    package = Path(__file__).resolve().parents[1]
    for path in (package / "service_files" / "vical.yaml", package.parent / "examples" / "vical.yaml"):
        if path.is_file():
            return path.read_text(encoding="utf-8")
    return ""


def _program(given: str | None) -> Path:
    """Return the absolute path of the command that the units start."""
    candidates = [Path(given)] if given else [Path(sys.argv[0]), Path(sys.executable).with_name("vical")]
    for path in candidates:
        if path.is_file() and os.access(path, os.X_OK):
            if re.search(r"[\"'\\\x00-\x1f\x7f]", str(path.absolute())):
                text = "systemd takes no quotes, backslashes or line breaks in the name of a program"
                raise CliError(f"--program {str(path)!r}: {text}; make a link with another name", 2)
            return path.absolute()
    raise CliError(f"{candidates[0]}: not a program; give it with --program", 2)


def _require_rights(root: Path) -> None:
    existing = next(
        p for p in ((root / _UNITS).absolute(), *(root / _UNITS).absolute().parents) if p.exists()
    )
    if not os.access(existing, os.W_OK):
        raise CliError(f"{existing}: not writable; run it with sudo, or look first with --dry-run")


def _perform(step: Step) -> None:
    if step.action == "write":
        path = Path(step.what)
        atomic_write(path, step.text.encode())
        path.chmod(0o644)
    elif step.action == "remove":
        path = Path(step.what)
        with suppress(FileNotFoundError):
            path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    elif step.command:
        done = subprocess.run(step.command, capture_output=True, text=True, check=False)
        if done.returncode:  # a unit that is not loaded cannot be stopped: no reason to give up
            print(f"vical: warning: {step.what}: {done.stderr.strip()}", file=sys.stderr)
