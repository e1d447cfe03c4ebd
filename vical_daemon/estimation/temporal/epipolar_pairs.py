"""Pairs of images that share features, for the epipolar constraint."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, Frames, IntArray
from vical_daemon.estimation.temporal.track_orientations import MIN_FEATURES

LAGS_S = (0.1, 0.25, 0.5)  # between the images of a pair: a hand turns by 5 to 30 deg meanwhile


@dataclass(slots=True)
class Pairs:
    """Features seen in both images of a pair, sorted by pair.

    Attributes:
        first, second: Places of the pair's images in the list of images, shape (P,).
        begin: First row of the pair, shape (P,).
        of: Pair of each row, shape (n,).
        ids: Feature of each row, shape (n,).
        uv: Pixels of all sightings; one is in up to six pairs; shape (s, 2).
        at_1, at_2: Sighting of each row's feature in both images, shape (n,).
    """

    first: IntArray
    second: IntArray
    begin: IntArray
    of: IntArray
    ids: IntArray
    uv: FloatArray
    at_1: IntArray
    at_2: IntArray

    def moved(self, first: FloatArray, second: FloatArray) -> Pairs:
        """Return pairs of which the pixels in both images are moved by row, px, shape (n, 2) each."""
        uv = np.concatenate([self.uv[self.at_1] + first, self.uv[self.at_2] + second])
        at_1, at_2 = np.arange(len(uv)).reshape(2, -1)
        return replace(self, uv=uv, at_1=at_1, at_2=at_2)


def make_pairs(frames: Frames, lags_s: tuple[float, ...] = LAGS_S, every: int = 1) -> Pairs | None:
    """Pair images a tenth, a quarter and half a second apart; None where too few share features.

    Args:
        frames: (stamp in the camera's clock in s, tracks), in order of time.
        lags_s: Other times apart, s.
        every: Begin a pair in every n-th image only.
    """
    t = np.array([s for s, _ in frames])
    begin = np.cumsum([0, *(len(f.ids) for _, f in frames)])
    first, second, count, ids, at_1, at_2 = [], [], [], [], [], []
    for lag in lags_s:
        step = max(1, int(np.median(np.searchsorted(t, t[: len(t) // 2] + lag) - np.arange(len(t) // 2))))
        for i in range(0, len(t) - step, every):
            j = i + step
            if not 0.3 * lag < t[j] - t[i] < 3.0 * lag:
                continue
            a, b = frames[i][1], frames[j][1]
            shared, ka, kb = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
            if len(ka) < MIN_FEATURES:
                continue
            first.append(i)
            second.append(j)
            count.append(len(ka))
            ids.append(shared)
            at_1.append(begin[i] + ka)
            at_2.append(begin[j] + kb)
    if len(first) < 10:
        return None
    sizes = np.array(count)
    used, at = np.unique(np.concatenate([*at_1, *at_2]), return_inverse=True)
    return Pairs(
        np.array(first),
        np.array(second),
        np.concatenate([[0], np.cumsum(sizes)[:-1]]),
        np.repeat(np.arange(len(sizes)), sizes),
        np.concatenate(ids),
        np.concatenate([f.uv_px for _, f in frames])[used],
        *at.reshape(2, -1),
    )
