"""`vical devices`: what is plugged in, and how to name it in the config."""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path

from vical_drivers.errors import DriverError
from vical_drivers.samples import DeviceInfo

from vical_daemon.cli.options import add_json

LIMIT_S = 12.0
"""For all ports together: 4 s where nothing answers, and a slow device's answers to seven questions."""


_EPILOG = """\
To make a config from them: vical init
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "--port",
        action="append",
        default=[],
        metavar="PORT",
        help="also look for an IMU on this port (pseudo terminals are not listed); may be repeated",
    )
    parser.add_argument(
        "--no-probe", action="store_true", help="list serial ports without sending anything to them"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """List serial ports with what answers there, then cameras."""
    paths = different([*args.port, *serial_ports()])
    ports = [_unknown(path) for path in paths] if args.no_probe else probe_all(paths)
    cameras, problem = list_cameras()
    if args.json:
        print(json.dumps({"imus": ports, "cameras": [_camera(c) for c in cameras], "problem": problem}))
        return 0
    _print_ports(ports)
    for camera in cameras:
        print(f"camera  {camera.path:<24} {camera.model} {camera.serial_number}  -> {_config_uri(camera)}")
        if "problem" in camera.details:
            print(f"        {camera.details['problem']}")
    if not cameras:
        print("no camera found" + (f": {problem}" if problem else ""))
    return 0


def different(paths: list[str]) -> list[str]:
    """Leave out second names of a port: asked at once under both, it would seem to be in use."""
    found = {os.path.realpath(path): path for path in reversed(paths)}
    return [path for path in dict.fromkeys(paths) if found[os.path.realpath(path)] == path]


def probe_all(paths: list[str]) -> list[dict[str, object]]:
    """Ask all ports at once; one that is not done within `LIMIT_S` is given up, and the rest are listed."""
    if paths:
        print(f"asking {', '.join(paths)} ...", file=sys.stderr)
    found: dict[str, dict[str, object]] = {}

    def probe(path: str) -> None:
        found[path] = _probe(path)

    threads = [threading.Thread(target=probe, args=(path,), name=path, daemon=True) for path in paths]
    end_s = time.monotonic() + LIMIT_S
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end_s - time.monotonic()))
    slow = f"not done within {LIMIT_S:g} s; is something else on this port? Try: vical imu info PORT"
    return [found.get(path, {**_unknown(path), "problem": f"{path}: {slow}"}) for path in paths]


def serial_ports() -> list[str]:
    """Serial ports of this machine, by their stable names where udev made them."""
    from serial.tools import list_ports

    stable = {}
    by_id = Path("/dev/serial/by-id")
    if by_id.is_dir():
        stable = {str(link.resolve()): str(link) for link in sorted(by_id.iterdir())}
    return [stable.get(port.device, port.device) for port in sorted(list_ports.comports())]


def _unknown(path: str) -> dict[str, object]:
    return {"port": path, "found": False}


def _probe(path: str) -> dict[str, object]:
    from vical_drivers.microstrain.probe import connect

    try:
        session, port = connect(path, patient=False, advice="check power and cable")
        try:
            info = session.identify()
        finally:
            session.stop()
            port.close()
    except DriverError as error:
        return {**_unknown(path), "problem": str(error)}
    except Exception as error:  # of a library: the other ports are listed all the same
        return {**_unknown(path), "problem": f"{path}: {type(error).__name__}: {error}"}
    return {
        "port": path,
        "found": True,
        "protocol": info.protocol,
        "model": info.model,
        "serial_number": info.serial_number,
        "firmware": info.firmware,
        "baud": port.baud,
        "config": {"port": path, "protocol": info.protocol},
    }


def _print_ports(ports: list[dict[str, object]]) -> None:
    for p in ports:
        if p["found"]:
            print(
                f"imu     {p['port']:<24} {p['model']} {p['serial_number']} firmware {p['firmware']}, "
                f"{p['protocol']} at {p['baud']} baud  -> port: {p['port']}"
            )
        else:
            problem = str(p.get("problem", "not asked")).removeprefix(f"{p['port']}: ")
            print(f"serial  {p['port']:<24} {problem}")
    if not ports:
        print("no serial port found; name one with --port")


def list_cameras() -> tuple[list[DeviceInfo], str]:
    """Cameras, or why they cannot be listed."""
    try:
        from vical_drivers.camera import opening

        return list(opening.list_cameras()), ""
    except (DriverError, ImportError) as error:
        return [], str(error)


def _config_uri(camera: DeviceInfo) -> str:
    return f"uri: {camera.details.get('uri', f'{camera.protocol}:{camera.path}')}"


def _camera(camera: DeviceInfo) -> dict[str, object]:
    return {**asdict(camera), "config": {"uri": _config_uri(camera).removeprefix("uri: ")}}
