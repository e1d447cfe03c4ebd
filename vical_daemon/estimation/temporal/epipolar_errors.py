"""How errors enter an epipolar fit: those that persist along tracks, and the gyro's between two images.

A tracker keeps what it once took for the feature: its error stays for seconds and enters every pair of images
the feature is seen in. Treated as new in every pair, it would average out much faster than it does. Here the
gradient of the fit is written as a sum over single sightings, and their covariance is a white part and a
first-order Markov process along each track, whose sizes and memory come from the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.measurements import FloatArray, IntArray
from vical_daemon.estimation.temporal.epipolar_pairs import Pairs

_MEMORIES_S = (0.1, 0.2, 0.4, 0.8, 1.5, 3.0)  # tried: from one image at 10 Hz to the length of a track
_BINS = 8  # of the time between two images


@dataclass(slots=True)
class Effects:
    """Derivatives of the residuals by what is not modelled.

    Attributes:
        by_first: By the ray in the first image, its x and y, shape (n, 2).
        by_second: In the second, shape (n, 2).
        by_turn: By the turn between both, in the frame in which the gyro is integrated, shape (n, 3).
    """

    by_first: FloatArray
    by_second: FloatArray
    by_turn: FloatArray


@dataclass(frozen=True, slots=True)
class TrackNoise:
    """Errors of sightings: variances of the white and of the persistent part (focal lengths^2), memory, s."""

    white: float
    persistent: float
    memory_s: float


def track_noise(e: FloatArray, lag_s: FloatArray, by_first: FloatArray, by_second: FloatArray) -> TrackNoise:
    """Find the errors' sizes and memory by how residuals grow with the time between two images.

    Args:
        e: Residuals that fit, in focal lengths, shape (n,).
        lag_s: Time between the images of each, s, shape (n,).
        by_first: As in `Effects`, shape (n, 2).
        by_second: Likewise.
    """
    both = (by_first**2 + by_second**2).sum(axis=1)
    cross = 2.0 * (by_first * by_second).sum(axis=1)  # below zero: they take off
    square = e**2
    scale = max(float(square.mean()), 1e-30)
    edges = np.quantile(lag_s, np.linspace(0.0, 1.0, _BINS + 1))
    bins = np.clip(np.searchsorted(edges, lag_s, side="right") - 1, 0, _BINS - 1)
    count = np.maximum(np.bincount(bins, minlength=_BINS), 1)

    def mean(x: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(bins, x, minlength=_BINS) / count)

    found = []
    for memory in _MEMORIES_S:
        A = np.stack([mean(both), mean(both + cross * np.exp(-lag_s / memory))], axis=1)
        x, misfit = _not_negative(A, mean(square) / scale)
        found.append((misfit, TrackNoise(float(x[0] * scale), float(x[1] * scale), memory)))
    return min(found, key=lambda f: f[0])[1]


def _not_negative(A: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Least squares with two unknowns that are not negative, A (n, 2), and the norm of what is left.

    The best is that of both, or of one of them with the other zero. (`scipy.optimize` takes 0.2 s to load.)
    """
    both = np.linalg.lstsq(A, b, rcond=None)[0]
    alone = np.diag(np.maximum(A.T @ b / np.maximum((A**2).sum(axis=0), 1e-300), 0.0))
    choices = [both, *alone] if (both >= 0.0).all() else alone
    return min(((x, float(np.linalg.norm(A @ x - b))) for x in choices), key=lambda found: found[1])


def persistent_scores(
    clear: FloatArray, pairs: Pairs, t_cam_s: FloatArray, effects: Effects, noise: TrackNoise
) -> FloatArray:
    """Covariance of the gradient by errors of the sightings, shape (p, p).

    Args:
        clear: Weighted derivatives of each row with the pair's direction following along, shape (n, p).
        pairs: Of images.
        t_cam_s: Stamps of the images, s.
        effects: Of the sightings on the residuals.
        noise: Of the sightings.
    """
    place, image, track = _sightings(pairs)
    p = clear.shape[1]
    S = np.zeros((len(image), p, 2))
    rows = np.concatenate([clear, clear])
    by = np.concatenate([effects.by_first, effects.by_second])
    for k in range(2):
        for i in range(p):
            S[:, i, k] = np.bincount(place, rows[:, i] * by[:, k], minlength=len(image))
    white = np.einsum("sik,sjk->ij", S, S)
    together = white.copy()
    carried = np.zeros((int(track.max()) + 1, p, 2))
    edges = np.searchsorted(image, np.arange(int(image.max()) + 2))
    before_s = float(t_cam_s[0])
    for i in range(int(image.max()) + 1):
        a, b = int(edges[i]), int(edges[i + 1])
        carried *= np.exp(-(float(t_cam_s[i]) - before_s) / noise.memory_s)
        before_s = float(t_cam_s[i])
        if a == b:
            continue
        mine = S[a:b]
        cross = np.einsum("sik,sjk->ij", mine, carried[track[a:b]])
        together += cross + cross.T
        carried[track[a:b]] += mine
    return np.asarray(noise.white * white + noise.persistent * together)


def sighting_errors(
    pairs: Pairs, t_cam_s: FloatArray, noise: TrackNoise, focal_px: float
) -> tuple[FloatArray, FloatArray]:
    """Draw errors of all sightings, px, for the rows' first and second images, shape (n, 2) each.

    Args:
        pairs: Of images.
        t_cam_s: Stamps of the images, s.
        noise: Their sizes and memory.
        focal_px: Focal length, px.
    """
    rng = np.random.default_rng(0)
    place, image, track = _sightings(pairs)
    errors = rng.normal(0.0, np.sqrt(noise.white), (len(image), 2))
    lasting = rng.normal(0.0, 1.0, (int(track.max()) + 1, 2))
    edges = np.searchsorted(image, np.arange(int(image.max()) + 2))
    for i in range(int(image.max()) + 1):
        if i:
            keep = np.exp(-(t_cam_s[i] - t_cam_s[i - 1]) / noise.memory_s)
            lasting = keep * lasting + np.sqrt(1.0 - keep**2) * rng.normal(0.0, 1.0, lasting.shape)
        part = slice(int(edges[i]), int(edges[i + 1]))
        errors[part] += np.sqrt(noise.persistent) * lasting[track[part]]
    rows = focal_px * errors[place]
    return rows[: len(pairs.of)], rows[len(pairs.of) :]


def _sightings(pairs: Pairs) -> tuple[IntArray, IntArray, IntArray]:
    """Sighting of each row's feature in its first images, then in its second ones, shape (2 n,).

    And the image and the feature of each sighting, in the order of the images.
    """
    frame = np.concatenate([pairs.first[pairs.of], pairs.second[pairs.of]])
    _, feature = np.unique(np.concatenate([pairs.ids, pairs.ids]), return_inverse=True)
    features = int(feature.max()) + 1
    sighting, place = np.unique(frame * features + feature, return_inverse=True)
    return place, *np.divmod(sighting, features)


def gyro_scores(
    clear: FloatArray, pairs: Pairs, t_cam_s: FloatArray, effects: Effects, density: float
) -> FloatArray:
    """Covariance of the gradient by the gyro's white noise between images, shape (p, p).

    Args:
        clear: As in `persistent_scores`.
        pairs: Of images.
        t_cam_s: Stamps of the images, s.
        effects: Of turns on the residuals.
        density: rad/s/sqrt(Hz).
    """
    each = np.add.reduceat(clear[:, :, None] * effects.by_turn[:, None, :], pairs.begin)
    steps = np.zeros((len(t_cam_s), *each.shape[1:]))
    np.add.at(steps, pairs.first, each)
    np.add.at(steps, pairs.second, -each)
    open_pairs = np.cumsum(steps, axis=0)[:-1]  # all pairs that an interval between images lies in
    return np.asarray(density**2 * np.einsum("t,tik,tjk->ij", np.diff(t_cam_s), open_pairs, open_pairs))
