"""Reads a calibration from whatever holds one: a result, a log, the store, a file of other software."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.offline.errors import InputError

if TYPE_CHECKING:
    from vical_daemon.results.export import Rig
    from vical_daemon.results.known import KnownCamera


def read_known(source: str) -> tuple[dict[str, KnownCamera], Rig | None]:
    """Read what a source claims about each camera; a Kalibr file may lack the lens (then there is no rig).

    Raises:
        InputError: Nothing there that holds a calibration.
        ExportError: A file that is not of the expected form.
    """
    from vical_daemon.results.files import read_known_file
    from vical_daemon.results.known import known_cameras

    path = Path(source)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return read_known_file(path)
    rig = read_source(source)
    return known_cameras(rig, path.name), rig


def read_source(source: str) -> Rig:
    """Read a rig from whatever the source is.

    Raises:
        InputError: Nothing there that holds a calibration.
        ExportError: A file that is not of the expected form.
    """
    from vical_daemon.results.files import read_rig

    path = Path(source)
    if source == "store" and not path.exists():
        return _from_store()
    if not path.exists():
        raise InputError(f"{source}: no such file")
    if path.is_dir() or path.suffix == ".mcap" or path.name.endswith(".mcap.part"):
        return _from_log(path)
    return read_rig(path)


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
