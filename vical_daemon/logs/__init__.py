"""Reads recordings of every kind, as messages in order of their stamps.

`open_recording` takes an MCAP of ours or of ROS 2, a folder of MCAP segments, a ROS 2 bag folder, a
ROS 1 bag or an ASL/EuRoC folder, checks that units and rates can be right, and returns a `Recording`.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from vical_daemon.logs.asl import AslRecording
from vical_daemon.logs.bags import BagRecording
from vical_daemon.logs.checks import check_camera, check_imu
from vical_daemon.logs.mcap import segments_in
from vical_daemon.logs.model import ImuArrays, Kind, Recording, RecordingError, Stream
from vical_daemon.logs.recorded_logs import McapRecording

__all__ = ["ImuArrays", "Kind", "Recording", "RecordingError", "Stream", "check_recording", "open_recording"]


def open_recording(
    path: Path | str,
    *,
    topics: Collection[str] | None = None,
    cameras: Collection[str] = (),
    check: bool = True,
    as_recorded: bool = False,
) -> Recording:
    """Open a recording of any kind.

    Args:
        path: File or folder.
        topics: Topics, or names of imus and cameras, to take; None: all that can be used.
        cameras: Of the cameras only these, where there is one of them: files of an ASL folder that belong to
            others may be as broken as they like.
        as_recorded: Leave the stamps alone. Otherwise readings and images that were stamped on arrival are
            put on the even grid of their device (`even_stamps`, `even_images`), with a warning.
        check: Refuse wrong units, rates and clocks (`check_recording`).

    Raises:
        RecordingError: It cannot be used; the message is one line with a remedy.
    """
    if not str(path):
        raise RecordingError("the name of the recording is empty; is the shell's variable set?")
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path} does not exist; check the path")
    recording = _open(path, topics, cameras, as_recorded)
    if check:
        check_recording(recording)
    return recording


def check_recording(recording: Recording) -> None:
    """Check units, rates and overlap; adds to `recording.warnings`.

    Raises:
        RecordingError: A value is implausible, or imu or camera are missing.
    """
    if not recording.imus:
        raise RecordingError(f"{recording.path} holds no IMU data; `vical info` shows what is in it")
    for name in recording.imus:
        recording.warnings.extend(check_imu(name, recording.imu_arrays(name)))
    for stream in recording.cameras.values():
        recording.warnings.extend(check_camera(stream, list(recording.imus.values())))


def _open(
    path: Path, topics: Collection[str] | None, cameras: Collection[str], as_recorded: bool
) -> Recording:
    if path.is_dir():
        if segments_in(path):  # also of a ROS 2 bag folder: our reader bears damage
            return McapRecording(path, topics, as_recorded=as_recorded)
        if (path / "metadata.yaml").is_file():
            return BagRecording(path, topics, as_recorded=as_recorded)
        return AslRecording(path, topics, cameras, as_recorded=as_recorded)
    if path.suffix == ".bag":
        return BagRecording(path, topics, as_recorded=as_recorded)
    if path.suffix == ".mcap" or path.name.endswith(".mcap.part"):
        return McapRecording(path, topics, as_recorded=as_recorded)
    if path.suffix == ".db3" and (path.parent / "metadata.yaml").is_file():
        return BagRecording(path.parent, topics, as_recorded=as_recorded)
    raise RecordingError(
        f"{path} is no recording: expected an .mcap or .bag file, a ROS 2 bag folder or an ASL folder "
        "(with mav0/imu0/data.csv)"
    )
