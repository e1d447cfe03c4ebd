"""The images of one camera of an ASL/EuRoC folder: which there are, their stamps and their size."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from vical_drivers.user_files import open_file, read_text

from vical_daemon.config.strict_yaml import MAX_BYTES, ConfigError, refuse_hostile
from vical_daemon.logs.asl_tables import read_table
from vical_daemon.logs.encoded_size import HEAD, encoded_size
from vical_daemon.logs.model import RecordingError
from vical_daemon.logs.stamps import date_ns, stamp_in_name

IMAGE_SUFFIXES = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"} | {
    f".{kind}": kind for kind in ("pgm", "ppm", "bmp")
}
_OTHER_SUFFIXES = {".tif", ".tiff", ".webp", ".gif", ".jp2", ".exr", ".heic", ".raw", ".npy"}
_NUMBER = re.compile(r"-?\d+(\.\d*)?([eE][+-]?\d+)?")
_MOST = 0.9  # share of the names that are stamps; the others do not belong to the recording
_TIMES = ("times.txt", "timestamps.txt", "*timestamps.txt", "*timestamps.csv", "frames.csv")
"""Also `frame_timestamps.txt` (MARS logger), `VID_..._timestamps.csv` (OpenCamera Sensors), `frames.csv`
(ADVIO)."""
_TRIED = 50  # images whose size is looked for: the first may be damaged


class Images(NamedTuple):
    """Images of one camera.

    Attributes:
        stamps: Of each, as text.
        files: Of each.
        warnings: What was left out and why, one line each, without the name of the camera.
    """

    stamps: list[str]
    files: list[Path]
    warnings: list[str]


def image_list(table: Path, folder: Path) -> Images:
    """Return the images that ``data.csv`` lists; names cannot leave the folder.

    Raises:
        RecordingError: The table is wrong, or none of the images is there.
    """
    stamps: list[str] = []
    files, lost = [], []
    for number, line in enumerate(read_table(table).decode("utf-8", "replace").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, _, name = (part.strip() for part in line.partition(","))
        name = name.split(",")[0].strip() or stamp
        if not _is_stamp(stamp) or ".." in Path(name).parts or Path(name).is_absolute():
            raise RecordingError(
                f"{table} line {number}: expected 'timestamp [ns],filename', found '{line[:80]}'"
            )
        path = _find(folder, Path(name).name)
        if path is None:
            lost.append(name)
            continue
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            raise RecordingError(f"{path}: images must be png, jpg, pgm, ppm or bmp")
        stamps.append(stamp)
        files.append(path)
    if lost and not stamps:
        raise RecordingError(f"{table}: there is no image {lost[0]} next to it, nor any other listed")
    warnings = [f"{len(lost)} images listed but not there, first {lost[0]}"] if lost else []
    return Images(stamps, files, warnings)


def _find(folder: Path, name: str) -> Path | None:
    """Return the file of an image that a table names, with or without its ending."""
    names = [name, f"{name}.png", f"{name}.jpg"]
    return next((p for n in names for p in (folder / "data" / n, folder / n) if p.is_file()), None)


def images_by_name(folder: Path) -> Images:
    """Return the images of a folder without ``data.csv``; none where they have no stamps.

    Kalibr's `kalibr_bagcreater` reads such folders (ns); names like ``1305031102.175304`` are seconds, and
    names may hold dates. Images that are merely numbered have their stamps in ``times.txt``, a line for each,
    or none.
    """
    images = _in_order(folder, set(IMAGE_SUFFIXES))
    named = {path: stamp for path in images if (stamp := stamp_in_name(path.stem))}
    stamped = list(named)
    if images and len(named) >= _MOST * len(images) and not _counts(list(named.values())):
        rest = [path.name for path in images if path not in named]
        text = f"{len(rest)} images left out, whose names are no stamps, first {rest[:1]}"
        return Images(list(named.values()), stamped, [text] if rest else [])
    stamps, _ = times_of(folder, [path.stem for path in images])
    if stamps or not images:
        unread = _in_order(folder, _OTHER_SUFFIXES)
        text = f"{len(unread)} unreadable images, like {{}}: only png, jpg, pgm, ppm and bmp are read"
        return Images(stamps, images, [text.format(unread[0].name)] if unread and not images else [])
    other = next((path for path in images if path not in stamped), images[0])
    text = (
        f"{len(images)} images have no stamps: there is no data.csv, nor a times.txt with as many lines, and "
        f"names like {other.name} are no times in ns, nor dates to 1 ms"
    )
    return Images([], images, [text])


def times_of(folder: Path, names: list[str]) -> tuple[list[str], Path | None]:
    """Return the stamps of a file with a line for each image, `[name] stamp ...`, and that file.

    A title above them may name the column of the stamps. If lines begin with names or numbers of images, more
    lines than images may be there.

    Args:
        folder: Of the images; the file may also be next to it.
        names: Of the images, without endings.

    Returns:
        No stamps where no file has a line for each; then the file is one that has not.
    """
    places = (folder, folder / "data", folder.parent)
    files = [p for place in places for name in _TIMES for p in sorted(place.glob(name))]
    for path in files:
        if stamps := _stamps_of(path, names):
            return stamps, path
    return [], next(iter(files), None)


def _stamps_of(path: Path, names: list[str]) -> list[str]:
    rows = [
        line.replace(",", " ").split() for line in read_table(path).decode("utf-8", "replace").splitlines()
    ]
    rows = [row for row in rows if row]
    above = [row for row in rows if row[0].startswith("#") or not any(map(_is_stamp, row))]
    rows = [row for row in rows if row not in above]
    if len(rows) != len(names):
        rows = _lines_of(names, rows)
    if not rows:
        return []
    named = all(len(row) > 1 and Path(row[0]).stem == name for row, name in zip(rows, names, strict=True))
    titles = [[name for name in row if name[:1] != "[" and name != "#"] for row in above]
    titles = [title for title in titles if len(title) == len(rows[0])]
    column = next((i for title in titles for i, name in enumerate(title) if "stamp" in name), int(named))
    stamps = [row[column] for row in rows if column < len(row)]
    return stamps if len(stamps) == len(rows) and all(map(_is_stamp, stamps)) else []


def _lines_of(names: list[str], rows: list[list[str]]) -> list[list[str]]:
    """Return the line of each image by its name, or the number at the end of that; [] if one has none."""
    by_name = {Path(row[0]).stem: row for row in rows if len(row) > 1}
    by_number = {int(name): row for name, row in by_name.items() if name.isdecimal()}
    numbers = [re.findall(r"\d*$", name, re.ASCII)[0] for name in names]
    found = [by_name.get(a) or by_number.get(int(b or -1)) for a, b in zip(names, numbers, strict=True)]
    return [[name, *row[1:]] for name, row in zip(names, found, strict=True) if row] if all(found) else []


def _in_order(folder: Path, suffixes: set[str]) -> list[Path]:
    """Return the files with these endings, where there are none those in the folders inside.

    Hidden files are those of an archive of macOS. Equal names in several folders are of several cameras.
    """

    def inside(places: list[Path]) -> list[Path]:
        files = [path for place in places for path in sorted(place.iterdir(), key=_counted)]
        return [p for p in files if p.suffix.lower() in suffixes and not p.name.startswith(".")]

    found = inside([place for place in (folder / "data", folder) if place.is_dir()])
    if not found and folder.is_dir():
        found = inside([p for p in sorted(folder.iterdir(), key=_counted) if p.is_dir()])
        found = found if len({p.name for p in found}) == len(found) else []
    return found


def _counted(path: Path) -> list[tuple[int, str]]:
    """Key that sorts 2.png before 10.png."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _is_stamp(text: str) -> bool:
    return _NUMBER.fullmatch(text) is not None or date_ns(text) is not None


def _counts(stamps: list[str]) -> bool:
    """Whether what looks like stamps is a counter behind one date: 20260131_120000_001, _002 ..."""
    digits = [int(re.sub(r"\D", "", stamp)) for stamp in stamps]
    return len(digits) > 1 and all(b - a == 1 for a, b in pairwise(digits))


def image_size(folder: Path) -> tuple[int, int] | None:
    """Return the size of the first image that has one; where there are none, that in ``sensor.yaml``.

    Images may have been made smaller, or the file copied from another camera.
    """
    for path in _in_order(folder, set(IMAGE_SUFFIXES))[:_TRIED]:
        with open_file(path) as file:
            found = encoded_size(file.read(HEAD))
        if found is not None:
            return found
    sensor = folder / "sensor.yaml"
    if sensor.is_file():
        import yaml

        try:
            text = read_text(sensor, MAX_BYTES)
            refuse_hostile(text, sensor.name)
            size = yaml.safe_load(text)["resolution"]
            return int(size[0]), int(size[1])
        except (yaml.YAMLError, ConfigError, OSError, KeyError, TypeError, ValueError, IndexError):
            pass  # EuRoC's own files begin with %YAML:1.0, which some parsers refuse
    return None
