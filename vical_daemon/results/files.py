"""Reads a calibration from a file: of ours, Kalibr's, OpenVINS's, or messages of ROS."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vical_drivers.user_files import read_text

from vical_daemon.config.foreign_files import foreign_file
from vical_daemon.config.priors import read_initial
from vical_daemon.config.strict_yaml import MAX_BYTES, ConfigError
from vical_daemon.results.export import ExportError, Rig, rig_from_json
from vical_daemon.results.export.from_ros import looks_like_ros, read_ros_yaml
from vical_daemon.results.export.kalibr import read_camchain
from vical_daemon.results.known import KnownCamera, known_cameras, known_prior

_RESULT_LIMIT = 2**25  # bytes; a result takes 0.5 kB for each second of recording: 18 hours
_EXPECTED = (
    "not a calibration that vical reads: give a result of `vical calibrate -o`, Kalibr's camchain, "
    "OpenVINS's estimator_config.yaml, or a .yaml with messages of ROS"
)


def read_rig(path: Path) -> Rig:
    """Read the rig that a file describes.

    Raises:
        ExportError: There is none in it; one line.
    """
    if not path.exists():
        raise ExportError(f"{path}: no such file")
    try:
        return _read_rig(path)
    except ExportError as error:
        raise ExportError(foreign_file(path, _RESULT_LIMIT) or str(error)) from None


def _read_rig(path: Path) -> Rig:
    if path.suffix in (".yaml", ".yml"):
        text = _read_yaml(path)
        return read_ros_yaml(text, path) if looks_like_ros(text) else read_camchain(path)
    document = _read_json(path)
    if isinstance(document.get("estimate"), dict):  # a file of the store
        devices = {
            "imu": document.get("imu_serial"),
            f"camera/{document.get('camera')}": document.get("camera_serial"),
        }
        document = document["estimate"] | {"devices": devices}
    try:
        return rig_from_json(document, note=f"vical, from {path.name}")
    except ExportError as error:
        raise ExportError(f"{path}: {error}") from None


def read_known_file(path: Path) -> tuple[dict[str, KnownCamera], Rig | None]:
    """Read what a file claims about each camera; a Kalibr file may lack the lens (then there is no rig).

    Raises:
        ExportError: No calibration in it; one line.
    """
    try:
        rig = read_rig(path)
        return known_cameras(rig, path.name), rig
    except ExportError as error:
        known = _known_without_lens(path)
        if known is None:
            raise error from None
        return known, None


def _known_without_lens(path: Path) -> dict[str, KnownCamera] | None:
    """Read a Kalibr file that may lack the lens; None if it is none.

    Raises:
        ExportError: It is one, without a mounting.
    """
    if path.suffix not in (".yaml", ".yml"):
        return None
    try:
        initial = read_initial(path)
    except ConfigError:
        return None
    topics = initial.topics
    found = {n: known_prior(n, prior, path.name, topics.get(n, "")) for n, prior in initial.cameras.items()}
    known = {name: camera for name, camera in found.items() if camera is not None}
    if not known:
        raise ExportError(f"{path}: no camera with T_cam_imu in it")
    return known


def _read_yaml(path: Path) -> str:
    try:
        return read_text(path, MAX_BYTES)
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise ExportError(f"{path}: not a text file in UTF-8") from None


def _read_json(path: Path) -> dict[str, Any]:
    """Read a result; of a file with several lines (`vical demo --json`) the last one counts."""
    try:
        text = read_text(path, _RESULT_LIMIT)
        document = json.loads(text)
    except json.JSONDecodeError as error:
        lines = [line for line in text.splitlines() if line.strip()]
        try:
            document = json.loads(lines[-1]) if lines else None
        except json.JSONDecodeError:
            raise ExportError(f"{path}: {_EXPECTED}; not JSON: {error}") from None
    except (UnicodeDecodeError, RecursionError):
        raise ExportError(f"{path}: {_EXPECTED}; not JSON") from None
    if not isinstance(document, dict):
        raise ExportError(f"{path}: {_EXPECTED}")
    return document
