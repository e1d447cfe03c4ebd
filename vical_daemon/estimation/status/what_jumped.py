"""What has changed when images no longer fit: the part of the calibration that explains them if it jumped.

A filter from before the change follows the images once more. `JumpScores` say when each part may have jumped.
Copies of the filter to which that part is unknown from there on follow them again. The part under which the
images are most likely is the one that jumped, if they are more likely than without a jump.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.jump_scores import JumpScores
from vical_daemon.estimation.measurements import FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import SKEW_SIGMA
from vical_daemon.estimation.model.state import Layout

_SHIFT_S = 5e-3
"""One sigma of a step of the time shift, s; orientations of single images show those of 3 ms and more."""
_TURN_RAD, _MOVE_M = np.radians(2.0), 0.02
"""Of a jump of the mounting and of the lever arm."""

Step = Callable[[CalibrationFilter, PointsFrame, float], FrameReport | None]


class Part(Enum):
    """Of the calibration, one that may jump."""

    NONE = auto()
    SHIFT = auto()
    DRIFT = auto()
    MOUNTING = auto()


class _Jump(NamedTuple):
    """Errors that may jump together.

    Attributes:
        errors: Their indices, length q.
        sigma: By how much, one sigma, shape (q,).
    """

    errors: list[int]
    sigma: FloatArray


def _jumps(layout: Layout, camera: str) -> dict[Part, _Jump]:
    """Parts of the calibration of a camera that may jump."""
    where, out = layout.cameras[camera], {}
    if where.timeshift is not None:
        out[Part.SHIFT] = _Jump([where.timeshift], np.array([_SHIFT_S]))
    if where.skew is not None:
        out[Part.DRIFT] = _Jump([where.skew], np.array([SKEW_SIGMA]))
    if where.rotation is not None and where.position is not None:
        errors = [*range(layout.size)[where.rotation], *range(layout.size)[where.position]]
        out[Part.MOUNTING] = _Jump(errors, np.repeat([_TURN_RAD, _MOVE_M], 3))
    return out


def what_jumped(
    before: CalibrationFilter, images: Frames, camera: str, step: Step
) -> tuple[Part, CalibrationFilter]:
    """Which part of a camera's calibration jumped, and the filter that knows of it, after the images.

    None where the images are likeliest without a jump.

    Args:
        before: From before the change; is left as it is.
        images: Since then, in order.
        camera: Of which images do not fit.
        step: Propagates a filter to an image and corrects it.
    """
    jumps = _jumps(before.layout, camera)
    best, found = _likelihood(before, images, jumps, step)
    part_found, found_filter = Part.NONE, before
    f, likelihood = deepcopy(before), 0.0
    for k, image in enumerate(images):
        for part in (part for part, instants in found.items() if k in instants):
            jumped = deepcopy(f)
            columns = np.zeros((len(f.S), len(jumps[part].errors)))
            columns[jumps[part].errors, range(columns.shape[1])] = jumps[part].sigma
            jumped.inflate_covariance(columns)
            total = likelihood + sum(_follow(jumped, x, step) for x in images[k:])
            if total > best:
                best, part_found, found_filter = total, part, jumped
        likelihood += _follow(f, image, step)
    return part_found, found_filter


def _likelihood(
    before: CalibrationFilter, images: Frames, jumps: Mapping[Part, _Jump], step: Step
) -> tuple[float, dict[Part, set[int]]]:
    """Log-likelihood of images without a jump, and the images just before which each part may have jumped."""
    f = deepcopy(before)
    errors = np.concatenate([x.errors for x in jumps.values()]).astype(np.intp)
    f.jumps = scores = JumpScores.of(errors, len(f.S))
    likelihood, refused = 0.0, set[int]()
    for k, (t_cam_s, frame) in enumerate(images):
        scores.begin()
        report = step(f, frame, t_cam_s)
        likelihood += 0.0 if report is None else report.log_likelihood
        if report is not None and not report.used and not refused:
            refused.add(k)  # it tells the scores nothing; a large jump may be just before the first of them
    instants, end = {}, 0
    for part, jump in jumps.items():
        own = slice(end, end + len(jump.errors))
        k, end = int(scores.log_ratios(own, jump.sigma).argmax()), own.stop
        instants[part] = {k - 1, k, k + 1} | refused
    return likelihood, instants


def _follow(f: CalibrationFilter, image: tuple[float, PointsFrame], step: Step) -> float:
    """Take an image; its log-likelihood."""
    report = step(f, image[1], image[0])
    return 0.0 if report is None else report.log_likelihood
