"""Image folders as a camera: the ASL layout (``data.csv`` next to ``data/``), as EuRoC's ``mav0/cam0``.

A folder behaves as a camera does: a frame comes when its time has come, and its stamp is CLOCK_MONOTONIC.
"""

from __future__ import annotations

import csv
import io
import time
from collections import deque
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.statistics import FrameStatistics
from vical_drivers.closing import Closing
from vical_drivers.errors import DataEndedError, DeviceNotFoundError, DeviceRefusedError
from vical_drivers.samples import DeviceInfo, Frame, SourceStats
from vical_drivers.user_files import read_file, read_text

_LISTING_LIMIT = 2**27  # bytes; a month of names at 1 Hz
_IMAGE_LIMIT = 2**28  # bytes; larger than any camera's uncompressed frame


class ImageFolder(Closing):
    """A `FrameSource` that plays a folder once, in real time, as if its camera were there.

    The first frame is dated by the first `read`; the others follow it as far apart as they were recorded.

    Args:
        path: Folder with ``data.csv`` (``timestamp [ns], file name``); images in ``data/`` or next to it.
        settings: `decoder` decompresses the files; `encoding` is mono8 or bgr8.

    Raises:
        DeviceNotFoundError: No such folder or no ``data.csv``.
        DeviceRefusedError: No decoder was given, or the list is damaged or not in order.
    """

    def __init__(self, path: str, settings: CameraSettings) -> None:
        self._folder = Path(path)
        self._settings = settings
        if settings.decoder is None:
            raise DeviceRefusedError(f"folder:{path}: needs an image decoder")
        self._decoder = settings.decoder
        listing = self._folder / "data.csv"
        if not listing.is_file():
            raise DeviceNotFoundError(f"folder:{path}: no data.csv there; give a folder like mav0/cam0")
        frames = self._parse(listing)
        self._frames = deque(frames)
        self._total = len(frames)
        steps_ns = np.diff([t_ns for t_ns, _ in frames])
        self._rate_hz = 1e9 / float(np.median(steps_ns)) if len(steps_ns) else 0.0
        self._offset_ns: int | None = None  # CLOCK_MONOTONIC minus the recorded clock
        self._statistics = FrameStatistics()
        self._missing = 0
        self._sequence = 0

    def _parse(self, listing: Path) -> list[tuple[int, Path]]:
        frames = []
        try:
            rows = csv.reader(io.StringIO(read_text(listing, _LISTING_LIMIT)))
        except UnicodeDecodeError:
            raise DeviceRefusedError(f"{listing}: not a text file") from None
        for number, row in enumerate(rows, start=1):
            if not row or row[0].lstrip().startswith("#"):
                continue
            try:
                frames.append((int(row[0]), self._image_path(row[1].strip())))
            except (ValueError, IndexError) as error:
                raise DeviceRefusedError(f"{listing}: line {number} is not 'stamp, file name'") from error
        if any(later[0] <= earlier[0] for earlier, later in pairwise(frames)):
            raise DeviceRefusedError(f"{listing}: the stamps do not increase from line to line")
        return frames

    def _image_path(self, name: str) -> Path:
        inside = self._folder / "data" / name
        return inside if inside.exists() else self._folder / name

    @property
    def info(self) -> DeviceInfo:
        """The folder."""
        return DeviceInfo(
            kind="camera",
            model="image folder",
            serial_number=f"folder-{self._folder.name}",
            path=str(self._folder),
            protocol="folder",
            details={
                "frames": str(self._total),
                "encoding": self._settings.encoding,
                "rate_hz": f"{self._rate_hz:.3f}",
            },
        )

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame when it is due; None after `timeout_s`.

        Raises:
            DataEndedError: That was the last one.
        """
        now_ns = time.monotonic_ns()
        end_ns = now_ns + round(max(0.0, timeout_s) * 1e9)
        while self._frames:
            if self._offset_ns is None:
                self._offset_ns = now_ns - self._frames[0][0]
            t_host_ns = self._frames[0][0] + self._offset_ns
            if t_host_ns > end_ns:
                break
            time.sleep(max(0, t_host_ns - time.monotonic_ns()) * 1e-9)
            _, path = self._frames.popleft()
            self._sequence += 1
            try:
                data = np.frombuffer(read_file(path, _IMAGE_LIMIT), dtype=np.uint8)
                image = self._decoder(data, colour=self._settings.encoding == "bgr8")
            except (OSError, ValueError):
                self._statistics.count("unreadable_files")
                self._missing += 1
                continue
            dropped, self._missing = self._missing, 0
            self._statistics.add(t_host_ns, dropped)
            return Frame(
                t_exposure_mid_ns=t_host_ns,
                t_arrival_ns=time.monotonic_ns(),
                sequence=self._sequence - 1,
                image=image,
                encoding=self._settings.encoding,
                stamp_rule="recorded",
                dropped_before=dropped,
            )
        if not self._frames:
            raise DataEndedError(f"{self._folder}: it has ended; start again to play it again")
        time.sleep(max(0, end_ns - time.monotonic_ns()) * 1e-9)
        return None

    def stats(self) -> SourceStats:
        """Counters since the folder was opened."""
        return replace(self._statistics.snapshot(), jitter_us=None)

    def close(self) -> None:
        """Forget the rest; may be called twice."""
        self._frames.clear()
