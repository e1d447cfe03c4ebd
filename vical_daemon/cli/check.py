"""`vical check -c FILE`: reads config and devices and says what is wrong, with what to try."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, NOTHING_TO_RUN, CliError
from vical_daemon.cli.options import add_config, add_json

if TYPE_CHECKING:
    from vical_drivers.samples import FrameSource, ImuSource

    from vical_daemon.config.model import CameraConfig, Config, ImuConfig, RecordConfig

_IMU_SECONDS = 2.5


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the check: `problem` is empty where all is well."""

    what: str
    text: str
    problem: str = ""


_EPILOG = """\
exit code: 0 no problem; 1 a problem with a device, the target file, the disk or the store;
2 a mistake in the config
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    add_config(parser)
    parser.add_argument("--no-devices", action="store_true", help="check the files only, open no device")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Check everything; 2 if the config is wrong, 1 if something else is."""
    from vical_daemon.config.model import ConfigError, load

    try:
        config = load(args.config)
    except ConfigError as error:
        findings = [Finding("config", args.config, problem) for problem in error.problems]
        _print(findings, as_json=args.json)
        raise CliError(count(findings), EXIT_USAGE) from None
    if not config.imus and not config.cameras:
        finding = Finding("config", args.config, f"{args.config}: {NOTHING_TO_RUN}")
        _print([finding], as_json=args.json)
        raise CliError(finding.problem, EXIT_USAGE)
    findings = []
    for finding in examine(config, args.config, devices=not args.no_devices):
        findings.append(finding)
        if not args.json:
            print_line(finding)
    if args.json:
        _print(findings, as_json=True)
    if any(finding.problem for finding in findings):
        raise CliError(count(findings))
    if not args.json:
        print("all is well")
    return 0


def count(findings: list[Finding]) -> str:
    """Return the one line that stands on stderr when the check fails."""
    bad = [finding.problem for finding in findings if finding.problem]
    more = f" (and {len(bad) - 1} more, see above)" if len(bad) > 1 else ""
    return f"{bad[0]}{more}"


def _summary(config: Config) -> str:
    imus, cameras = ", ".join(config.imus) or "no imu", ", ".join(config.cameras) or "no camera"
    return f"rig {config.rig}, {imus}, {cameras}, {config.calibration.mode}"


def examine(config: Config, name: str, *, devices: bool) -> Iterator[Finding]:
    """Yield one finding for each thing that is looked at.

    Args:
        config: The rig.
        name: Of its file.
        devices: Open the devices, too.
    """
    yield Finding("config", f"{name}: {_summary(config)}")
    yield from _check_target(config)
    yield _check_disk(config)
    yield from _check_store(config)
    yield from _check_bus(config)
    yield from _check_shared("imus", {name: imu.port for name, imu in config.imus.items()})
    yield from _check_shared("cameras", {name: camera.uri for name, camera in config.cameras.items()})
    if not devices:
        return
    from vical_daemon.acquire.camera import open_camera
    from vical_daemon.acquire.imu import open_imu
    from vical_daemon.cli.emulated import emulated_devices

    with emulated_devices(config, ("imu", "camera")) as options:
        open_source = options.get("imu", {}).get("open_source", open_imu)
        for name, imu in config.imus.items():
            yield _check_imu(f"imus.{name}", imu, open_source)
        open_source = options.get("camera", {}).get("open_source", open_camera)
        for name, camera in config.cameras.items():
            yield from _check_camera(f"cameras.{name}", camera, open_source)


def _check_target(config: Config) -> Iterator[Finding]:
    if config.target_path is None:
        return
    from vical_daemon.vision.target import load_target
    from vical_daemon.vision.target_yaml import TargetError

    try:
        target = load_target(config.target_path)
    except TargetError as error:
        yield Finding("target", str(config.target_path), str(error))
        return
    size_m = target.points_m.max(axis=0) - target.points_m.min(axis=0)
    yield Finding(
        "target", f"{target.kind}, {len(target.points_m)} points over {size_m[0]:.3f} x {size_m[1]:.3f} m"
    )


def _check_disk(config: Config) -> Finding:
    from vical_daemon.config.paths import state_directory

    folder = Path(config.record.directory or state_directory() / "log")
    existing, problem = _folder(folder)
    if problem:
        return Finding("record", str(folder), problem)
    try:
        free = shutil.disk_usage(existing).free
    except OSError as error:
        return Finding("record", str(folder), f"{existing}: {error.strerror}")
    text = f"{folder}: {free / 1e9:.1f} GB free"
    if free < config.record.reserve_bytes:
        reserve = config.record.reserve_bytes / 1e9
        return Finding(
            "record", text, f"{text}, below record.reserve_bytes ({reserve:.1f} GB): nothing is recorded"
        )
    return Finding("record", text + _full_before_the_quota(config.record, folder, free))


def _full_before_the_quota(record: RecordConfig, folder: Path, free_bytes: int) -> str:
    """Say that recording will end with a full disk: the quota that deletes old recordings is larger."""
    from vical_daemon.logs.mcap import LogFolder

    with suppress(OSError):
        room_bytes = free_bytes - record.reserve_bytes
        room_bytes += sum(path.stat().st_size for path in LogFolder(folder).segments())
        if record.enabled and (not record.quota_bytes or room_bytes < record.quota_bytes):
            quota = f"{record.quota_bytes / 1e9:.1f} GB" if record.quota_bytes else "no limit"
            return (
                f"; recordings end when they fill {room_bytes / 1e9:.1f} GB, because old ones are deleted "
                f"only beyond record.quota_bytes ({quota})"
            )
    return ""


def _folder(folder: Path) -> tuple[Path, str]:
    """Return the nearest folder that exists, and why nothing can be written there ("": nothing is known).

    Rights are not looked at: the service may run as another user.
    """
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if not existing.is_dir():
        return existing, f"{existing} is no folder; choose another directory"
    if os.statvfs(existing).f_flag & os.ST_RDONLY:
        return existing, f"{existing} is on a read-only file system; choose another directory"
    return existing, ""


def _check_store(config: Config) -> Iterator[Finding]:
    from vical_daemon.config.paths import state_directory
    from vical_daemon.results.export import ExportError
    from vical_daemon.results.files import read_known_file

    folder = Path(config.store.directory or state_directory() / "calibration")
    yield Finding("store", str(folder), _folder(folder)[1])
    if config.mode != "verify" or config.verify_path is None:
        return
    try:
        known, _ = read_known_file(config.verify_path)
    except ExportError as error:
        yield Finding("verify.against", str(config.verify_path), str(error))
        return
    yield Finding("verify.against", f"{config.verify_path}: {', '.join(known)}")


def _check_shared(section: str, devices: dict[str, str]) -> Iterator[Finding]:
    """Each device has one reader. The sensors of a recording are told apart by their names."""
    first: dict[str, str] = {}
    for name, device in devices.items():
        other = first.setdefault(device, name)
        if other != name and device.startswith(("/", "v4l2:", "iidc:", "aravis:")):
            place = f"{section}.{name}"
            text = f"{place}: {device} is that of {other}, too; each needs a device of its own"
            yield Finding(place, device, text)


def _check_bus(config: Config) -> Iterator[Finding]:
    """Find what keeps the bus from being hosted; nothing is opened."""
    from vical_daemon.bus.socket_paths import PATH_BYTES
    from vical_daemon.bus.zenoh_session import ENDPOINT
    from vical_daemon.cli.bus_access import socket_path

    path = socket_path(config.bus)
    if path.is_dir():
        yield Finding("bus", str(path), f"bus.socket: {path} is a folder; give the name of a socket in it")
    elif len(os.fsencode(path)) > PATH_BYTES:
        shorter = f"a socket's path has {PATH_BYTES} bytes at most; set bus.socket or VICAL_RUNTIME_DIR"
        yield Finding("bus", str(path), f"{path}: {shorter}")
    for key, endpoints in (("listen", config.bus.listen), ("connect", config.bus.connect)):
        for endpoint in endpoints:
            if not ENDPOINT.fullmatch(endpoint):
                problem = f"bus.{key}: {endpoint!r} is no endpoint: write it like tcp/127.0.0.1:7447"
                yield Finding("bus", endpoint, problem)


def _check_imu(what: str, imu: ImuConfig, open_source: Callable[[ImuConfig], ImuSource]) -> Finding:
    from vical_drivers.errors import DriverError

    try:
        with open_source(imu) as source:
            info, count = source.info, 0
            end_s = time.monotonic() + _IMU_SECONDS
            while time.monotonic() < end_s:
                count += len(source.read(0.2))
            rate_hz = source.stats().rate_hz
    except DriverError as error:
        return Finding(what, imu.port, str(error))
    firmware = f" firmware {info.firmware}" if info.firmware else ""
    text = f"{imu.port}: {info.model} serial {info.serial_number}{firmware}, {info.protocol}"
    if not count:
        return Finding(what, text, f"{imu.port}: {info.model} answers but sends no samples; power-cycle it")
    if abs(rate_hz / imu.rate_hz - 1) > 0.05:
        return Finding(what, text, f"{imu.port}: {rate_hz:.1f} Hz instead of {imu.rate_hz:g} Hz")
    return Finding(what, f"{text}, {rate_hz:.1f} Hz")


def _check_camera(
    what: str, camera: CameraConfig, open_source: Callable[[CameraConfig], FrameSource]
) -> Iterator[Finding]:
    from vical_drivers.camera.opening import check_open_camera
    from vical_drivers.errors import DriverError

    from vical_daemon.acquire.camera import driver_options

    try:
        source = open_source(camera)
    except DriverError as error:
        yield Finding(what, camera.uri, str(error))
        return
    problems = check_open_camera(source, camera.uri, **driver_options(camera))
    if not problems:
        width, height = camera.size
        yield Finding(what, f"{camera.uri}: {width} x {height} at {camera.rate_hz:g} Hz")
    for problem in problems:
        yield Finding(what, camera.uri, problem)


def _print(findings: list[Finding], *, as_json: bool) -> None:
    if not as_json:
        for finding in findings:
            print_line(finding)
        return
    print(json.dumps(document(findings)))


def document(findings: list[Finding]) -> dict[str, Any]:
    """Return what `--json` prints."""
    problems = [finding.problem for finding in findings if finding.problem]
    checked = [{"what": f.what, "found": f.text, "problem": f.problem} for f in findings]
    return {"ok": not problems, "problems": problems, "checked": checked}


def print_line(finding: Finding) -> None:
    """Print a finding for a person."""
    mark, text = ("FAIL", finding.problem) if finding.problem else ("ok", finding.text)
    print(f"{mark:<5}{finding.what:<16}{text}", flush=True)
