"""Reads ASL/EuRoC folders: ``mav0/imu0/data.csv`` and ``mav0/cam0/`` with images, corners or tracks.

Folders of Kalibr's `kalibr_bagcreater` as well: ``imu0.csv`` next to ``cam0/``, images named by their stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from vical_drivers.user_files import read_file

from vical_daemon.bus.messages import encode_compressed_image, encode_imu, encode_points
from vical_daemon.bus.topics import COMPRESSED, IMAGE, IMU, POINTS, TRACKS, TopicError
from vical_daemon.estimation.inertial.units import ImuArrays
from vical_daemon.estimation.measurements import IntArray
from vical_daemon.logs.asl_images import IMAGE_SUFFIXES, Images, image_list, image_size, images_by_name
from vical_daemon.logs.asl_tables import (
    columns_of,
    imu_tables,
    load_table,
    read_table,
    without_cut_line,
)
from vical_daemon.logs.asl_video import read_video, videos_in
from vical_daemon.logs.checks import take_turns
from vical_daemon.logs.even_images import CameraStamps, PointReader, already_even, mark_of
from vical_daemon.logs.even_stamps import even_stamps
from vical_daemon.logs.model import (
    Kind,
    Recording,
    RecordingError,
    Stream,
    stream_statistics,
)
from vical_daemon.logs.stamp_column import StampColumn, column_ns, counter_ns
from vical_daemon.logs.stamps import StampError, not_a_stamp, numbers, set_back
from vical_daemon.logs.table_text import FIRST_ROW, titles
from vical_daemon.logs.titled_columns import (
    IN_DEGREES,
    columns_by_title,
    counts_only,
    degrees_named,
    rate_named,
    reordered,
)
from vical_daemon.logs.two_tables import SensorTable, one_table, two_sensors
from vical_daemon.logs.united_imu import forces_at
from vical_daemon.logs.what_is_there import images_in, unread_in, what_is_there

RIG = "rig0"
_CAMERAS = ("cam*", "image_[0-9]*")  # KITTI has image_00 to image_03
_UNITED = "imu0"  # name of an IMU of two tables
_IMU_ROW = np.dtype([("t", "<i8"), ("values", "<f8", (6,))])
_POINT_ROW = np.dtype([("t", "<i8"), ("id", "<i8"), ("uv", "<f8", (2,))])
_MOST_FRESH = 0.8  # share of stamps that come once; below it two devices may share a table
_BLOCK = 4096  # readings that are turned into messages together
_IMAGE_LIMIT = 2**28  # bytes; larger than any camera's uncompressed frame


def _refuse_lost_digits(path: Path, texts: npt.NDArray[Any], column: StampColumn) -> None:
    """Refuse stamps like 1.404733e+18, or 45000.12346 days, which do not tell one reading from the next.

    Raises:
        RecordingError: Most stamps are equal to others, and are written with an exponent, or as days.
    """
    different, count = len(np.unique(column.t_ns)), len(column.t_ns)
    if different < count / 2 and ("e" in texts[0].lower() or "days" in column.report):
        raise RecordingError(
            f"{path}: only {different} different stamps in {count} rows, written like {texts[0]}: digits "
            "are lost; write them as integers, nanoseconds"
        )


@dataclass(frozen=True, slots=True)
class _Source:
    """A stream, its sorted stamps, and how to build its i-th message."""

    stream: Stream
    t_ns: IntArray
    build: Callable[[int], bytes]


class AslRecording(Recording):
    """An ASL folder; numbers are read without rounding."""

    def __init__(
        self,
        folder: Path,
        names: Collection[str] | None = None,
        cameras: Collection[str] = (),
        *,
        as_recorded: bool = False,
    ) -> None:
        """Parse the tables (images are read later, one by one).

        Args:
            folder: With `mav0`, or that itself; or a table of inertial readings.
            names: Imus and cameras to read; None: all. Files of others are not read.
            cameras: Of the cameras only these, if the folder has one of them.
            as_recorded: Leave the stamps alone.

        Raises:
            RecordingError: The imu or the camera is missing, or a table cannot be read.
        """
        self.path = folder
        self.rig = RIG
        self.warnings = []
        self.stamp_sigma_s = {}
        self.set_back = {}
        self.added_ns: dict[str, int] = {}
        self.unplaced: set[str] = set()
        self._as_recorded = as_recorded
        self.imu_tables: dict[str, ImuArrays] = {}
        root = folder / "mav0" if (folder / "mav0").is_dir() else folder
        self._sources: list[_Source] = []
        imus = {"imu0": folder} if folder.is_file() else imu_tables(root)
        for name, table in imus.items():
            if names is None or name in names:
                self._sources.append(self._read_imu(table, name))
        if not imus and (names is None or _UNITED in names):
            self._sources.extend(self._imu_of_others(root))
        folders = sorted(p for name in _CAMERAS for p in root.glob(name) if p.is_dir())
        wanted = [path for path in folders if path.name in cameras] or folders
        for camera in wanted:
            if names is not None and camera.name not in names:
                continue
            source = self._read_camera(camera)
            if source is not None:
                self._sources.append(source)
        if root.is_dir() and self.imu_tables:
            self._read_videos(root, names, cameras)
        self.streams = tuple(source.stream for source in self._sources)
        if not self.streams and names is not None and imus:
            raise RecordingError(f"{folder} holds none of {', '.join(sorted(names))}")
        self._refuse_nothing(root)
        if not (folders or self.cameras) and names is None:
            lost = images_in(root) or unread_in(root)
            self.warnings += [f"no cameras: their folders must be cam0, cam1 ...; found {lost}"] * bool(lost)

    def _refuse_nothing(self, root: Path) -> None:
        """Refuse a folder without anything that can be read, and say what is expected."""
        if not self.streams:
            raise RecordingError(
                f"{self.path} is no ASL folder, and holds neither .mcap files nor a ROS 2 bag: expected "
                "mav0/imu0/data.csv and mav0/cam0/ with data.csv, corners.csv[.gz] or tracks.csv[.gz], or "
                "Kalibr's imu0.csv and cam0/ with images named by their stamps, ns, or imu0.csv and a video"
                f"{what_is_there(root)}"
            )

    def imu_arrays(self, name: str) -> ImuArrays:
        """See `Recording.imu_arrays`."""
        return self.imu_tables[name]

    def _messages(self, keys: set[str]) -> Iterator[tuple[str, bytes]]:
        sources = sorted(
            (s for s in self._sources if s.stream.key in keys),
            key=lambda s: (s.stream.kind != "imu", s.stream.key),
        )
        if not sources:
            return
        stamps = np.concatenate([source.t_ns for source in sources])
        owner = np.concatenate([np.full(len(s.t_ns), i) for i, s in enumerate(sources)])
        index = np.concatenate([np.arange(len(source.t_ns)) for source in sources])
        order = np.lexsort((index, owner, stamps))
        for which, i in zip(owner[order].tolist(), index[order].tolist(), strict=True):
            source = sources[which]
            yield source.stream.key, source.build(i)

    def _imu_of_others(self, root: Path) -> list[_Source]:
        """Return the IMU of a folder whose tables have other names; []: there is none."""
        if (table := one_table(root)) is not None:
            self.warnings.append(f"{_UNITED}: {table.name} is read, whose title names all six axes")
            return [self._read_imu(table, _UNITED)]
        pair = two_sensors(root)
        return [] if pair is None else [self._one_of(*pair)]

    def _one_of(self, gyro: SensorTable, accel: SensorTable) -> _Source:
        """Make one IMU of a gyro and an accelerometer, which were read apart."""
        rows = np.empty(len(gyro.t_ns), _IMU_ROW)
        rows["t"], rows["values"][:, :3] = gyro.t_ns, gyro.axes
        rows["values"][:, 3:] = forces_at(gyro.t_ns, accel.t_ns, accel.axes)
        within = np.flatnonzero(np.isfinite(rows["values"][:, 3]))
        if not len(within):
            raise RecordingError(
                f"{gyro.path} and {accel.path.name} were not recorded at the same time by their stamps"
            )
        rows = rows[within[0] : within[-1] + 1]
        self._note_stamps(_UNITED, float(np.hypot(gyro.sigma_s, accel.sigma_s)), gyro.report)
        used = f"the gyro of {gyro.path.name}, and the accelerometer of {accel.path.name}"
        self.warnings.append(f"{_UNITED}: {used} interpolated to its stamps")
        return self._imu_source(rows, _UNITED, gyro.path)

    def _read_imu(self, path: Path, name: str) -> _Source:
        rows = self._load(path, name, _IMU_ROW, "timestamp [ns], 3 gyro and 3 accelerometer columns")
        return self._imu_source(rows, name, path)

    def _imu_source(self, rows: npt.NDArray[Any], name: str, path: Path) -> _Source:
        finite = np.isfinite(rows["values"]).all(axis=1) & rows["values"].any(axis=1)
        if not finite.any():
            raise RecordingError(
                f"{path}: no row holds both gyro and accelerometer; were they read at different times? Write "
                "each into its own table, gyro.csv and accel.csv"
            )
        rows = self._even(rows[finite], name)
        if not finite.all():
            text = f"{int((~finite).sum())} samples that are not finite, or all 0, left out"
            self.warnings.append(f"{name}: {text}")
        gyro = np.ascontiguousarray(rows["values"][:, :3])
        force = np.ascontiguousarray(rows["values"][:, 3:])
        t_ns = np.ascontiguousarray(rows["t"])
        self.imu_tables[name] = ImuArrays(t_ns, gyro, force)
        number, block = -1, list[tuple[int, list[float], list[float]]]()

        def build(i: int) -> bytes:
            nonlocal number, block
            if i // _BLOCK != number:  # all rows as Python's numbers would take ten times the arrays
                number = i // _BLOCK
                part = slice(number * _BLOCK, (number + 1) * _BLOCK)
                block = list(zip(t_ns[part].tolist(), gyro[part].tolist(), force[part].tolist(), strict=True))
            stamp_ns, rates, forces = block[i % _BLOCK]
            return encode_imu(stamp_ns, name, rates, forces)

        return _Source(self._stream("imu", name, path, t_ns), t_ns, build)

    def _read_camera(self, folder: Path) -> _Source | None:
        kinds: tuple[tuple[str, Kind], ...] = (("corners", "points"), ("tracks", "tracks"))
        for stem, kind in kinds:
            for path in (folder / f"{stem}.csv", folder / f"{stem}.csv.gz"):
                if path.is_file():
                    return self._read_points(path, folder.name, kind)
        for path in (folder / "data.csv", folder / "data.csv.gz"):
            if path.is_file():
                return self._read_images(path, image_list(path, folder))
        images = images_by_name(folder)
        if images.stamps:
            return self._read_images(folder / "data", images)
        self.warnings.extend(f"{folder.name}: {text}" for text in images.warnings)
        return None

    def _read_points(self, path: Path, name: str, kind: Kind) -> _Source:
        rows = self._load(path, name, _POINT_ROW, "timestamp [ns], id, u and v columns")
        finite = np.isfinite(rows["uv"]).all(axis=1)
        if not finite.all():
            self.warnings.append(f"{name}: {int((~finite).sum())} points that are not finite left out")
        rows = self._sorted(rows[finite], name, drop_equal=False)
        rows = self._without_twins(rows, name)
        t_ns, begins = np.unique(rows["t"], return_index=True)
        ends = np.append(begins[1:], len(rows)).tolist()
        ids, uv = np.ascontiguousarray(rows["id"]), np.ascontiguousarray(rows["uv"])
        first = begins.tolist()
        size = self._stream(kind, name, path, t_ns).resolution or (0, 0)

        def build(i: int) -> bytes:
            part = slice(first[i], ends[i])
            return encode_points(int(t_ns[i]), name, ids[part], uv[part], image_size=size)

        t_ns = self._even_images(kind, name, t_ns, build)
        extent = np.percentile(uv, 99.0, axis=0) if len(uv) else np.zeros(2)  # a few may be wrong
        stream = replace(self._stream(kind, name, path, t_ns), extent_px=(float(extent[0]), float(extent[1])))
        return _Source(stream, t_ns, build)

    def _read_images(self, table: Path, images: Images) -> _Source:
        folder = table.parent
        stamps, files, warnings = images
        self.warnings.extend(f"{folder.name}: {text}" for text in warnings)
        if not stamps:
            raise RecordingError(f"{table}: no images listed")
        try:
            column = column_ns(numbers(stamps), "", imu=False)
        except StampError as error:
            raise RecordingError(f"{table}: {not_a_stamp(stamps[error.index])}") from None
        self._note_stamps(folder.name, column.sigma_s, column.report)
        order = np.argsort(column.t_ns, kind="stable")
        t_ns = column.t_ns[order]
        files = [files[i] for i in order.tolist()]

        def build(i: int) -> bytes:
            path = files[i]
            try:
                data = read_file(path, _IMAGE_LIMIT)
            except OSError as error:
                raise RecordingError(f"{path}: {error.strerror}") from None
            return encode_compressed_image(
                int(t_ns[i]), folder.name, IMAGE_SUFFIXES[path.suffix.lower()], data
            )

        if len(t_ns):
            t_ns = self._even_images("compressed", folder.name, t_ns, build)
        return _Source(self._stream("compressed", folder.name, table, t_ns), t_ns, build)

    def _read_videos(self, root: Path, names: Collection[str] | None, cameras: Collection[str]) -> None:
        taken = {s.stream.name for s in self._sources if s.stream.kind != "imu"}
        videos, warnings = videos_in(root, taken)
        self.warnings.extend(warnings)
        for name in [name for name in videos if name in cameras] or videos:
            if names is None or name in names:
                self._sources.append(self._read_video(videos[name], name))

    def _read_video(self, path: Path, name: str) -> _Source:
        video = read_video(path, name)
        self.warnings.extend(f"{name}: {text}" for text in video.warnings)
        self._note_stamps(name, video.column.sigma_s, video.column.report)
        t_ns = video.column.t_ns

        def build(i: int) -> bytes:
            return video.build(i, int(t_ns[i]))

        t_ns = self._even_images("image", name, t_ns, build)
        if video.own_clock:
            if self._as_recorded:
                self.warnings.append(
                    f"{name}: {path.name} has a clock of its own, taken to begin with the IMU's"
                )
            imu_ns = [s.stream.begin_ns for s in self._sources if s.stream.kind == "imu"]
            self.added_ns[name] = min(imu_ns, default=0) - int(t_ns[0])
            self.unplaced.add(name)
            t_ns += self.added_ns[name]
        return _Source(replace(self._stream("image", name, path, t_ns), resolution=video.size), t_ns, build)

    def place(self, camera: str, by_ns: int) -> None:
        """See `Recording.place`."""
        self.unplaced.remove(camera)
        self.added_ns[camera] += by_ns
        for k, source in enumerate(self._sources):
            if source.stream.name == camera:
                t_ns = source.t_ns
                t_ns += by_ns  # in place: `build` reads them there
                stream = replace(source.stream, begin_ns=int(t_ns[0]), end_ns=int(t_ns[-1]))
                self._sources[k] = replace(source, stream=stream)
                self.streams = tuple(stream if s.name == camera else s for s in self.streams)

    def _load(self, path: Path, sensor: str, dtype: np.dtype[Any], columns: str) -> npt.NDArray[Any]:
        """Parse a table, plain or gzipped; a last line that was cut off while it was written is left out."""
        text = read_table(path)
        lines = titles(text)
        title = next(filter(columns_by_title, lines), "".join(lines[:1]))
        if dtype == _IMU_ROW and degrees_named(title):
            raise RecordingError(f"{path}: {IN_DEGREES}")
        named = columns_by_title(title) if dtype == _IMU_ROW else None
        if named is not None and not named.in_order:
            text = reordered(text, named)
            if FIRST_ROW.search(text) is None:
                raise RecordingError(f"{path}: its column of stamps has no numbers; log them, too")
            self.warnings.append(
                f"{sensor}: its title names the columns in another order; read by their names"
            )
        whole = without_cut_line(text, columns_of(dtype))
        if len(whole) < len(text):
            self.warnings.append(f"{sensor}: the last line of {path.name} is cut off; 1 line left out")
        rows = load_table(whole, path, dtype, columns)
        try:
            stamps = rows["t"] if rows["t"].dtype.kind == "i" else numbers(rows["t"].tolist())
            if dtype == _IMU_ROW and counts_only(title):
                stamps, title = self._counted(stamps, lines, path, sensor), "ns"
            column = column_ns(stamps, title, imu=dtype == _IMU_ROW)
        except StampError as error:
            text_ = not_a_stamp(str(rows["t"][error.index]))
            raise RecordingError(f"{path}: row {error.index + 1} of the data: {text_}") from None
        self._note_stamps(sensor, column.sigma_s, column.report)
        if back := set_back(column.t_ns):
            self.set_back[sensor] = back
        if dtype == _IMU_ROW and rows["t"].dtype.kind == "U":
            _refuse_lost_digits(path, rows["t"], column)
        out = np.empty(len(rows), dtype)
        out["t"] = column.t_ns
        for name in (dtype.names or ())[1:]:
            out[name] = rows[name]
        return out

    def _counted(self, ticks: Any, lines: list[str], path: Path, sensor: str) -> IntArray:
        """Return the stamps of rows that are merely numbered, if a line above them names the rate."""
        rate_hz = rate_named(lines)
        if not rate_hz:
            raise RecordingError(
                f"{path}: its rows have a counter, but no time, and no line above them names the rate (like "
                "Update Rate: 100.0Hz): export the time, too (Xsens: SampleTimeFine)"
            )
        self.warnings.append(f"{sensor}: its rows are counted; the {rate_hz:g} Hz named date them")
        return counter_ns(np.array(ticks, dtype=np.int64), rate_hz)

    def _note_stamps(self, name: str, sigma_s: float, report: str = "") -> None:
        """Add what is found about the stamps of a sensor; errors of several causes add up."""
        if report:
            self.warnings.append(f"{name}: {report}")
        if sigma_s:
            self.stamp_sigma_s[name] = float(np.hypot(self.stamp_sigma_s.get(name, 0.0), sigma_s))

    def _even(self, rows: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
        """Put readings that were stamped on arrival on an even grid; others in order of their stamps."""
        again = np.append(False, rows[1:] == rows[:-1])  # a row written twice is no reading
        even = None if self._as_recorded else even_stamps(rows["t"][~again], rows["values"][~again, :3])
        if even is None:
            return self._sorted(rows, name, drop_equal=True)
        self.warnings.append(even.describe(name))
        self._note_stamps(name, even.sigma_s)
        rows = rows[~again]
        rows["t"] = even.t_ns
        return rows

    def _even_images(self, kind: Kind, name: str, t_ns: IntArray, build: Callable[[int], bytes]) -> IntArray:
        """Return better stamps of images that were stamped on arrival; others as they are."""
        if self._as_recorded or already_even(t_ns):
            return t_ns
        marks = np.arange(len(t_ns))  # whether files of images are equal would take long to find out
        if kind in ("points", "tracks"):
            marks = np.array([mark_of(build(i)) for i in range(len(t_ns))], dtype=np.int64)
        stamps = CameraStamps(t_ns, marks)
        wanted, reader = stamps.wanted, PointReader(kind)
        for i, stamp_ns in enumerate(t_ns.tolist()):
            if stamp_ns in wanted:
                stamps.take(stamp_ns, reader.read(build(i)))
        even = stamps.even()
        if even is None:
            return t_ns
        self.warnings.append(even.describe(name, "images"))
        self._note_stamps(name, even.sigma_s)
        better = dict(zip(stamps.t_ns.tolist(), even.t_ns.tolist(), strict=True))
        return np.array([better[t] for t in t_ns.tolist()], dtype=np.int64)

    def _sorted(self, rows: npt.NDArray[Any], name: str, *, drop_equal: bool) -> npt.NDArray[Any]:
        """Return the rows in order of their stamps."""
        if (np.diff(rows["t"]) < 0).any():
            self.warnings.append(f"{name}: rows were not in order of their stamps; sorted")
            rows = rows[np.argsort(rows["t"], kind="stable")]
        if drop_equal and len(rows):
            fresh = np.append(True, np.diff(rows["t"]) > 0)
            many = fresh.mean() < _MOST_FRESH and name not in self.set_back
            if many and take_turns(rows["values"][:, :3], rows["values"][:, 3:]):
                raise RecordingError(
                    f"{name}: {int((~fresh).sum())} rows repeat the stamp of another with other readings, "
                    "as if two IMUs shared one table; give each its own"
                )
            if not fresh.all():
                self.warnings.append(f"{name}: {int((~fresh).sum())} samples with a repeated stamp left out")
                rows = rows[fresh]
        return rows

    def _without_twins(self, rows: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
        """Keep the first of several points with one id in one image."""
        order = np.lexsort((rows["id"], rows["t"]))
        ordered = rows[order]
        twin = np.append(False, (np.diff(ordered["t"]) == 0) & (np.diff(ordered["id"]) == 0))
        if not twin.any():
            return rows
        self.warnings.append(f"{name}: {int(twin.sum())} points with an id seen twice in one image left out")
        kept: npt.NDArray[Any] = rows[np.sort(order[~twin])]
        return kept

    def _stream(self, kind: Kind, name: str, path: Path, t_ns: IntArray) -> Stream:
        keys = {"imu": IMU, "points": POINTS, "tracks": TRACKS, "compressed": COMPRESSED, "image": IMAGE}
        if not len(t_ns):
            raise RecordingError(f"{path}: no data")
        if np.abs(t_ns).max() >= 2**31 * 10**9:
            year = 1970.0 + float(t_ns[np.argmax(np.abs(t_ns))]) / 31_556_952e9
            raise RecordingError(
                f"{path}: its stamps reach the year {year:.0f}, and those of ROS 2 end in 2038: subtract the "
                "same from all stamps, of images, too (or are they ns?)"
            )
        try:
            key = keys[kind].key(RIG, name)
        except TopicError as error:
            raise RecordingError(f"{path}: {error}") from None
        resolution = None if kind == "imu" else image_size(path.parent)
        return Stream(key, kind, name, str(path), *stream_statistics(t_ns), resolution)
