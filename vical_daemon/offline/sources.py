"""Reads a calibration from whatever holds one: a result, a log, the store, a file of other software."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.bus.messages import (
    CALIBRATION_TYPE,
    CAMERA_INFO_TYPE,
    IMU_TYPE,
    POSE_TYPE,
    TF_TYPE,
    CameraInfoMessage,
    MessageError,
    Transform,
    decode_calibration,
    decode_camera_info,
    decode_imu,
    decode_pose,
    decode_transforms,
    merge_calibrations,
)
from vical_daemon.logs import RecordingError, mcap_files
from vical_daemon.logs.bags import bag_messages, is_bag
from vical_daemon.logs.mcap import LogError, LogReader
from vical_daemon.logs.recorded_logs import RawMessage, as_cdr
from vical_daemon.offline.camera_names import camera_name
from vical_daemon.offline.errors import InputError

if TYPE_CHECKING:
    from vical_daemon.results.export import Rig
    from vical_daemon.results.known import KnownCamera

_ROS_TYPES = (CALIBRATION_TYPE, CAMERA_INFO_TYPE, IMU_TYPE, POSE_TYPE, TF_TYPE)


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
    from vical_daemon.config.paths import state_directory
    from vical_daemon.results.files import read_rig

    path = Path(source)
    if source == "store" and not path.exists():
        return _from_store(state_directory() / "calibration")
    if not path.exists():
        raise InputError(f"{source}: no such file")
    if path.is_dir() and any(path.glob("*.json")) and not any(path.glob("*.mcap")):
        return _from_store(path)
    if path.is_dir() or mcap_files(path) or is_bag(path):
        return _from_log(path)
    return read_rig(path)


def _from_log(path: Path) -> Rig:
    """Read the last calibration of every camera; from a log without one, CameraInfo and static transforms."""
    found = _Found()
    try:
        for message in _messages(path):
            found.take(message)
    except (MessageError, RecordingError, LogError) as error:
        line = str(error)
        raise InputError(line if line.startswith(str(path)) else f"{path}: {line}") from None
    return found.rig(path)


def _messages(path: Path) -> Iterator[RawMessage]:
    """Yield the messages of a log or bag as CDR; metadata of MCAP files come as messages without a type."""
    files = mcap_files(path)
    if not files and is_bag(path):
        yield from bag_messages(path, _ROS_TYPES)
        return
    for file in files:
        reader = LogReader(file)
        for m in reader.messages():
            if (raw := as_cdr(m, _ROS_TYPES)) is not None:
                yield raw
        for name, values in reader.metadata:
            yield RawMessage(name, "", 0, json.dumps(values).encode())


@dataclass(slots=True)
class _Found:
    """What a log says of a calibration."""

    last: dict[str, bytes] = field(default_factory=dict)
    infos: dict[str, CameraInfoMessage] = field(default_factory=dict)
    transforms: list[Transform] = field(default_factory=list)
    devices: dict[str, str] = field(default_factory=dict)
    parents: set[str] = field(default_factory=set)
    imu_frames: set[str] = field(default_factory=set)
    imu_topics: set[str] = field(default_factory=set)

    def take(self, m: RawMessage) -> None:
        """Take one message.

        Raises:
            MessageError: It is damaged.
        """
        if m.type_name == CALIBRATION_TYPE:
            self.last[m.topic] = m.payload
        elif m.type_name == POSE_TYPE:
            self.parents.add(decode_pose(m.payload).frame_id)
        elif m.type_name == CAMERA_INFO_TYPE:
            self.infos[m.topic] = decode_camera_info(m.payload)
        elif m.type_name == TF_TYPE and m.topic.endswith("tf_static"):
            self.transforms += decode_transforms(m.payload)
        elif m.type_name == IMU_TYPE and m.topic not in self.imu_topics:
            self.imu_topics.add(m.topic)
            self.imu_frames.add(decode_imu(m.payload).frame_id)
        elif (m.topic, m.type_name) == ("devices", ""):
            self.devices |= json.loads(m.payload)

    def rig(self, path: Path) -> Rig:
        """Return the rig.

        Raises:
            InputError: There is none.
            ExportError: ROS's messages are not complete.
        """
        from vical_daemon.results.export import rig_from_estimate
        from vical_daemon.results.export.from_ros import rig_from_ros

        if self.last:
            estimate = merge_calibrations(decode_calibration(data) for data in self.last.values())
            sizes = {info.frame_id: (info.width, info.height) for info in self.infos.values()}
            rig = rig_from_estimate(estimate, sizes, note=f"vical, from {path.name}")
            frame = next(iter(self.parents)) if len(self.parents) == 1 else rig.imu_frame
            return replace(rig, devices=self.devices, imu_frame=frame)
        if self.infos or self.transforms:
            lenses = {camera_name(topic): info for topic, info in self.infos.items()}
            return rig_from_ros(lenses, self.transforms, sorted(self.imu_frames), str(path))
        raise InputError(
            f"{path}: no calibration in this log, and no CameraInfo with static transforms; run "
            f"`vical calibrate {path} --target FILE -o result.json` and give result.json"
        )


def _from_store(folder: Path) -> Rig:
    """Read the newest stored calibration of every camera.

    Raises:
        InputError: There is none.
    """
    from vical_daemon.results.export import rig_from_estimate
    from vical_daemon.results.store import CalibrationStore

    stored = CalibrationStore(folder).all()[::-1]
    if not stored:
        raise InputError(f"no calibration is stored in {folder}: nothing has converged yet")
    cameras = {entry.camera: entry.known for entry in stored}
    estimate = replace(stored[-1].estimate, cameras=cameras)
    devices = {"imu": stored[-1].imu_serial} | {f"camera/{e.camera}": e.camera_serial for e in stored}
    return replace(rig_from_estimate(estimate, note="vical, from the store"), devices=devices)
