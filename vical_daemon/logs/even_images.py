"""Stamps of a camera that samples evenly, recovered from stamps that were taken on arrival.

A naive driver stamps an image when it has it: late by the transfer, the buffers and the scheduler. As with
an imu (`even_stamps`) a delay is never negative, so the true times follow the lower envelope of the stamps.
Other than inertial readings, images are lost or doubled all the time, but their delays are mostly shorter
than their period: which image of the even grid one is, follows from its stamp.

Cameras need not sample evenly: a trigger in software, or an exposure that changes, moves the middle of the
exposure. Whether the even grid is the better time axis is decided by how smoothly points move in the image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vical_daemon.bus.messages import MessageError, decode_compressed_image, decode_image, decode_points
from vical_daemon.estimation.measurements import BoolArray, FloatArray, IntArray
from vical_daemon.logs.even_stamps import CERTAIN, EvenStamps, lateness, rounded

_BLOCK = 20
"""Of so many images the earliest arrival counts: with exponential delays it is late by 1/20 of their mean."""
_SLOT = 0.75
"""An image is at most so much of a period later than the earliest arrivals about it; otherwise it is the next
image of the grid, unless that one is taken."""
_GAP = 40
"""A gap of so many periods begins a new piece: the period is known to 1 % before the fit."""
_EVEN_S = 2e-4
"""Stamps that deviate less stay as they are, s: 0.1 px at 1 rad/s and f = 500 px, less than corners have."""
_LEAST = 60  # images: three blocks
_NEAR = 0.35
"""90 % of the images of an even camera lie within so much of a period of the middle; of any other, 0.45."""
_CHUNKS, _CHUNK = 10, 60
"""So many stretches of so many images decide, spread over the recording."""
_SPANS = (1, 3, 9)
"""Images over which the period is found: the number of periods in each span follows from the span before."""
_PARTS = (1, 2, 3)
"""The usual interval may hold so many periods: a limited rate lets every second or third image pass."""
_MOST = 3.0  # of the logarithm of one ratio of errors: an image counts twenty times at most
_TINY_PX = 1e-3


class ImagePoints(NamedTuple):
    """Points of one image: ids, shape (n,), increasing, and pixels, shape (n, 2)."""

    ids: IntArray
    uv_px: FloatArray


def already_even(t_ns: IntArray) -> bool:
    """Whether all intervals are multiples of one, within `_EVEN_S`: nothing is to be done then."""
    intervals_s = np.diff(t_ns) * 1e-9
    if not len(intervals_s) or not (period_s := float(np.median(intervals_s))) > 0.0:
        return True
    return bool((np.abs(intervals_s - period_s * np.round(intervals_s / period_s)) < _EVEN_S).all())


class CameraStamps:
    """Stamps of the images of one camera, and better ones where there are.

    Args:
        t_ns: Stamps in the order of the recording, ns, shape (n,).
        marks: By which an image that was delivered twice is recognised (`mark_of`), shape (n,).
        until_ns: Later images show which of those before were late, and get no stamps; None: all get some.
        log_odds: See `EvenStamps`, where known from earlier images.
    """

    def __init__(
        self,
        t_ns: IntArray,
        marks: IntArray,
        until_ns: int | None = None,
        log_odds: float | None = None,
    ) -> None:
        self.t_ns, first = np.unique(t_ns, return_index=True)
        marks = marks[first]
        self._again: BoolArray = np.append(False, marks[1:] == marks[:-1])[: len(self.t_ns)]
        first_ns, count = self.t_ns[~self._again], None
        if until_ns is not None:
            count = int(np.searchsorted(first_ns, until_ns, "right"))
            kept = self.t_ns <= until_ns
            self.t_ns, self._again = self.t_ns[kept], self._again[kept]
        self._grid = even_grid(first_ns, count, log_odds)
        self._images: dict[int, ImagePoints] = {}

    @property
    def wanted(self) -> set[int]:
        """Stamps of the images that are needed for a decision; empty: the stamps stay as they are."""
        if self._grid is None:
            return set()
        return {int(t) for chunk in self._chunks() for t in self.first_ns[chunk]}

    @property
    def first_ns(self) -> IntArray:
        """Stamps of the images, ns; of one that was delivered twice the first, shape (m,)."""
        return self.t_ns[~self._again]

    @property
    def log_odds(self) -> float:
        """See `EvenStamps`; 0 where there is no even grid."""
        return 0.0 if self._grid is None else self._grid.log_odds

    def _chunks(self) -> list[slice]:
        count = int((~self._again).sum())
        begins = np.linspace(0, max(count - _CHUNK, 0), _CHUNKS).astype(int)
        if count <= _CHUNK * _CHUNKS:
            return [slice(0, count)]
        return [slice(begin, begin + _CHUNK) for begin in begins.tolist()]

    def take(self, t_ns: int, image: ImagePoints | None) -> None:
        """Take an image that is wanted."""
        if image is not None:
            self._images[t_ns] = image

    def even(self, certain: float = CERTAIN) -> EvenStamps | None:
        """Decide.

        Args:
            certain: Standard errors by which points must move more smoothly over the even grid.

        Returns:
            Stamps for `t_ns`; None where these stay as they are.
        """
        if self._grid is None:
            return None
        old_ns, new_ns = self.first_ns, self._grid.t_ns
        found: list[float] = []
        for chunk in self._chunks():
            images = [self._images.get(t) for t in old_ns[chunk].tolist()]
            found += gains(images, *((t[chunk] - old_ns[0]) * 1e-9 for t in (old_ns, new_ns)))
        if len(found) < 3 or not np.mean(found) > certain * np.std(found) / np.sqrt(len(found)):
            return None
        return self.on_grid()

    def on_grid(self) -> EvenStamps | None:
        """Return stamps for `t_ns` on the even grid, better or not; None: there is none."""
        if self._grid is None:
            return None
        stamps = np.empty_like(self.t_ns)
        stamps[~self._again] = self._grid.t_ns
        for k in np.flatnonzero(self._again).tolist():
            stamps[k] = stamps[k - 1] + 1000  # the same image once more: the estimator leaves it out
        return self._grid._replace(t_ns=stamps)


def mark_of(payload: bytes) -> int:
    """Return a number that two messages share if they differ in nothing but the stamp."""
    return hash(payload[12 :: max(len(payload) // 1000, 1)])


class PointReader:
    """Finds points in messages of one camera, to be read in their order.

    Args:
        kind: points, tracks, image or compressed, see `model.Kind`.
    """

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._tracker: Any = None

    def read(self, payload: bytes) -> ImagePoints | None:
        """Return the points of one message; None if there are none, or it cannot be read."""
        try:
            found = self._found(payload)
        except (MessageError, ValueError):
            return None
        if found is None or not len(found.ids):
            return None
        ids, first = np.unique(found.ids, return_index=True)
        return ImagePoints(ids, found.uv_px[first])

    def _found(self, payload: bytes) -> Any:
        if self._kind in ("points", "tracks"):
            return decode_points(payload).to_frame()
        if self._tracker is None:
            from vical_daemon.vision.tracks import FeatureTracker

            self._tracker = FeatureTracker()
        if self._kind == "image":
            return self._tracker.detect(decode_image(payload).pixels())
        from vical_daemon.vision import image_codec

        data = np.frombuffer(decode_compressed_image(payload).data, np.uint8)
        return self._tracker.detect(image_codec.decode_image(data))


def even_grid(t_ns: IntArray, count: int | None = None, log_odds: float | None = None) -> EvenStamps | None:
    """Put images on the even grid of their camera, whether or not it samples evenly.

    Args:
        t_ns: Sorted stamps of different images, ns, shape (n,).
        count: Only so many get new stamps; those after them show which of them were late. None: all.
        log_odds: See `EvenStamps`, where known from earlier images.

    Returns:
        None where the stamps are even already, rounded, or far from any grid.
    """
    if len(t_ns) < _LEAST or already_even(t_ns):
        return None
    t_s = (t_ns - t_ns[0]) * 1e-9
    intervals_s = np.diff(t_s)
    usual_s = float(np.median(intervals_s))
    if not usual_s > 0.0:
        return None
    usual_s = float(np.median(intervals_s[np.abs(intervals_s / usual_s - 1.0) < 0.5]))  # nothing is lost
    for parts in _PARTS:
        grid = _grid_of(t_ns, t_s, _refined_s(t_s, usual_s / parts), count, log_odds)
        if grid is not None:
            return grid
    return None


def _refined_s(t_s: FloatArray, period_s: float) -> float:
    """A period from longer and longer intervals, whose number of periods the shorter ones show, s."""
    for span in _SPANS:
        intervals_s = t_s[span:] - t_s[:-span]
        periods = np.maximum(np.round(intervals_s / period_s), 1.0)
        period_s = float(np.median(intervals_s / periods))
    return period_s


def _grid_of(
    t_ns: IntArray, t_s: FloatArray, period_s: float, count: int | None, log_odds: float | None
) -> EvenStamps | None:
    """See `even_grid`: the grid with about this period."""
    cuts = np.flatnonzero(np.diff(t_s) > _GAP * period_s) + 1
    bounds = [0, *cuts.tolist(), len(t_s)]
    for _ in range(2):  # the second time with the period of the first fit
        slots = np.concatenate([_slots(t_s[a:b], period_s) for a, b in pairwise(bounds)])
        period_s = _period_s(t_s, slots, bounds, period_s)
    t_ns, t_s, slots = t_ns[:count], t_s[:count], slots[:count]
    bounds = [*(bound for bound in bounds if bound < len(t_s)), len(t_s)]
    grid_s = period_s * slots
    late = lateness(grid_s, t_s - grid_s, bounds, _BLOCK, log_odds)
    even_s = grid_s + late.late_s
    taken_s = t_s - even_s
    new_ns = t_ns[0] + np.round(even_s * 1e9).astype(np.int64)
    middle_s = float(np.median(taken_s))
    if np.quantile(np.abs(taken_s - middle_s), 0.9) > _NEAR * period_s or (np.diff(new_ns) <= 0).any():
        return None
    jitter_s = float(taken_s.std())
    if jitter_s < _EVEN_S or rounded(t_ns, taken_s, period_s):
        return None
    largest_s = float(taken_s.max()) - middle_s
    return EvenStamps(new_ns, jitter_s, largest_s, late.sigma_s, len(bounds) - 1, late.log_odds)


def _slots(t_s: FloatArray, period_s: float) -> IntArray:
    """Number on the grid of each image of one piece, shape (n,), strictly increasing."""
    times = t_s.tolist()  # each place follows from those before: arrays would take three times as long
    count, slots, late_s = len(times), [0] * len(times), [0.0] * len(times)
    earliest_s = times[0]  # of the block before an image
    for k, time_s in enumerate(times):
        slots[k] = math.floor((time_s - earliest_s) / period_s + 1.0 - _SLOT)
        late_s[k] = time_s - slots[k] * period_s
        if k == 0 or late_s[k] <= earliest_s:
            earliest_s = late_s[k]
        elif k >= _BLOCK and late_s[k - _BLOCK] == earliest_s:
            earliest_s = min(late_s[k - _BLOCK + 1 : k + 1])
    # The first ones may all have been late, and a late image takes the place before the next one.
    for k in range(count - 2, -1, -1):
        last = k + _BLOCK  # of the block behind the image
        if last >= count:
            earliest_s = min(late_s[max(k - _BLOCK, 0) : k + 1])
        elif last == count - 1 or late_s[last + 1] == earliest_s:
            earliest_s = min(late_s[k + 1 : last + 1])
        else:
            earliest_s = min(earliest_s, late_s[k + 1])
        place = math.floor((times[k] - earliest_s) / period_s + 1.0 - _SLOT)
        slots[k] = min(place, slots[k + 1] - 1)
        late_s[k] = times[k] - slots[k] * period_s
    return np.array(slots, dtype=np.int64)


def _period_s(t_s: FloatArray, slots: IntArray, bounds: list[int], period_s: float) -> float:
    """The period by which the earliest arrivals of the longest piece are even, s."""
    a, b = max(pairwise(bounds), key=lambda piece: piece[1] - piece[0])
    late_s = t_s[a:b] - period_s * slots[a:b]
    blocks = [a + k + int(late_s[k : k + _BLOCK].argmin()) for k in range(0, b - a - _BLOCK + 1, _BLOCK)]
    if len(blocks) < 2:
        return period_s
    return float(np.polyfit(slots[blocks], t_s[blocks], 1)[0])


def gains(images: Sequence[ImagePoints | None], old_s: FloatArray, new_s: FloatArray) -> list[float]:
    """How much more smoothly points move over new stamps than over old ones.

    Each image is compared with the cubic through the two before and the two after it. Its distance is divided
    by what noise of the points alone would give on a time axis.

    Args:
        images: Consecutive images of one camera; None: nothing was found in it.
        old_s: Their stamps, s, shape (n,).
        new_s: Other stamps of them, s, shape (n,).

    Returns:
        Logarithms of the ratio of errors, of means of five images: they share points with each other.
    """
    if len(images) < 5:
        return []
    out, weights = [], np.stack([_weights(t) for t in (old_s, new_s)], axis=1)
    noise = np.sqrt(1.0 + np.vecdot(weights, weights))
    for k in range(len(weights)):
        five = [image for image in images[k : k + 5] if image is not None]
        if len(five) == 5 and (uv := _common(five)).size:
            old, new = np.where(weights[k].any(axis=1), _errors_px(uv, weights[k]) / noise[k], np.inf)
            ratio = math.log((old + _TINY_PX) / (new + _TINY_PX))
            out.append(min(max(ratio, -_MOST), _MOST))
    return [float(np.mean(out[k : k + 5])) for k in range(0, len(out) - 4, 5)]


def _weights(t_s: FloatArray) -> FloatArray:
    """Weights by which a cubic through the two images before and after each predicts it, shape (n - 4, 4).

    Zeros where two images came at once.
    """
    five = sliding_window_view(t_s, 5)
    x = np.delete(five, 2, axis=1) - five[:, 2:3]
    spans = x[:, None] - x[:, :, None]
    once = ((spans == 0.0).sum(axis=(1, 2)) > 4)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(np.eye(4, dtype=bool), 1.0, x[:, None] / spans)
    return np.where(once, 0.0, np.prod(shares, axis=2))


def _common(images: Sequence[ImagePoints]) -> FloatArray:
    """Pixels of the points that all images show, shape (images, n, 2)."""
    ids = images[0].ids
    if all(np.array_equal(image.ids, ids) for image in images[1:]):
        return np.stack([image.uv_px for image in images])
    for image in images[1:]:
        ids = np.intersect1d(ids, image.ids, assume_unique=True)
    return np.stack([image.uv_px[np.searchsorted(image.ids, ids)] for image in images])


def _errors_px(uv_px: FloatArray, weights: FloatArray) -> FloatArray:
    """Distances of the middle of five images from cubics through the others, px: medians over points.

    Args:
        uv_px: Of the same points, shape (5, n, 2).
        weights: Of the others for each cubic, see `_weights`, shape (m, 4).

    Returns:
        Shape (m,).
    """
    others = np.concatenate([uv_px[:2], uv_px[3:]]).reshape(4, -1)
    error = uv_px[2] - (weights @ others).reshape(len(weights), -1, 2)
    sizes, n = np.sort(np.hypot(error[..., 0], error[..., 1]), axis=1), error.shape[1]
    return np.asarray(0.5 * (sizes[:, (n - 1) // 2] + sizes[:, n // 2]))  # numpy's takes five times as long
