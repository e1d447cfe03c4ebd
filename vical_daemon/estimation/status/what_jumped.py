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

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.jump_scores import JumpScores
from vical_daemon.estimation.measurements import FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import SKEW_SIGMA
from vical_daemon.estimation.noise.lens_agreement import LensAgreement

_SHIFT_S = 5e-3
"""One sigma of a step of the time shift, s; orientations of single images show those of 3 ms and more."""
_TURN_RAD, _MOVE_M = np.radians(2.0), 0.02
"""Of a jump of the mounting and of the lever arm."""
_ZOOM, _SHIFTED = 0.02, 0.01
"""Of a jump of fx and fy, and of cx and cy, over the focal length f: a lens of 5 mm that is focused from far
to 0.5 m is moved by f^2 / 0.5 m, 1 % of f."""

_RARER = 20.0
"""So much more likely, in logarithms, must the lens be than a bump. In the first second after a bump of 5 to
10 mm it explains images as well, with fewer unknowns: it was up to 11 more likely (ten bumps)."""

Step = Callable[[CalibrationFilter, PointsFrame, float], FrameReport | None]


class Part(Enum):
    """Of the calibration, one that may jump."""

    NONE = auto()
    SHIFT = auto()
    DRIFT = auto()
    MOUNTING = auto()
    LENS = auto()


class _Jump(NamedTuple):
    """Errors that may jump together.

    Attributes:
        errors: Their indices, length q.
        sigma: By how much, one sigma, shape (q,).
    """

    errors: list[int]
    sigma: FloatArray


def _jumps(f: CalibrationFilter, camera: str) -> dict[Part, _Jump]:
    """Parts of the calibration of a camera that may jump."""
    layout, out = f.layout, {}
    where = layout.cameras[camera]
    if where.timeshift is not None:
        out[Part.SHIFT] = _Jump([where.timeshift], np.array([_SHIFT_S]))
    if where.skew is not None:
        out[Part.DRIFT] = _Jump([where.skew], np.array([SKEW_SIGMA]))
    if where.rotation is not None and where.position is not None:
        errors = [*range(layout.size)[where.rotation], *range(layout.size)[where.position]]
        out[Part.MOUNTING] = _Jump(errors, np.repeat([_TURN_RAD, _MOVE_M], 3))
    if where.intrinsics is not None and layout.lens_free(camera):
        errors = [*range(layout.size)[where.intrinsics]]
        focal = float(f.state.cameras[camera].intrinsics[0])
        out[Part.LENS] = _Jump(errors, focal * np.repeat([_ZOOM, _SHIFTED], 2))
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
    jumps = _jumps(before, camera)
    best, found = _likelihood(before, images, jumps, step)
    part_found, found_filter = Part.NONE, before
    f, likelihood = deepcopy(before), 0.0
    for k, image in enumerate(images):
        for part in (part for part, instants in found.items() if k in instants):
            jumped = deepcopy(f)
            columns = np.zeros((len(f.S), len(jumps[part].errors)))
            columns[jumps[part].errors, range(columns.shape[1])] = jumps[part].sigma
            jumped.inflate_covariance(columns)
            if part is Part.LENS:  # what stretches of the data said about it no longer holds
                jumped.agreement[camera] = LensAgreement(jumped.agreement[camera].model)
            total = likelihood + sum(_follow(jumped, x, step) for x in images[k:])
            total -= _RARER if part is Part.LENS else 0.0
            if total > best:
                best, part_found, found_filter = total, part, jumped
        likelihood += _follow(f, image, step)
    return part_found, found_filter


def lens_stepped(before: CalibrationFilter, after: CalibrationFilter, camera: str) -> Event:
    """Return what is announced where the lens jumped."""
    focal = (f.state.cameras[camera].intrinsics[0] for f in (after, before))
    return Event(EventKind.LENS_STEPPED, camera, float(np.subtract(*focal)))


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
