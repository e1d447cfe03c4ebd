"""Find every corner of a board whose place is roughly known: refine, check, and grow to what is left.

The start may come from decoded tags, from the last frame or from the filter's prediction. A corner counts
only if it is a saddle, if its four sectors have the right colours, and if it lies where its neighbours say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray
from vical_daemon.vision.grid_model import GridModel, fit_grid, outliers
from vical_daemon.vision.layout import BoardLayout
from vical_daemon.vision.saddle import SaddleImage
from vical_daemon.vision.tag_code import BITS, agreement, bit_centres, sample
from vical_daemon.vision.target import AprilGrid

BoolArray = npt.NDArray[np.bool_]

MIN_RADIUS_PX = 1.6
MIN_CONTRAST = 0.3
"""Of the board's median corner contrast: below, a corner is hidden or washed out."""
MIN_CONTRAST_DN = 6.0
MAX_SIGMA_PX = 2.0
GROW_ROUNDS = 3
MIN_AGREEMENT = 0.3
MIN_BOARD_AGREEMENT = 0.35
MIN_RIM_CORNERS = 3
MAX_RIM_SHARE = 0.2
"""Of the places just beyond a checkerboard: this many that look like its corners, and it is shifted."""


@dataclass(frozen=True)
class BoardFix:
    """All corners of the board in one picture, in the order of the point ids.

    Attributes:
        uv_px: Where each corner was found; meaningless where `found` is False, shape (n, 2).
        sigma_px: One-sigma per axis, shape (n,).
        found: Shape (n,).
        model: Fitted to the corners found.
    """

    uv_px: FloatArray
    sigma_px: FloatArray
    found: BoolArray
    model: GridModel


def complete_board(
    image: SaddleImage, layout: BoardLayout, uv_px: FloatArray, known: BoolArray, lens: float = -0.1
) -> BoardFix | None:
    """Find the whole board from some of its corners.

    Args:
        image: The picture.
        layout: The board.
        uv_px: Roughly known corners, shape (n, 2); read only where `known`.
        known: Shape (n,).
        lens: First guess of the grid model's lens coefficient.

    Returns:
        Every corner that could be found, or None if nothing consistent is there.
    """
    if known.sum() < 4:
        return None
    model = fit_grid(layout.xy_m[known], uv_px[known], image.shape, lens)
    if model is None:
        return None
    keep = known.copy()
    keep &= ~outliers(uv_px - model.predict(layout.xy_m), known, layout.neighbours, floor_px=2.5)
    if keep.sum() < 4:
        return None
    return grow_board(image, layout, model.refit(layout.xy_m[keep], uv_px[keep]), uv_px, keep)


def grow_board(
    image: SaddleImage, layout: BoardLayout, model: GridModel, uv_px: FloatArray, known: BoolArray
) -> BoardFix | None:
    """Refine `known` corners and find the others around them, nearest first by rounds."""
    start = BoardFix(uv_px, np.full(len(uv_px), np.inf), known, model)
    fix = refine_predicted(image, layout, model, predict_with_residuals(start, layout), search_px=3.0)
    if fix is None:
        return None
    for _ in range(GROW_ROUNDS):
        before = int(fix.found.sum())
        fix = refine_missing(image, layout, fix)
        if int(fix.found.sum()) <= before:
            break
    return check_identity(image, layout, fix)


def predict_with_residuals(fix: BoardFix, layout: BoardLayout) -> FloatArray:
    """Predict all corners: found ones where they are, others by the model plus what near ones miss it by."""
    predicted = fix.model.predict(layout.xy_m)
    residual = (fix.uv_px - predicted)[fix.found]
    missing = ~fix.found
    if missing.any():
        apart = np.linalg.norm(layout.xy_m[missing, None] - layout.xy_m[None, fix.found], axis=2)
        weight = 1.0 / (apart + 1e-3 * fix.model.scale_m) ** 4
        predicted[missing] += (weight @ residual) / weight.sum(axis=1, keepdims=True)
    predicted[fix.found] = fix.uv_px[fix.found]
    return predicted


def refine_predicted(
    image: SaddleImage,
    layout: BoardLayout,
    model: GridModel,
    predicted_px: FloatArray,
    search_px: float,
) -> BoardFix | None:
    """Refine corners at predicted places and keep those that pass every check.

    Args:
        image: The picture.
        layout: The board.
        model: Roughly where the board is: gives local axes and so window sizes.
        predicted_px: A place for each corner, shape (n, 2); nan where there is none.
        search_px: Largest distance between prediction and corner.

    Returns:
        None where fewer than four corners pass.
    """
    axes = model.axes_px(layout.xy_m)
    radius = layout.radius_px(axes)
    usable = np.isfinite(predicted_px).all(axis=1) & (radius >= MIN_RADIUS_PX)
    index = np.flatnonzero(usable)
    if len(index) < 4:
        return None
    reach = np.minimum(search_px, 0.5 * radius[index] + 1.5)
    saddles = image.refine(predicted_px[index], radius[index], reach)
    contrast = corner_contrast(image, layout, saddles.uv_px, axes[index], index)
    ok = saddles.ok & (saddles.sigma_px < MAX_SIGMA_PX) & (contrast > MIN_CONTRAST_DN)
    if ok.sum() < 4:
        return None
    ok &= contrast > MIN_CONTRAST * float(np.median(contrast[ok]))
    uv, sigma = np.full((len(usable), 2), np.nan), np.full(len(usable), np.inf)
    uv[index], sigma[index] = saddles.uv_px, saddles.sigma_px
    found = np.zeros(len(usable), bool)
    found[index] = ok
    return consistent(layout, BoardFix(uv, sigma, found, model))


def consistent(layout: BoardLayout, fix: BoardFix) -> BoardFix | None:
    """Fit the model to the corners found and drop those that stand out; None below four."""
    model, found = fix.model, fix.found.copy()
    for _ in range(2):
        if found.sum() < 4:
            return None
        model = model.refit(layout.xy_m[found], fix.uv_px[found])
        wrong = outliers(fix.uv_px - model.predict(layout.xy_m), found, layout.neighbours)
        found &= ~wrong
        if not wrong.any():
            break
    if found.sum() < 4:
        return None
    return BoardFix(fix.uv_px, np.where(found, fix.sigma_px, np.inf), found, model)


def refine_missing(image: SaddleImage, layout: BoardLayout, fix: BoardFix) -> BoardFix:
    """Look once more for the corners that are not found yet, from where their neighbours put them."""
    predicted = predict_with_residuals(fix, layout)
    predicted[fix.found] = np.nan
    height, width = image.shape
    with np.errstate(invalid="ignore"):
        predicted[~((predicted > 0) & (predicted < [width, height])).all(axis=1)] = np.nan
    more = refine_predicted(image, layout, fix.model, predicted, search_px=3.0)
    if more is None:
        return fix
    merged = BoardFix(
        np.where(fix.found[:, None], fix.uv_px, more.uv_px),
        np.minimum(fix.sigma_px, more.sigma_px),
        fix.found | more.found,
        fix.model,
    )
    return consistent(layout, merged) or fix


def corner_contrast(
    image: SaddleImage,
    layout: BoardLayout,
    uv_px: FloatArray,
    axes_px: FloatArray,
    index: npt.NDArray[np.intp],
) -> FloatArray:
    """White minus black sectors around each corner, grey levels; negative where the colours are swapped."""
    arm = 0.6 * layout.reach_m * axes_px
    diagonals = np.stack([arm[:, 0] + arm[:, 1], arm[:, 0] - arm[:, 1]], axis=1)
    spots = uv_px[:, None, None, :] + diagonals[:, :, None, :] * np.array([1.0, -1.0])[:, None]
    level = sample(image.smooth, spots)
    same, other = level[:, 0], level[:, 1]
    mean = (same.sum(axis=1) - other.sum(axis=1)) / 2
    # The weaker side counts: a half-hidden corner has one sector of the wrong colour.
    polarity = layout.polarity[index]
    weakest = np.where(
        polarity > 0, same.min(axis=1) - other.max(axis=1), other.min(axis=1) - same.max(axis=1)
    )
    return np.asarray(np.minimum(mean * polarity, weakest + 0.5 * np.abs(mean)))


def check_identity(image: SaddleImage, layout: BoardLayout, fix: BoardFix) -> BoardFix | None:
    """Make sure that the corners carry their own ids: by the tags' codes, or by where a checkerboard ends.

    Returns:
        The fix, perhaps without hidden tags; None if the board is shifted against its ids.
    """
    if isinstance(layout.target, AprilGrid):
        return check_codes(image, layout, fix)
    return None if is_shifted(image, layout, fix) else fix


def is_shifted(image: SaddleImage, layout: BoardLayout, fix: BoardFix) -> bool:
    """Tell whether a checkerboard goes on beyond its outermost corners, where it must have ended."""
    rim = layout.rim
    if rim is None:
        return False
    uv = fix.model.predict(rim.xy_m)
    axes = fix.model.axes_px(rim.xy_m)
    radius = rim.radius_px(axes)
    height, width = image.shape
    with np.errstate(invalid="ignore"):
        inside = ((uv > radius[:, None]) & (uv < np.array([width, height]) - 1 - radius[:, None])).all(axis=1)
    index = np.flatnonzero(inside & (radius >= MIN_RADIUS_PX))
    if len(index) < MIN_RIM_CORNERS:
        return False
    found = np.flatnonzero(fix.found)
    own = corner_contrast(image, layout, fix.uv_px[found], fix.model.axes_px(layout.xy_m[found]), found)
    saddles = image.refine(uv[index], radius[index], np.minimum(5.0, 0.5 * radius[index] + 1.5))
    contrast = corner_contrast(image, rim, saddles.uv_px, axes[index], index)
    goes_on = saddles.ok & (contrast > 0.5 * float(np.median(own)))
    return bool(goes_on.sum() >= MIN_RIM_CORNERS and goes_on.mean() > MAX_RIM_SHARE)


def check_codes(image: SaddleImage, layout: BoardLayout, fix: BoardFix) -> BoardFix | None:
    """Compare the tags' bits with what the ids promise; a board shifted by a tag does not pass.

    Returns:
        The fix without the corners of hidden tags; None if the board as a whole is not where it seems.
    """
    target = layout.target
    assert isinstance(target, AprilGrid)
    origin = layout.xy_m[::4]
    spots = origin[:, None, :] + bit_centres()[None] * target.tag_size_m
    uv = fix.model.predict(spots.reshape(-1, 2)).reshape(len(origin), BITS * BITS, 2)
    uv += _tag_residual(fix, layout)[:, None, :]
    height, width = image.shape
    inside = ((uv > 0) & (uv < [width - 1, height - 1])).all(axis=(1, 2))
    seen = np.flatnonzero(inside & fix.found.reshape(-1, 4).any(axis=1))
    if not len(seen):
        return None
    match = agreement(sample(image.smooth, uv[seen]), seen)
    if match.mean() < MIN_BOARD_AGREEMENT:
        return None
    hidden = np.zeros(len(origin), bool)
    hidden[seen] = match < MIN_AGREEMENT
    found = fix.found & ~np.repeat(hidden, 4)
    return BoardFix(fix.uv_px, np.where(found, fix.sigma_px, np.inf), found, fix.model)


def _tag_residual(fix: BoardFix, layout: BoardLayout) -> FloatArray:
    """Mean distance of each tag's found corners from the model, px, shape (tags, 2)."""
    residual = np.where(fix.found[:, None], fix.uv_px - fix.model.predict(layout.xy_m), 0.0)
    count = np.maximum(fix.found.reshape(-1, 4).sum(axis=1), 1)
    return np.asarray(residual.reshape(-1, 4, 2).sum(axis=1) / count[:, None])
