"""`vical doctor`: what on this computer stands in the way of good stamps, each with what to do."""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from vical_drivers.access import how_to_open

from vical_daemon.cli.check import Finding, document, print_line
from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_json

_SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
_FTDI_LATENCY_MS = 1  # what the udev rules of install-service set; FTDI's default of 16 ms bunches samples
_USBFS_MB = 64  # room for 1 s of 640 x 480 at 200 Hz; the kernel's default is 16
_FREE_BYTES = 500_000_000  # `record.reserve_bytes`: with less the recorder stops
_DEVICES = ("ttyUSB*", "ttyACM*", "video[0-9]*", "fw[0-9]*")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = "To check a config and its devices: vical check -c FILE"
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Look at everything; 1 if something stands in the way."""
    findings = []
    for finding in examine():
        findings.append(finding)
        if not args.json:
            print_line(finding)
    problems = [finding.problem for finding in findings if finding.problem]
    if args.json:
        print(json.dumps(document(findings)))
    if problems:
        more = f" (and {len(problems) - 1} more, see above)" if len(problems) > 1 else ""
        raise CliError(f"{problems[0]}{more}")
    return 0


def _usable(path: Path) -> bool:
    return os.access(path, os.R_OK | os.W_OK)


def examine(root: Path = Path("/"), may_use: Callable[[Path], bool] = _usable) -> Iterator[Finding]:
    """Yield one finding for each thing that was looked at.

    Args:
        root: Where /sys and /dev lie.
        may_use: Whether this user may read and write a device.
    """
    yield Finding(
        "system", f"Linux {platform.release()} {platform.machine()}, Python {platform.python_version()}"
    )
    yield from _clock(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    yield from _governors(root / "sys/devices/system/cpu")
    yield from _devices(root / "dev", may_use)
    yield from _latency_timers(root / "sys/bus/usb-serial/devices")
    yield from _usbfs(root / "sys/module/usbcore/parameters/usbfs_memory_mb")
    yield _real_time()
    yield _locked_memory()
    yield _disk()


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return None


def _clock(path: Path) -> Iterator[Finding]:
    name = _read(path)
    if name is None:
        return
    problem = ""
    if name in _SLOW_CLOCKS:
        problem = (
            f"the kernel's clock is {name}, each reading takes microseconds; see `dmesg | grep -i tsc`, "
            "and boot with tsc=reliable if the processor's counter is sound"
        )
    yield Finding("clock source", name, problem)


def _governors(folder: Path) -> Iterator[Finding]:
    governors = sorted({_read(p) or "?" for p in folder.glob("cpu[0-9]*/cpufreq/scaling_governor")})
    if governors:
        hint = (
            "; `cpupower frequency-set -g performance` shortens the latest stamps"
            if "powersave" in governors
            else ""
        )
        yield Finding("processor", f"governor {', '.join(governors)}{hint}")


def _devices(folder: Path, may_use: Callable[[Path], bool]) -> Iterator[Finding]:
    found = sorted(path for pattern in _DEVICES for path in folder.glob(pattern))
    for path in found:
        problem = ""
        if not may_use(path):
            problem = f"{path}: not yours to use: {how_to_open(path)}"
        yield Finding("device", str(path), problem)
    if not found:
        yield Finding("device", "neither serial port nor camera is plugged in")


def _latency_timers(folder: Path) -> Iterator[Finding]:
    for path in sorted(folder.glob("*/latency_timer")):
        text = _read(path) or ""
        slow = text.isdigit() and int(text) > _FTDI_LATENCY_MS
        problem = (
            f"{path.parent.name}: the latency timer is {text} ms, samples come late and in bunches: "
            f"echo {_FTDI_LATENCY_MS} | sudo tee {path} (`vical install-service` makes that last)"
        )
        yield Finding("latency timer", f"{path.parent.name}: {text} ms", problem if slow else "")


def _usbfs(path: Path) -> Iterator[Finding]:
    text = _read(path)
    if text is None or not text.isdigit():
        return
    small = 0 < int(text) < _USBFS_MB  # 0: no limit
    hint = f"; for a USB3 Vision camera (aravis:) more: echo 1000 | sudo tee {path}" if small else ""
    yield Finding("usbfs memory", f"{text} MB{hint}")


def _real_time() -> Finding:
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    allowed = soft != 0 or os.geteuid() == 0
    text = "allowed" if allowed else "not allowed here; the units of `vical install-service` have it"
    return Finding("real time", text)


def _locked_memory() -> Finding:
    from vical_daemon.bus.zenoh_session import can_share_memory

    enough = can_share_memory()
    text = (
        "enough to share images"
        if enough
        else "too little to share images: they are copied (ulimit -l unlimited)"
    )
    return Finding("locked memory", text)


def _disk() -> Finding:
    from vical_daemon.config.paths import state_directory

    folder = (state_directory() / "log").absolute()
    existing = next(p for p in (folder, *folder.parents) if p.exists())
    free = shutil.disk_usage(existing).free
    text = f"{folder}: {free / 1e9:.1f} GB free"
    return Finding("disk", text, f"{text}: too little to record" if free < _FREE_BYTES else "")
