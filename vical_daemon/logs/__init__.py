"""Reads recordings of every kind, as messages in order of their stamps.

`open_recording` takes an MCAP of ours or of ROS 2, a folder of MCAP segments, a ROS 2 bag folder, a
ROS 1 bag or an ASL/EuRoC folder, checks that units and rates can be right, and returns a `Recording`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from pathlib import Path

from vical_drivers.user_files import read_text

from vical_daemon.config.strict_yaml import MAX_BYTES
from vical_daemon.estimation.inertial.units import ImuArrays
from vical_daemon.logs.asl import AslRecording
from vical_daemon.logs.asl_tables import is_table
from vical_daemon.logs.asl_video import VIDEO_SUFFIXES
from vical_daemon.logs.bags import BagRecording, is_bag
from vical_daemon.logs.checks import Part, check_camera, check_imu
from vical_daemon.logs.mcap import segments_in
from vical_daemon.logs.model import Kind, Recording, RecordingError, Stream, meant
from vical_daemon.logs.recorded_logs import McapRecording
from vical_daemon.logs.what_is_there import FROM_VIDEO, UNREAD_VIDEOS, unpacker, what_is_there

__all__ = [
    "LEFT_OUT",
    "ImuArrays",
    "Kind",
    "Recording",
    "RecordingError",
    "Stream",
    "check_camera",
    "check_recording",
    "mcap_files",
    "meant",
    "open_recording",
    "unfit_imus",
]

LEFT_OUT = "left out, another is used:"
"""How the warning of a sensor begins that is not fit, see `check_recording`."""


def open_recording(
    path: Path | str,
    *,
    topics: Collection[str] | None = None,
    cameras: Collection[str] = (),
    imus: Collection[str] = (),
    check: bool = True,
    as_recorded: bool = False,
    skip_s: float = 0.0,
    seconds: float | None = None,
) -> Recording:
    """Open a recording of any kind.

    Args:
        path: File or folder.
        topics: Topics, or names of imus and cameras, to take; None: all that can be used.
        cameras: Of the cameras only these, where there is one of them: what belongs to others may be as
            broken as it likes.
        imus: The same for imus.
        as_recorded: Leave the stamps alone. Otherwise readings and images that were stamped on arrival are
            put on the even grid of their device (`even_stamps`, `even_images`), with a warning.
        check: Refuse wrong units, rates and clocks, and leave out sensors that are not meant
            (`check_recording`).
        skip_s: Of the IMU only what comes so much later is checked, s; the rest is not used.
        seconds: And only so much of it, s; None: all.

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
        recording.streams = check_recording(recording, cameras, imus, skip_s, seconds)
    return recording


def check_recording(
    recording: Recording,
    cameras: Collection[str] = (),
    imus: Collection[str] = (),
    skip_s: float = 0.0,
    seconds: float | None = None,
) -> tuple[Stream, ...]:
    """Check units, rates and overlap; adds to `recording.warnings`.

    Args:
        recording: What to check.
        cameras: Those that are meant, where there is one of them; otherwise all.
        imus: The same for imus.
        skip_s: See `open_recording`.
        seconds: See `open_recording`.

    Returns:
        The streams to use: those that are meant. Of all, those that are not fit are left out with a warning
        (a laser scanner's imu in g, next to another one).

    Raises:
        RecordingError: A value is implausible, or imu or camera are missing.
    """
    if not recording.imus:
        sources = ", ".join(s.source for s in recording.streams)
        unread = "".join(f"; {text}" for text in recording.warnings if "unreadable" in text)
        there = what_is_there(recording.path)
        expected = "; imu0.csv or imu0/data.csv is expected" if there else ""
        found = f"found only {sources}{unread}{expected}{there}"
        raise RecordingError(f"{recording.path} holds no IMU data: {found}")

    part = Part(recording.begin_ns, skip_s, seconds)

    def imu(stream: Stream) -> list[str]:
        name = stream.name
        samples = recording.imu_arrays(name)
        found = check_imu(name, samples, recording.set_back.get(name), part)
        if len(recording.imus) > 1 and not samples.gyro_rps.any():  # it takes no other's place
            raise RecordingError(found[0])
        return found

    fit = _fit(recording, recording.imus, imus, imu)
    readings = list(fit.values())

    def camera(stream: Stream) -> list[str]:
        return check_camera(stream, [] if stream.name in recording.unplaced else readings)

    shown = _fit(recording, recording.cameras, cameras, camera)
    of_cameras = [s for s in recording.streams if s.kind != "imu" and s.name in shown]
    for other in of_cameras:
        stream = shown[other.name]
        if stream.kind in ("image", "compressed") and other != stream:
            recording.warnings.append(
                f"{other.name}: {stream.source} is used ({stream.count} images), not {other.source} "
                f"({other.count})"
            )
    return (*readings, *of_cameras)


def unfit_imus(recording: Recording) -> list[str]:
    """Say which imus `vical calibrate` would not take, one line each."""
    found = []
    for name in recording.imus:
        try:
            check_imu(name, recording.imu_arrays(name), recording.set_back.get(name))
        except RecordingError as error:
            found.append(f"not fit for calibration: {error}")
    return found


def _fit(
    recording: Recording,
    sensors: dict[str, Stream],
    names: Collection[str],
    check: Callable[[Stream], list[str]],
) -> dict[str, Stream]:
    """Return the sensors of one kind that can be used, of those that are meant (none of them there: all).

    Raises:
        RecordingError: One that is meant is not fit, or of all none is.
    """
    wanted = {meant(sensors, name) for name in names}
    named = [name for name in sensors if name in wanted]
    unfit: dict[str, RecordingError] = {}
    for name in named or sensors:
        try:
            recording.warnings.extend(check(sensors[name]))
        except RecordingError as error:
            unfit[name] = error
    if unfit and (named or len(unfit) == len(sensors)):
        raise next(iter(unfit.values()))
    recording.warnings.extend(f"{LEFT_OUT} {error}" for error in unfit.values())
    return {name: sensors[name] for name in named or sensors if name not in unfit}


_NEEDED = "expected an .mcap or .bag file, a ROS 2 bag folder or an ASL folder (with mav0/imu0/data.csv)"
_MESSAGES_PACKED = re.compile(r"^\s*compression_mode:\s*['\"]?message", re.IGNORECASE | re.MULTILINE)


def _open(
    path: Path, topics: Collection[str] | None, cameras: Collection[str], as_recorded: bool
) -> Recording:
    if mcap_files(path):
        return McapRecording(path, topics, as_recorded=as_recorded)
    if path.is_dir():
        if is_bag(path):
            return BagRecording(path, topics, as_recorded=as_recorded)
        if any(path.glob("*.bag")):
            raise RecordingError(f"{path} holds ROS 1 bags: give the files, {path}/*.bag")
        return AslRecording(path, topics, cameras, as_recorded=as_recorded)
    of_a_bag = (path.parent / "metadata.yaml").is_file()
    if of_a_bag and path.name.endswith((".db3", ".db3.zstd", ".mcap", ".mcap.zstd", "metadata.yaml")):
        return BagRecording(path.parent, topics, as_recorded=as_recorded)
    if is_bag(path):
        return BagRecording(path, topics, as_recorded=as_recorded)
    if path.is_file() and is_table(path):
        return AslRecording(path, topics, as_recorded=as_recorded)
    raise RecordingError(f"{path} {_why_not(path)}")


def mcap_files(path: Path) -> list[Path]:
    """Return the MCAP files of a recording, also of a ROS 2 bag; none: it is of another kind.

    Our reader bears damage, that of bags does not.
    """
    if path.is_dir():
        return [] if _packs_messages(path) else segments_in(path)
    named = path.suffix == ".mcap" or path.name.endswith(".mcap.part")
    return [path] if named and not _packs_messages(path.parent) else []


def _packs_messages(bag: Path) -> bool:
    """Whether each message of a ROS 2 bag is packed, which only its metadata tells."""
    try:
        return bool(_MESSAGES_PACKED.search(read_text(bag / "metadata.yaml", MAX_BYTES)))
    except (OSError, UnicodeDecodeError):
        return False


def _why_not(path: Path) -> str:
    """Say why a file is no recording, and what to do."""
    if not path.is_file():
        return "is a pipe or a device: a recording is read more than once, copy it into a file"
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return "is a video: give the folder that holds it and a table of the IMU's readings (imu0.csv)"
    if path.suffix.lower() in UNREAD_VIDEOS:
        return f"is a video {FROM_VIDEO}"
    if path.suffix.lower() in (".yaml", ".yml"):
        return "is no recording: give a target with --target, Kalibr's camchain or imu.yaml with --initial"
    if command := unpacker(path):
        return f"is packed: {command}"
    return f"is no recording: {_NEEDED}"
