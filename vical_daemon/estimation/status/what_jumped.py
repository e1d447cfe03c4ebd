"""What has changed when images no longer fit: the part of the calibration that explains them if it jumped.

`JumpScores` give the most likely instants of a jump of each part, from what the images of the last seconds
did to the filter. Copies of a filter from before follow these images again, one for each part and instant,
with that part unknown from there on. The part under which the images are most likely is the one that jumped,
if they are more likely than without a jump. Parts that explain them nearly as well may have jumped, too: the
filter goes on with all of these unknown. [docs/math/filter.md, "Detection of changes"]
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from enum import Enum, auto
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.jump_scores import JumpScores, JumpSizes
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.held_lens import OFF_SHARE
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    FILTER_START,
    GYRO_BIAS_SIGMA_RPS,
    SKEW_SIGMA,
)
from vical_daemon.estimation.model.state import (
    ACCEL_BIAS,
    ATTITUDE,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    VELOCITY,
    Layout,
    State,
)
from vical_daemon.estimation.status.recent_past import Taken

_TURN_RAD, _MOVE_M = np.radians(5.0), 0.05
"""One sigma of the largest jump of a mounting, or of the target, rad and m (smaller ones:
`jump_scores.SIZES`). Turns four times as large and moves twice as large are followed, too."""
_SHIFTED = 0.01
"""Likewise of cx and cy, over the focal length f: a lens of 5 mm that is focused from far to 0.5 m is moved
by f^2 / 0.5 m, 1 % of f."""

_ODDS = 20.0
"""Logarithm of the odds from which on an explanation is ruled out: no jump at all, or the jump of a part. In
the first second after a bump of 5 to 10 mm another lens explains the images as well, with fewer unknowns: it
was more likely by up to 11 (ten bumps)."""

Step = Callable[[CalibrationFilter, PointsFrame, float], FrameReport | None]
"""Propagates a filter to an image, stamped in s, and corrects it; None where inertial data are missing."""


class Part(Enum):
    """What may jump: a mounting, all of them each by itself or all alike (IMU), the target, other parts.

    KNOCK: a mounting and the time shift of its camera.
    """

    SHIFT = auto()
    DRIFT = auto()
    MOUNTING = auto()
    KNOCK = auto()
    MOUNTINGS = auto()
    IMU = auto()
    LENS = auto()
    BIASES = auto()
    TARGET = auto()


MOVED = frozenset({Part.MOUNTING, Part.KNOCK, Part.MOUNTINGS, Part.IMU})
"""What is announced as a bump."""
_NOT_BESIDE = (
    (Part.KNOCK, {Part.SHIFT, Part.IMU}),
    (Part.MOUNTING, {Part.KNOCK}),  # a special case: how far the time shift stepped, if at all, is left open
    (Part.MOUNTINGS, {Part.MOUNTING, Part.KNOCK, Part.IMU}),
)
"""Parts that are not considered where one of others is possible, in this order."""


def _jumps(layout: Layout, state: State, camera: str, until_s: float) -> dict[Part, FloatArray]:
    """Parts that may jump: directions of the errors, each as long as one sigma of the jump, shape (n, q).

    Those of a knock are the time shift's and, next to them, the mounting's. Biases may jump at any time until
    the next image, at `until_s` in the imu's clock: the rest of that time they have moved the rig too far.
    """
    out = {}
    where, every = layout.cameras[camera], range(layout.size)
    if where.skew is not None:
        out[Part.DRIFT] = _columns(layout.size, [where.skew], [SKEW_SIGMA])
    if where.timeshift is not None:
        out[Part.SHIFT] = _columns(layout.size, [where.timeshift], [FILTER_START.timeshift_s])
    mountings = {
        name: [*every[c.rotation], *every[c.position]]
        for name, c in layout.cameras.items()
        if c.rotation is not None and c.position is not None
    }
    sigmas = np.repeat([_TURN_RAD, _MOVE_M], 3)
    if camera in mountings:
        out[Part.MOUNTING] = _columns(layout.size, mountings[camera], sigmas)
    if where.intrinsics is not None:  # of a fixed lens, too: its errors are considered
        focal = float(state.cameras[camera].intrinsics[0])
        sizes = focal * np.repeat([OFF_SHARE, _SHIFTED], 2)
        out[Part.LENS] = _columns(layout.size, every[where.intrinsics], sizes)
    if len(mountings) > 1:
        errors = [k for own in mountings.values() for k in own]
        out[Part.MOUNTINGS] = _columns(layout.size, errors, np.tile(sigmas, len(mountings)))
        out[Part.IMU] = _imu_moves(state, layout)
    biases = [*every[GYRO_BIAS], *every[ACCEL_BIAS], *every[ATTITUDE], *every[VELOCITY]]
    sigmas = np.repeat([GYRO_BIAS_SIGMA_RPS, ACCEL_BIAS_SIGMA_MPS2], 3)
    too_far = (until_s - state.t_s) / math.sqrt(3.0) * sigmas  # RMS over all times
    out[Part.BIASES] = _columns(layout.size, biases, np.concatenate([sigmas, too_far]))
    out[Part.TARGET] = _target_moves(state, layout.size)
    return out


def _columns(size: int, errors: Sequence[int], sigmas: npt.ArrayLike) -> FloatArray:
    """Errors that jump independently, shape (size, q)."""
    out = np.zeros((size, len(errors)))
    out[errors, range(len(errors))] = sigmas
    return out


def _imu_moves(state: State, layout: Layout) -> FloatArray:
    """How mountings and lever arms jump with the imu below all cameras: turns, moves, shape (size, 6)."""
    out = np.zeros((layout.size, 6))
    for name, where in layout.cameras.items():
        camera = state.cameras[name]
        if where.rotation is not None:
            out[where.rotation, :3] = _TURN_RAD * camera.R_imu_cam.T
        if where.position is not None:
            out[where.position, :3] = -_TURN_RAD * so3.hat(camera.p_imu_cam)
            out[where.position, 3:] = _MOVE_M * np.eye(3)
    return out


def _target_moves(state: State, size: int) -> FloatArray:
    """How motion and gravity in the target's frame jump with it: turns, then moves, shape (size, 6)."""
    out = np.zeros((size, 6))
    out[ATTITUDE, :3] = _TURN_RAD * state.R_world_imu.T
    out[POSITION, :3] = -_TURN_RAD * so3.hat(state.p_world_imu)
    out[VELOCITY, :3] = -_TURN_RAD * so3.hat(state.v_world_imu)
    out[GRAVITY, :3] = -_TURN_RAD * so3.hat(state.gravity)
    out[POSITION, 3:] = _MOVE_M * np.eye(3)
    return out


class Found(NamedTuple):
    """What has changed.

    Attributes:
        part: The one that explains the images best.
        possible: Parts that may have jumped: that one, and those that explain the images nearly as well.
        filter: After the images; the possible parts are unknown to it from the jump on. If only the target
            may have moved: just before the jump, as the motion is found again as after any lost pose.
        before: The filter just before the jump.
    """

    part: Part
    possible: frozenset[Part]
    filter: CalibrationFilter
    before: CalibrationFilter


def what_jumped(
    before: CalibrationFilter, taken: Sequence[Taken], camera: str, step: Step, *, after_gap: bool = False
) -> Found | None:
    """Find which part of the calibration of a camera jumped, or whether the target did.

    Args:
        before: The filter from before the change; it is not modified.
        taken: Images since then, of all cameras, in order.
        camera: The one whose images do not fit.
        step: Takes an image with a filter.
        after_gap: The motion was found again just before, with the mounting as known. A mounting that jumped
            in the meantime looks like biases at first, so they are not considered.

    Returns:
        None where no jump explains the images.
    """
    if not taken:
        return None
    images = [x.image for x in taken]
    odds = _ODDS * before.consistency[camera].strictness
    none = np.cumsum([x.log_likelihood for x in taken])
    refused = [k for k, x in enumerate(taken) if not x.used]
    suspects = _suspects(before, taken, camera, refused, odds)
    if after_gap:
        suspects = [x for x in suspects if x[0] is not Part.BIASES]
    filters = _filters_at({k for _, k in suspects}, before, images, step)
    found: dict[Part, _Jump] = {}
    highest, margin = none, 2.0 * odds  # twice what rules a jump out: later images may make up for the rest
    for part, k in suspects:
        f, likelihood = filters[k]
        after = _follow_after(f, {part: 1.0}, images[k:], camera, step, highest[k:] - likelihood - margin)
        if after is None:
            continue
        totals = likelihood + np.asarray(after.likelihoods)
        if totals[-1] > highest[-1] and all(after.used):  # what refuses images rules out no other
            highest = np.concatenate([np.full(k, -math.inf), totals])
        if totals[-1] > found.get(part, _Jump(none[-1])).likelihood:
            found[part] = _Jump(totals[-1], k, after.jumped.sizes)
    total = max((jump.likelihood for jump in found.values()), default=-math.inf)
    if not total > none[-1] + odds:
        return None
    possible = {part for part, jump in found.items() if jump.likelihood > total - odds}
    for part, others in _NOT_BESIDE:
        if possible & others:
            possible.discard(part)
    best = max(possible, key=lambda part: found[part].likelihood)
    k = found[best].at
    known, _ = filters[k]
    if possible == {Part.TARGET}:
        return Found(best, frozenset(possible), deepcopy(known), known)
    unknown = {part: found[part].sizes for part in possible}
    after = _follow_after(known, unknown, images[k:], camera, step)
    assert after is not None  # nothing to fall short of
    for consistency in after.filter.consistency.values():
        consistency.settle()
    fits = _most(after.used) and _most([after.used[at - k] for at in refused if at >= k])
    return Found(best, frozenset(possible), after.filter, known) if fits else None


def _filters_at(
    instants: set[int], before: CalibrationFilter, images: Frames, step: Step
) -> dict[int, tuple[CalibrationFilter, float]]:
    """Filters just before some of the images, and the log-likelihood of the images before those."""
    f, likelihood = deepcopy(before), 0.0
    out: dict[int, tuple[CalibrationFilter, float]] = {}
    for k in range(max(instants, default=-1) + 1):
        if k in instants:
            out[k] = (deepcopy(f), likelihood)
        likelihood += _follow(f, images[k], step)[0]
    return out


def _most(used: Sequence[bool]) -> bool:
    """Whether more than half of some images were used, or there are none."""
    return not used or 2 * sum(used) > len(used)


class _Jump(NamedTuple):
    """A jump just before an image: log-likelihood of all images, which image, and by how much."""

    likelihood: float
    at: int = -1
    sizes: FloatArray = np.ones(0)


class _After(NamedTuple):
    """A filter after images to which parts are unknown.

    Attributes:
        filter: It.
        likelihoods: Logarithm of the likelihood of the images up to each, if the jump may be of any size.
        used: Which of them it used.
        jumped: By how much these parts jumped.
    """

    filter: CalibrationFilter
    likelihoods: Sequence[float]
    used: Sequence[bool]
    jumped: JumpSizes


def _follow_after(
    before: CalibrationFilter,
    parts: Mapping[Part, FloatArray | float],
    images: Frames,
    camera: str,
    step: Step,
    least: FloatArray | None = None,
) -> _After | None:
    """Take images with a copy of a filter to which some parts are unknown.

    Args:
        before: The filter just before the jump.
        parts: What jumped, and how far, over one sigma of the jump.
        images: From the jump on.
        camera: The one whose images do not fit.
        step: Takes an image with a filter.
        least: What the log-likelihood of the images up to each must be.

    Returns:
        None where it is less.
    """
    f, (t_cam_s, frame) = deepcopy(before), images[0]
    next_s = t_cam_s + f.state.cameras[frame.camera].timeshift_s
    jumps = _jumps(f.layout, f.state, camera, next_s)
    if Part.KNOCK in parts:
        jumps[Part.KNOCK] = np.concatenate([jumps[Part.SHIFT], jumps[Part.MOUNTING]], axis=1)
    columns = np.concatenate([jumps[part] * size for part, size in parts.items()], axis=1)
    f.inflate_covariance(columns)
    f.jumped = jumped = JumpSizes.of(columns)
    if Part.LENS in parts:  # what stretches of the data said about it no longer holds
        f.agreement[camera] = f.agreement[camera].anew()
        held = dict(f.layout.held)
        if camera in held:
            rows = f.S[f.layout.lens(camera)]
            held[camera] = held[camera].may_have_jumped(rows @ rows.T)
            f.layout = replace(f.layout, held=held)
    likelihoods: list[float] = []
    used: list[bool] = []
    total = 0.0
    for k, image in enumerate(images):
        likelihood, taken = _follow(f, image, step)
        total += likelihood
        likelihoods.append(total + jumped.any_size)
        used.append(taken)
        if least is not None and likelihoods[-1] < least[k]:
            return None
    f.jumped = None
    return _After(f, likelihoods, used, jumped)


def _suspects(
    before: CalibrationFilter, taken: Sequence[Taken], camera: str, refused: Sequence[int], odds: float
) -> list[tuple[Part, int]]:
    """Find what may have jumped, and when.

    Args:
        before: See `what_jumped`, also for `taken` and `camera`.
        taken: Since then.
        camera: The one whose images do not fit.
        refused: Which of the images are.
        odds: By how much a jump must be more likely than none, in logarithms.

    Returns:
        Each part, and an image just before which it may have jumped, the likeliest first; nothing where no
        jump is likely.
    """
    states, layout = [before.state, *(x.state for x in taken)], before.layout
    jumps = [_jumps(layout, state, camera, after.t_s) for state, after in pairwise(states)]
    columns = [np.concatenate(list(x.values()), axis=1) for x in jumps]
    scores = JumpScores.of([x.passed for x in taken], columns, layout.drifts)
    ends = np.cumsum([x.shape[1] for x in jumps[0].values()])
    own = {part: slice(end - x.shape[1], end) for (part, x), end in zip(jumps[0].items(), ends, strict=True)}
    if Part.SHIFT in own and Part.MOUNTING in own:
        own[Part.KNOCK] = slice(own[Part.SHIFT].start, own[Part.MOUNTING].stop)
    ratios = {part: scores.log_ratios(of) for part, of in own.items()}
    if taken[-1].used and max(x.max() for x in ratios.values()) < odds:
        return []
    best = {part: int(x.argmax()) for part, x in ratios.items()}
    likely = sorted(best, key=lambda part: -ratios[part].max())
    first = [(part, best[part]) for part in likely]
    if not refused:
        return [(part, k) for part, k in first if ratios[part][k] > 0.0]
    # images that are refused tell the scores nothing; a large jump may be just before the first of them
    rest = [(part, near) for part, k in first for near in sorted({k - 1, k + 1, refused[0]} - {k})]
    return [(part, k) for part, k in first + rest if 0 <= k < len(taken)]


def _follow(f: CalibrationFilter, image: tuple[float, PointsFrame], step: Step) -> tuple[float, bool]:
    """Take an image; return its log-likelihood, and whether it was used. A filter that diverged uses none."""
    if not f.finite():
        return -math.inf, False
    report = step(f, image[1], image[0])
    f.passed.clear()  # nobody asks, and copies would contain it
    return (0.0, False) if report is None else (report.log_likelihood, report.used)
