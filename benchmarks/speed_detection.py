"""Detection and tracking of `benchmarks speed`: vical compared with OpenCV and the C AprilTag library."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree
from vical_mocks.camera import CameraSettings, SimulatedCamera
from vical_mocks.harness.boards import DISTORTION, rig_before
from vical_mocks.lens import Lens
from vical_mocks.rig import reference_rig
from vical_mocks.room import RoomCamera

from vical_daemon.vision.detector import BoardDetector
from vical_daemon.vision.target import AprilGrid, Checkerboard, Target
from vical_daemon.vision.tracks import FeatureTracker

STEP_S = 0.05
NEAR_PX = 3.0
"""A corner of a peer belongs to the true one within this distance: its order does not matter here."""
REFINED = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)

Picture = np.ndarray
Find = Callable[[Picture], np.ndarray]
"""A picture -> corners, shape (n, 2), px."""


@dataclass
class Tally:
    """What one detector did with one sequence."""

    spent_ms: list[float] = field(default_factory=list)
    errors_px: list[np.ndarray] = field(default_factory=list)
    found: int = 0
    seen: int = 0

    def row(self) -> str:
        """Median time, corners found, RMS error per axis."""
        error = np.concatenate([*self.errors_px, np.zeros((0, 2))])
        rms = f"{np.sqrt(np.mean(error**2)):.3f}" if len(error) else "–"
        share = f"{self.found / self.seen:.1%}" if self.seen else "–"
        return f"{np.median(self.spent_ms):.2f} | {share} | {rms}" if self.spent_ms else "– | – | –"


def run(frames: int) -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    grid, board = AprilGrid(6, 6, 0.088, 0.3), Checkerboard(9, 6, 0.05, 0.05)
    print("\n| images | detector | median ms | corners found | RMS error px |\n|---|---|---|---|---|")
    for target, distance_m in ((grid, 0.9), (board, 0.7)):
        for width in (640, 1280):
            for name, tally in _compare(target, distance_m, width, frames).items():
                corners = len(target.points_m)
                print(
                    f"| {target.kind}, {corners} corners, {_size(width)} | {name} | {tally.row()} |",
                    flush=True,
                )
    _without_board({"aprilgrid": grid, "checkerboard": board}, frames)
    if importlib.util.find_spec("pupil_apriltags") is None:
        print("\nSkipped: the C AprilTag library (pupil-apriltags is not installed).")
    _growth(frames)
    _tracks(frames)


def _size(width: int) -> str:
    return f"{width}x{_height(width)}"


def _height(width: int) -> int:
    return width * 3 // 4 if width == 640 else width * 4 // 5


def _film(
    target: Target, distance_m: float, width: int, frames: int
) -> Iterator[tuple[Picture, np.ndarray, Any]]:
    """Pictures, the true pixels of all corners, and which are in view."""
    height, focal = _height(width), 520.0 * width / 640
    lens = Lens((focal, focal, width / 2, height / 2), DISTORTION, (width, height))
    camera = SimulatedCamera(
        target, lens, rig_before(target, distance_m).camera_pose_target, CameraSettings(exposure_s=0.003), 1
    )
    for k in range(frames):
        yield (camera.render(k * STEP_S), *camera.project(target.points_m, k * STEP_S))


def _compare(target: Target, distance_m: float, width: int, frames: int) -> dict[str, Tally]:
    guided, full = BoardDetector(target), BoardDetector(target, guided=False)
    peers = _peers(target)
    tallies = {name: Tally() for name in ("vical, guided", "vical, full search", *peers)}
    for k, (picture, uv, seen) in enumerate(_film(target, distance_m, width, frames)):
        searches = guided.stats.searches
        spent_ms, found = _timed(lambda: guided.detect(picture, round(k * STEP_S * 1e9)))  # noqa: B023
        if guided.stats.searches == searches:
            _score(tallies["vical, guided"], spent_ms, None if found is None else found.uv_px, uv, seen)
        spent_ms, found = _timed(lambda: full.detect(picture))  # noqa: B023
        _score(tallies["vical, full search"], spent_ms, None if found is None else found.uv_px, uv, seen)
        for name, find in peers.items():
            spent_ms, corners = _timed(lambda: find(picture))  # noqa: B023
            _score(tallies[name], spent_ms, corners, uv, seen)
    return tallies


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.thread_time()
    result = call()
    return (time.thread_time() - begin) * 1e3, result


def _score(
    tally: Tally, spent_ms: float, corners: np.ndarray | None, uv: np.ndarray, seen: np.ndarray
) -> None:
    tally.spent_ms.append(spent_ms)
    tally.seen += int(seen.sum())
    if corners is None or not len(corners):
        return
    apart, nearest = cKDTree(uv[seen]).query(corners)
    near = apart < NEAR_PX
    tally.found += len(np.unique(nearest[near]))
    tally.errors_px.append(corners[near] - uv[seen][nearest[near]])


def _peers(target: Target) -> dict[str, Find]:
    if isinstance(target, Checkerboard):
        size = (target.cols, target.rows)

        def sectors(picture: Picture) -> np.ndarray:
            found, corners = cv2.findChessboardCornersSB(picture, size)
            return _refined(picture, corners) if found else np.zeros((0, 2))

        return {"findChessboardCornersSB + cornerSubPix": sectors}
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = 2
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    markers = cv2.aruco.ArucoDetector(family, options)

    def aruco(picture: Picture) -> np.ndarray:
        quads, ids, _ = markers.detectMarkers(picture)
        return _refined(picture, np.concatenate(quads)) if ids is not None else np.zeros((0, 2))

    peers: dict[str, Find] = {"cv2.aruco + cornerSubPix": aruco}
    if importlib.util.find_spec("pupil_apriltags") is not None:
        import pupil_apriltags

        library = pupil_apriltags.Detector(families="tag36h11", nthreads=1)

        def april(picture: Picture) -> np.ndarray:
            tags = library.detect(picture)
            return np.concatenate([np.zeros((0, 2)), *(tag.corners - 0.5 for tag in tags)])

        peers["AprilTag library (C)"] = april
    return peers


def _refined(picture: Picture, corners: np.ndarray) -> np.ndarray:
    start = np.ascontiguousarray(corners.reshape(-1, 1, 2), np.float32)
    return np.asarray(cv2.cornerSubPix(picture, start, (4, 4), (-1, -1), REFINED), float).reshape(-1, 2)


def _without_board(targets: dict[str, Target], frames: int) -> None:
    print("\n| images of a room without a board, 640x480 | median ms | mean ms |\n|---|---|---|")
    pictures = _room(2 * frames)
    for kind, target in targets.items():
        detector = BoardDetector(target)
        spent = [_timed(lambda: detector.detect(p))[0] for p in pictures]  # noqa: B023
        print(f"| vical looks for: {kind} | {np.median(spent):.2f} | {np.mean(spent):.2f} |")
        for name, find in _peers(target).items():
            spent = [_timed(lambda: find(p))[0] for p in pictures[:frames]]  # noqa: B023
            print(f"| {name} | {np.median(spent):.2f} | {np.mean(spent):.2f} |", flush=True)


def _growth(frames: int) -> None:
    print("\n| AprilGrid, 144 corners | guided ms | full search ms |\n|---|---|---|")
    for width in (640, 960, 1280, 1920):
        print(f"| {_size(width)} | {_both(AprilGrid(6, 6, 0.088, 0.3), width, frames // 2)} |", flush=True)
    print("\n| AprilGrid, 1280x1024 | guided ms | full search ms |\n|---|---|---|")
    for tags in (2, 4, 6, 8, 10):
        grid = AprilGrid(tags, tags, 0.088 * 6 / tags, 0.3)
        print(f"| {4 * tags * tags} corners | {_both(grid, 1280, frames // 2)} |", flush=True)


def _both(target: Target, width: int, frames: int) -> str:
    guided, full, spent = BoardDetector(target), BoardDetector(target, guided=False), ([], [])
    for k, (picture, _, _) in enumerate(_film(target, 0.9, width, frames)):
        searches = guided.stats.searches
        spent_ms, _ = _timed(lambda: guided.detect(picture, round(k * STEP_S * 1e9)))  # noqa: B023
        if guided.stats.searches == searches:
            spent[0].append(spent_ms)
        spent[1].append(_timed(lambda: full.detect(picture))[0])  # noqa: B023
    return " | ".join(f"{np.median(times):.2f}" if times else "–" for times in spent)


def _room(frames: int) -> list[Picture]:
    rig = reference_rig(1)
    room = RoomCamera(rig.lens, rig.camera_pose_target)
    return [room.render(k * STEP_S) for k in range(frames)]


def _tracks(frames: int) -> None:
    """The tracker against OpenCV's Lucas-Kanade on the same features: there, and there and back."""
    tracker, spent, alone, back, alive = FeatureTracker(), [], [], [], []
    before, points = None, None
    options = {"winSize": (15, 15), "maxLevel": 3, "criteria": (3, 12, 0.02)}
    for k, picture in enumerate(_room(frames)):
        spent_ms, found = _timed(lambda: tracker.detect(picture, round(k * STEP_S * 1e9)))  # noqa: B023
        if before is not None and points is not None:
            flow = lambda a, b, p: cv2.calcOpticalFlowPyrLK(a, b, p, None, **options)  # noqa: E731
            there_ms, (after, _, _) = _timed(lambda: flow(before, picture, points))  # noqa: B023
            back_ms, _ = _timed(lambda: flow(picture, before, after))  # noqa: B023
            spent.append(spent_ms)
            alone.append(there_ms)
            back.append(there_ms + back_ms)
            alive.append(len(points))
        before = picture
        points = None if found is None else found.uv_px.astype(np.float32)[:, None]
    print("\n| features in a room, 640x480 | features | median ms |\n|---|---|---|")
    for name, times in (
        ("vical's tracker", spent),
        ("cv2 KLT alone", alone),
        ("cv2 KLT, there and back", back),
    ):
        print(f"| {name} | {np.mean(alive):.0f} | {np.median(times):.2f} |")
