"""Says what a folder holds that is no recording as it is: others name their files in other ways."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path

from vical_daemon.logs.asl_images import IMAGE_SUFFIXES
from vical_daemon.logs.asl_video import VIDEO_SUFFIXES

UNREAD_VIDEOS = frozenset({".h264", ".h265", ".hevc", ".insv", ".svo", ".svo2"})
FROM_VIDEO = "without stamps that can be read: convert it into an .mp4, or extract its images into cam0/"
_UNPACKERS = {
    ".tar.gz": "tar -xf",
    ".tar.bz2": "tar -xf",
    ".tar.xz": "tar -xf",
    ".gz": "gunzip -k",
    ".bz2": "bunzip2 -k",
    ".xz": "unxz -k",
    ".zst": "zstd -d",
    ".zstd": "zstd -d",
    ".zip": "unzip",
    ".tar": "tar -xf",
    ".tgz": "tar -xf",
    ".7z": "7z x",
    ".rar": "unrar x",
}
_TABLES = frozenset({".csv", ".txt", ".tsv", ".json"})
_OF_RECORDINGS = frozenset({"mav0", "oxts"})  # folders: ASL, KITTI
_LOGS = frozenset({".mcap", ".bag", ".db3"})
_LOOKED_AT = 200  # entries of a folder; what is in it shows in the first ones
_PARTS = ("mav0", "imu", "cam", "oxts", "image_")
_UP = 3  # folders up from mav0/imu0/data.csv
_NAMED = 4  # in a message of one line


def what_is_there(folder: Path) -> str:
    """Return what a user may have meant, beginning with a semicolon; empty: nothing is known.

    Args:
        folder: That was given.
    """
    if whole := whole_recording(folder):
        return f"; it is part of a recording: give {whole}"
    entries = _entries(folder)
    recordings = [
        e.name for e in entries if any(x.name in _OF_RECORDINGS or x.suffix in _LOGS for x in _entries(e))
    ]
    if recordings:
        return f"; found recordings in it: give one of {_listed(recordings)}"
    tables = [e.name for e in entries if e.suffix.lower() in _TABLES]
    videos = [e.name for e in entries if e.suffix.lower() in VIDEO_SUFFIXES]
    found = [
        images_in(folder),
        f"tables {_listed(tables)}" if tables else "",
        f"videos {_listed(videos)}" if videos else "",
        unread_in(folder),
    ]
    return f"; found {', '.join(filter(None, found))}" if any(found) else ""


def whole_recording(part: Path) -> str:
    """Return the recording above a folder or table that is its imu or one of its cameras; empty: none."""
    for place in list(part.parents)[:_UP]:
        inside = {p.name for p in _entries(place)}
        whole = "mav0" in inside or {"imu0", "cam0"} <= inside or {"oxts", "image_00"} <= inside
        if whole and part.relative_to(place).parts[0].startswith(_PARTS):
            return str(place)
    return ""


def images_in(folder: Path) -> str:
    """Return which folders inside of a folder, or of one in it, hold images; empty: none."""
    folders = [folder, *(place for entry in _entries(folder) for place in (entry, *_entries(entry)))]
    names = [
        f"{place.relative_to(folder)}/".replace("./", "the folder itself")
        for place in folders
        if any(file.suffix.lower() in IMAGE_SUFFIXES for file in _entries(place))
    ]
    return f"images in {_listed(names)}" if names else ""


def unread_in(folder: Path) -> str:
    """Return which videos and archives of a folder are not read, and what to do; empty: none."""
    videos = [e.name for e in _entries(folder) if e.suffix.lower() in UNREAD_VIDEOS]
    if videos:
        return f"{_listed(videos)} ({FROM_VIDEO})"
    packed = [e for e in _entries(folder) if unpacker(e) and not is_packed_table(e)]
    return f"{_listed([e.name for e in packed])} (unpack: {unpacker(packed[0])})" if packed else ""


def is_packed_table(path: Path) -> bool:
    """Whether this is a table that is read as it is."""
    return path.name.lower().endswith(".csv.gz")


def unpacker(path: Path) -> str:
    """Return the command that unpacks a file; empty: it is not packed."""
    name = path.name.lower()
    command = next((command for suffix, command in _UNPACKERS.items() if name.endswith(suffix)), "")
    return f"{command} {path.name}" if command else ""


def _entries(folder: Path) -> list[Path]:
    """Return the first entries of a folder by name; none where it is none, or may not be read."""
    try:
        with os.scandir(folder) as scan:
            return sorted(Path(entry.path) for entry in islice(scan, _LOOKED_AT))
    except OSError:
        return []


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
