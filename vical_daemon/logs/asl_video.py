"""Videos as cameras of a folder: which there are, and the stamps of their images."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vical_daemon.bus.messages import encode_image
from vical_daemon.logs.asl_images import times_of
from vical_daemon.logs.model import RecordingError
from vical_daemon.logs.stamp_column import StampColumn, coarseness, column_ns
from vical_daemon.logs.stamps import StampError, numbers

if TYPE_CHECKING:
    from vical_daemon.vision.video import Video

VIDEO_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".3gp", ".mts", ".wmv", ".mpg"})
_CAMERA = re.compile(r"cam[a-z]*[0-9]*", re.ASCII)


class VideoImages(NamedTuple):
    """The images of a video.

    Attributes:
        column: Their stamps.
        own_clock: These count from the video's own zero.
        size: Width, height, px.
        build: Makes the message of one image from its number and its stamp, ns.
        warnings: One line each, without the name of the camera.
    """

    column: StampColumn
    own_clock: bool
    size: tuple[int, int]
    build: Callable[[int, int], bytes]
    warnings: list[str]


def videos_in(root: Path, taken: Collection[str]) -> tuple[dict[str, Path], list[str]]:
    """Return the videos of a folder by the names of the cameras that they are, and warnings.

    Those in ``cam0/``, those called ``cam0.mp4``; without these a single one of another name is ``cam0``.

    Args:
        root: The folder.
        taken: Cameras that have images.
    """
    found: dict[str, Path] = {}
    for place in sorted(p for p in root.glob("cam*") if p.is_dir() and p.name not in taken):
        if len(inside := _videos(place)) == 1:
            found[place.name] = inside[0]
    beside = _videos(root)
    found |= {p.stem: p for p in beside if _CAMERA.fullmatch(p.stem) and p.stem not in {*taken, *found}}
    if found or taken or not beside:
        return found, []
    if len(beside) == 1:
        return {"cam0": beside[0]}, []
    several = ", ".join(p.name for p in beside[:3]) + (" ..." if beside[3:] else "")
    return {}, [
        f"no cameras: which one is meant of the videos {several}? Name those of one recording cam0.mp4, "
        "cam1.mp4 ..., and give each further recording a folder of its own, with its IMU's table"
    ]


def _videos(folder: Path) -> list[Path]:
    """Return the videos of a folder; hidden files are those of an archive of macOS."""
    return [
        p
        for p in sorted(folder.iterdir())
        if p.suffix.lower() in VIDEO_SUFFIXES and not p.name.startswith(".") and p.is_file()
    ]


def read_video(path: Path, name: str) -> VideoImages:
    """Read the stamps of a video; its images are decoded when they are asked for.

    Stamps are those of a file with a line for each image, as apps for phones write it next to the video
    (`asl_images.times_of`), or else those of the video.

    Raises:
        RecordingError: It cannot be read.
    """
    from vical_daemon.vision.video import Video, VideoError

    try:
        video = Video(path)
    except VideoError as error:
        raise RecordingError(f"{path} {error}") from None

    def build(number: int, t_ns: int) -> bytes:
        try:
            return encode_image(t_ns, name, video.image(number), "mono8")
        except VideoError as error:
            raise RecordingError(f"{path} {error}") from None

    warnings = _oddities(video, path)
    column = _written(path, len(video.t_ns), warnings)
    own_clock = column is None
    if column is None:
        column = StampColumn(video.t_ns, *coarseness(video.t_ns))
    return VideoImages(column, own_clock, video.size, build, warnings)


def _oddities(video: Video, path: Path) -> list[str]:
    read, found = len(video.t_ns), []
    if read < video.announced:
        found.append(
            f"{read} of the {video.announced} images that {path.name} announces are read: is it cut off?"
        )
    if video.turned_deg:
        found.append(
            f"players turn {path.name} by {video.turned_deg} deg; its images are used as the sensor read them"
        )
    return found


def _written(path: Path, count: int, warnings: list[str]) -> StampColumn | None:
    """Return the stamps of a file next to a video; None: there is none that fits."""
    stamps, file = times_of(path.parent / path.stem, list(map(str, range(count))))
    if not stamps:
        if file is not None:
            warnings.append(
                f"{file.name} is not used: it has no line with a stamp for each of {count} images"
            )
        return None
    try:
        column = column_ns(numbers(stamps), "", imu=False)
    except StampError:
        return None
    return column if (np.diff(column.t_ns) > 0).all() else None
