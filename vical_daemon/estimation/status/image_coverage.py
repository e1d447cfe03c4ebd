"""Where in the picture corners have been seen: beyond that a lens that is estimated is extrapolated.

On a real recording a half without corners near two edges of the picture gave a lens that was 3.5 px off there
(docs/math/filter.md): its mounting was right, and what it would be used for next was not.

Asked for is only what can be shown: a detector that needs the whole target sees no corners at the edges.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry.camera_model import EQUIDISTANT
from vical_daemon.estimation.guidance import Edge, Guidance, Lack, Verb
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.frame_report import FrameReport

_ACROSS, _DOWN = 16, 12  # parts of the picture
_LEAST = 5  # corners of a part that has been seen
_SHARE = 0.5  # of the parts along an edge
_PARTLY = 0.75  # of the most corners in one image; fewer: targets are seen that are partly in the picture


class Cover:
    """The pictures of all cameras whose lenses are estimated."""

    def __init__(self) -> None:
        self._pictures: dict[str, ImageCoverage] = {}

    def saw(self, report: FrameReport, f: CalibrationFilter) -> None:
        """Take the corners that the filter used; pictures of a fisheye may be round, and are left out."""
        camera = f.state.cameras[report.camera]
        if not f.layout.lens_free(report.camera) or camera.distortion_model == EQUIDISTANT:
            return
        if report.camera not in self._pictures:
            self._pictures[report.camera] = ImageCoverage(camera.resolution)
        self._pictures[report.camera].add(report.uv_px[report.accepted])

    def advice(self) -> Guidance:
        """What to show the cameras, the first that lacks something; nothing where none does."""
        for name, picture in self._pictures.items():
            edges = picture.unseen_edges()
            if edges:
                return Guidance(Verb.SHOW, lack=Lack.EDGES, camera=name, edges=edges)
        return Guidance()


class ImageCoverage:
    """Counts corners by part of the picture.

    Args:
        resolution: Width and height, px.
    """

    def __init__(self, resolution: tuple[int, int]) -> None:
        self._part_px = np.array(resolution, dtype=np.float64) / (_ACROSS, _DOWN)
        self._counts = np.zeros((_DOWN, _ACROSS), dtype=np.int64)
        self._most, self._least = 0, np.iinfo(np.int64).max  # corners in one image

    def add(self, uv_px: FloatArray) -> None:
        """Take the corners of one image, shape (n, 2)."""
        column, row = (uv_px / self._part_px).astype(np.intp).T
        places = np.ravel_multi_index((row, column), self._counts.shape, mode="clip")
        self._counts += np.bincount(places, minlength=self._counts.size).reshape(self._counts.shape)
        self._most, self._least = max(self._most, len(uv_px)), min(self._least, len(uv_px))

    def unseen_edges(self) -> tuple[Edge, ...]:
        """Edges along most of which no corners have been, though they could."""
        if self._least >= _PARTLY * self._most:
            return ()
        seen = self._counts >= _LEAST
        edges: dict[Edge, BoolArray]
        edges = {"left": seen[:, 0], "right": seen[:, -1], "top": seen[0], "bottom": seen[-1]}
        return tuple(name for name, parts in edges.items() if parts.mean() < _SHARE)
