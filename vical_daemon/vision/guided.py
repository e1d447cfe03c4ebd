"""Find every corner of a board whose place is roughly known: refine, check, and grow to what is left.

The start may come from decoded tags, from the last frame or from the filter's prediction. A corner counts
only if it is a saddle, if its four sectors have the right colours, and if it lies where its neighbours say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.vision.detection import FloatArray, median
from vical_daemon.vision.grid_model import GridModel, fit_grid, outliers
from vical_daemon.vision.layout import BoardLayout
from vical_daemon.vision.saddle import SaddleImage
from vical_daemon.vision.tag_code import agreement, bit_places
from vical_daemon.vision.target import AprilGrid

BoolArray = npt.NDArray[np.bool_]

MIN_RADIUS_PX = 1.6  # of the window around a corner: twice the smoothing
MIN_CONTRAST = 0.3
"""Of the board's median corner contrast: below, a corner is hidden or washed out."""
MIN_CONTRAST_DN = 6.0  # grey levels; below, noise looks like corners
MAX_SIGMA_PX = 2.0  # of a corner; usual ones have 0.1
GROW_ROUNDS = 3  # fits of the board's model, each to the corners that the last one found
MIN_AGREEMENT = 0.3  # of the bits of a tag with its code, see `agreement`; below, it is hidden
MIN_BOARD_AGREEMENT = 0.35  # mean over the tags; below, the board is not where it seems
RETRY_PX = 0.5
"""A corner that was not found is looked for again where its prediction moved by more than this."""
MANY_NEW = 0.1
"""Share of new corners above which the model is fitted again."""
MIN_RIM_CORNERS = 3  # beyond a checkerboard's edge that look like corners, before it counts as shifted
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
        predicted_px: What the model predicts, shape (n, 2); nan behind the camera.
        places_px: Where each corner is, or should be by the model and what near ones miss it by, (n, 2).
        tried_px: Where each corner was looked for last, shape (n, 2); nan: nowhere.
        contrast_dn: Median corner contrast, grey levels.
    """

    uv_px: FloatArray
    sigma_px: FloatArray
    found: BoolArray
    model: GridModel
    predicted_px: FloatArray
    places_px: FloatArray
    tried_px: FloatArray
    contrast_dn: float


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
    keep = known & ~outliers(uv_px - model.predict(layout.xy_m), known, layout.neighbours, floor_px=2.5)
    if keep.sum() < 4:
        return None
    return grow_board(image, layout, model.refit(layout.xy_m[keep], uv_px[keep]), uv_px, keep)


def grow_board(
    image: SaddleImage, layout: BoardLayout, model: GridModel, uv_px: FloatArray, known: BoolArray
) -> BoardFix | None:
    """Refine `known` corners and find the others around them, nearest first by rounds."""
    start = predict_with_residuals(layout, model, model.predict(layout.xy_m), uv_px, known)
    fix = refine_predicted(image, layout, model, start, search_px=3.0)
    if fix is None:
        return None
    for _ in range(GROW_ROUNDS):
        before = int(fix.found.sum())
        fix = refine_missing(image, layout, fix)
        if int(fix.found.sum()) <= before:
            break
    return check_identity(image, layout, fix)


def predict_with_residuals(
    layout: BoardLayout, model: GridModel, predicted_px: FloatArray, uv_px: FloatArray, found: BoolArray
) -> FloatArray:
    """Predict all corners: found ones where they are, others by the model plus what near ones miss it by."""
    best = np.where(found[:, None], uv_px, predicted_px)
    missing = ~found
    if missing.any() and found.any():
        residual = (uv_px - predicted_px)[found]
        dx, dy = (layout.xy_m[missing, None] - layout.xy_m[None, found]).transpose(2, 0, 1)
        apart2 = dx * dx + dy * dy + (1e-3 * model.scale_m) ** 2
        weight = 1.0 / (apart2 * apart2)
        best[missing] += (weight @ residual) / weight.sum(axis=1, keepdims=True)
    return best


@dataclass(frozen=True)
class _Look:
    """Corners looked for at some places, before they are compared with each other; as in `BoardFix`."""

    uv_px: FloatArray
    sigma_px: FloatArray
    found: BoolArray
    contrast_dn: float


def refine_predicted(
    image: SaddleImage, layout: BoardLayout, model: GridModel, predicted_px: FloatArray, search_px: float
) -> BoardFix | None:
    """Refine corners at predicted places and keep those that pass every check.

    Args:
        image: The picture.
        layout: The board.
        model: Roughly where the board is.
        predicted_px: A place for each corner, shape (n, 2); nan where there is none. Its differences along
            the board give the sizes of the windows.
        search_px: Largest distance between prediction and corner.

    Returns:
        None where fewer than four corners pass.
    """
    look = _look(image, layout, predicted_px, np.ones(len(predicted_px), bool), search_px)
    if look is None or look.found.sum() < 4:
        return None
    model = model.refit(layout.xy_m[look.found], look.uv_px[look.found])
    return _consistent(layout, look, model, predicted_px)


def _look(
    image: SaddleImage, layout: BoardLayout, places_px: FloatArray, wanted: BoolArray, search_px: float
) -> _Look | None:
    """Refine the wanted corners; None where fewer than four are in reach or pass."""
    if np.count_nonzero(wanted) < 4:
        return None
    axes = layout.steps.axes_px(places_px)
    radius = layout.radius_px(axes)
    index = np.flatnonzero(wanted & np.isfinite(places_px[:, 0]) & (radius >= MIN_RADIUS_PX))
    if len(index) < 4:
        return None
    axes, radius = axes[index], radius[index]
    reach = np.minimum(search_px, 0.5 * radius + 1.5)
    saddles = image.refine(places_px[index], radius, reach)
    contrast = corner_contrast(image, layout, saddles.uv_px, axes, index)
    ok = saddles.ok & (saddles.sigma_px < MAX_SIGMA_PX) & (contrast > MIN_CONTRAST_DN)
    if np.count_nonzero(ok) < 4:
        return None
    usual = median(contrast[ok])
    uv, sigma = np.full(places_px.shape, np.nan), np.full(len(places_px), np.inf)
    uv[index], sigma[index] = saddles.uv_px, saddles.sigma_px
    found = np.zeros(len(places_px), bool)
    found[index] = ok & (contrast > MIN_CONTRAST * usual)
    return _Look(uv, sigma, found, usual)


def _consistent(layout: BoardLayout, look: _Look, model: GridModel, tried_px: FloatArray) -> BoardFix | None:
    """Drop the corners that stand out from the model and their neighbours; None below four."""
    predicted = model.predict(layout.xy_m)
    found = look.found & ~outliers(look.uv_px - predicted, look.found, layout.neighbours)
    if found.sum() < 4:
        return None
    places = predict_with_residuals(layout, model, predicted, look.uv_px, found)
    sigma = np.where(found, look.sigma_px, np.inf)
    return BoardFix(look.uv_px, sigma, found, model, predicted, places, tried_px, look.contrast_dn)


def refine_missing(image: SaddleImage, layout: BoardLayout, fix: BoardFix) -> BoardFix:
    """Look for the corners that are not found yet, where their neighbours put them unless looked there."""
    height, width = image.shape
    u, v = fix.places_px.T
    wanted = ~fix.found & (u > 0) & (u < width) & (v > 0) & (v < height)
    wanted &= ~(np.abs(fix.places_px - fix.tried_px).max(axis=1) < RETRY_PX)
    more = _look(image, layout, fix.places_px, wanted, search_px=3.0)
    if more is None:
        return fix
    found = fix.found | more.found
    uv = np.where(fix.found[:, None], fix.uv_px, more.uv_px)
    both = _Look(uv, np.minimum(fix.sigma_px, more.sigma_px), found, fix.contrast_dn)
    model = fix.model
    if more.found.sum() > MANY_NEW * fix.found.sum():
        model = model.refit(layout.xy_m[found], uv[found])
    return _consistent(layout, both, model, fix.places_px) or fix


def corner_contrast(
    image: SaddleImage,
    layout: BoardLayout,
    uv_px: FloatArray,
    axes_px: FloatArray,
    index: npt.NDArray[np.intp],
) -> FloatArray:
    """White minus black sectors around each corner, grey levels; negative where the colours are swapped."""
    arm = 0.6 * layout.reach_m * axes_px
    along, across = arm[:, 0] + arm[:, 1], arm[:, 0] - arm[:, 1]
    spots = np.stack([uv_px + along, uv_px - along, uv_px + across, uv_px - across])
    a, b, c, d = image.levels(spots)  # a and b are of one colour, c and d of the other
    mean = (a + b - c - d) / 2
    # The weaker side counts: a half-hidden corner has one sector of the wrong colour.
    polarity = layout.polarity[index]
    weakest = np.where(
        polarity > 0,
        np.minimum(a, b) - np.maximum(c, d),
        np.minimum(c, d) - np.maximum(a, b),
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
    if rim is None or rim.rim_index is None:
        return False
    places = fix.model.predict(rim.xy_m)
    axes = rim.steps.take(rim.rim_index).axes_px(places)
    uv, radius = places[rim.rim_index], rim.radius_px(axes)
    height, width = image.shape
    u, v = uv.T
    inside = (u > radius) & (u < width - 1 - radius) & (v > radius) & (v < height - 1 - radius)
    chosen = np.flatnonzero(inside & (radius >= MIN_RADIUS_PX))
    if len(chosen) < MIN_RIM_CORNERS:
        return False
    index = rim.rim_index[chosen]
    # A corner would lie within a pixel or two of its place, and show most of its contrast there.
    near = corner_contrast(image, rim, uv[chosen], axes[chosen], index)
    if np.count_nonzero(near > 0.4 * fix.contrast_dn) < MIN_RIM_CORNERS:
        return False
    saddles = image.refine(uv[chosen], radius[chosen], np.minimum(5.0, 0.5 * radius[chosen] + 1.5))
    contrast = corner_contrast(image, rim, saddles.uv_px, axes[chosen], index)
    goes_on = saddles.ok & (contrast > 0.5 * fix.contrast_dn)
    return bool(goes_on.sum() >= MIN_RIM_CORNERS and goes_on.mean() > MAX_RIM_SHARE)


def check_codes(image: SaddleImage, layout: BoardLayout, fix: BoardFix) -> BoardFix | None:
    """Compare the tags' bits with what the ids promise; a board shifted by a tag does not pass.

    Returns:
        The fix without the corners of hidden tags; None if the board as a whole is not where it seems.
    """
    quads, found = fix.places_px.reshape(-1, 4, 2), fix.found.reshape(-1, 4)
    height, width = image.shape
    u, v = quads[..., 0], quads[..., 1]
    inside = ((u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)).all(axis=1)
    seen = np.flatnonzero(inside & found.any(axis=1))
    if not len(seen):
        return None
    first = layout.target.first_tag if isinstance(layout.target, AprilGrid) else 0
    match = agreement(image.levels(bit_places(quads[seen])), seen + first)
    if match.mean() < MIN_BOARD_AGREEMENT:
        return None
    hidden = match < MIN_AGREEMENT
    if not hidden.any():
        return fix
    found = found.copy()
    found[seen[hidden]] = False
    left = _Look(fix.uv_px, fix.sigma_px, found.ravel(), fix.contrast_dn)
    return _consistent(layout, left, fix.model, fix.tried_px)
