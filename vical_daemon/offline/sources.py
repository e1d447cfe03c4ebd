"""Reads a calibration from whatever holds one: a result, a log, the store, a file of other software."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.offline.errors import InputError

if TYPE_CHECKING:
    from vical_daemon.results.export import Rig
    from vical_daemon.results.known import KnownCamera

_RESULT_LIMIT = 2**25  # bytes; a result takes 0.5 kB for each second of recording: 18 hours


def read_known(source: str) -> tuple[dict[str, KnownCamera], Rig | None]:
    """Read what a source claims about each camera; a Kalibr file may lack the lens (then there is no rig).

    Raises:
        InputError: Nothing there that holds a calibration.
        ExportError: A file that is not of the expected form.
    """
    from vical_daemon.config.priors import read_initial
    from vical_daemon.config.strict_yaml import ConfigError
    from vical_daemon.results.export import ExportError
    from vical_daemon.results.known import known_cameras, known_prior

    path = Path(source)
    try:
        rig = read_source(source)
        return known_cameras(rig, path.name), rig
    except ExportError as error:
        if path.suffix not in (".yaml", ".yml"):
            raise
        try:
            priors = read_initial(path).cameras
        except ConfigError:
            raise error from None
    found = {name: known_prior(name, prior, path.name) for name, prior in priors.items()}
    known = {name: camera for name, camera in found.items() if camera is not None}
    if not known:
        raise InputError(f"{source}: no camera with T_cam_imu in it")
    return known, None


def read_source(source: str) -> Rig:
    """Read a rig from whatever the source is.

    Raises:
        InputError: Nothing there that holds a calibration.
    """
    from vical_daemon.results.export import rig_from_json
    from vical_daemon.results.export.kalibr import read_camchain

    path = Path(source)
    if source == "store" and not path.exists():
        return _from_store()
    if not path.exists():
        raise InputError(f"{source}: no such file")
    if path.suffix in (".yaml", ".yml"):
        return read_camchain(path)
    if path.is_dir() or path.suffix == ".mcap" or path.name.endswith(".mcap.part"):
        return _from_log(path)
    document = _read_json(path)
    note = f"vical, from {path.name}"
    if isinstance(document.get("estimate"), dict):  # a file of the store
        devices = {
            "imu": document.get("imu_serial"),
            f"camera/{document.get('camera')}": document.get("camera_serial"),
        }
        return rig_from_json(document["estimate"] | {"devices": devices}, note=note)
    return rig_from_json(document, note=note)


def _read_json(path: Path) -> dict[str, Any]:
    """Read a result; of a file with several lines (`vical demo --json`) the last one counts."""
    from vical_drivers.user_files import read_text

    try:
        text = read_text(path, _RESULT_LIMIT)
        document = json.loads(text)
    except json.JSONDecodeError as error:
        lines = [line for line in text.splitlines() if line.strip()]
        try:
            document = json.loads(lines[-1]) if lines else None
        except json.JSONDecodeError:
            raise InputError(f"{path}: not JSON: {error}") from None
    except (UnicodeDecodeError, RecursionError):
        raise InputError(f"{path}: not JSON; give the result of `vical calibrate -o`") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: not a result of `vical calibrate --json`")
    return document


def _from_log(path: Path) -> Rig:
    """Read the last calibration of every camera, and image sizes, from our own log."""
    from vical_daemon.bus.messages import (
        CALIBRATION_TYPE,
        CAMERA_INFO_TYPE,
        POSE_TYPE,
        decode_calibration,
        decode_camera_info,
        decode_pose,
        merge_calibrations,
    )
    from vical_daemon.logs.mcap import LogReader
    from vical_daemon.results.export import rig_from_estimate

    last: dict[str, bytes] = {}
    sizes: dict[str, tuple[int, int]] = {}
    devices: dict[str, str] = {}
    frames: set[str] = set()
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    for file in files:
        reader = LogReader(file)
        for message in reader.messages():
            if message.channel.type_name == CALIBRATION_TYPE:
                last[message.channel.topic] = message.payload
            elif message.channel.type_name == POSE_TYPE:
                frames.add(decode_pose(message.payload).frame_id)
            elif message.channel.type_name == CAMERA_INFO_TYPE:
                info = decode_camera_info(message.payload)
                sizes[info.frame_id] = (info.width, info.height)
        for name, values in reader.metadata:
            devices |= values if name == "devices" else {}
    if not last:
        raise InputError(
            f"{path}: no calibration in this log; run `vical calibrate {path} --target FILE -o result.json` "
            "and export result.json"
        )
    estimate = merge_calibrations(decode_calibration(data) for data in last.values())
    rig = rig_from_estimate(estimate, sizes, note=f"vical, from {path.name}")
    return replace(rig, devices=devices, imu_frame=frames.pop() if len(frames) == 1 else rig.imu_frame)


def _from_store() -> Rig:
    """Read the newest stored calibration of every camera."""
    from dataclasses import replace as with_changes

    from vical_daemon.config.paths import state_directory
    from vical_daemon.results.export import rig_from_estimate
    from vical_daemon.results.store import CalibrationStore

    folder = state_directory() / "calibration"
    stored = sorted(CalibrationStore(folder).all(), key=lambda entry: entry.saved_ns)
    if not stored:
        raise InputError(f"no calibration is stored in {folder}: nothing has converged on this machine yet")
    cameras = {entry.camera: entry.known for entry in stored}
    estimate = with_changes(stored[-1].estimate, cameras=cameras)
    devices = {"imu": stored[-1].imu_serial} | {f"camera/{e.camera}": e.camera_serial for e in stored}
    return replace(rig_from_estimate(estimate, note="vical, from the store"), devices=devices)
