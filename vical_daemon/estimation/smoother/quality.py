"""Quality of the data of an adjusted window: how long pixel errors last, and the parallax of its points."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.robust import huber_weight
from vical_daemon.estimation.smoother.normal import HUBER
from vical_daemon.estimation.smoother.window import Seen, Window

_MEMORY = 25  # images over which an error of the pixels may last


def correlation(e: FloatArray, seen: Seen) -> float:
    """By how much the variance of a track's mean error exceeds that of white noise: 1 + 2 sum rho_k.

    Errors that stay with a feature from image to image (lens, tracker, blur) count once, not once an image.
    The sum ends where the correlation is lost in its own noise. [Geyer, "Practical Markov chain Monte
    Carlo", 1992, initial positive sequence]
    """
    e = e * huber_weight(np.sqrt((e**2).sum(axis=1, keepdims=True)), HUBER)
    variance = float((e**2).mean())
    total = 1.0
    for k in range(1, _MEMORY):
        if len(e) <= k:
            break
        same = (seen.landmark[k:] == seen.landmark[:-k]) & (seen.frame[k:] - seen.frame[:-k] == k)
        count = int(same.sum())
        if count < 50:
            break
        rho = float((e[k:][same] * e[:-k][same]).sum()) / (2.0 * count * max(variance, 1e-12))
        if rho < 2.0 / np.sqrt(2.0 * count):
            break
        total += 2.0 * rho
    return total


def parallax_deg(window: Window, seen: Seen) -> float:
    """Median angle between the first and last ray of the landmarks, deg."""
    last = np.concatenate([seen.begin[1:], [len(seen.frame)]]) - 1
    m = window.landmarks
    X = m.bearing + m.inverse[:, None] * m.anchor
    ends = [X - m.inverse[:, None] * window.p[seen.frame[at]] for at in (seen.begin, last)]
    a, b = (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12) for x in ends)
    return float(np.rad2deg(np.median(np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0)))))
