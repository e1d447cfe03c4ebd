"""Meters for the operator: what is known of what is needed, blur, light, rate, share of the board. No I/O."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import ConvergenceTargets, FloatArray, IntArray
from vical_daemon.estimation.result import CameraEstimate

BLUR_PX = 1.0
"""Motion of corners in an exposure that is too much: from about one pixel on, blur biases detectors."""
_MEMORY = 30  # images over which rate and blur are taken
_GAP_S = 0.5  # between two images: longer ones say nothing about speed
_DARK, _BRIGHT = 60, 235  # 8-bit levels of the brightest and of saturated pixels
_SATURATED = 0.02  # share of pixels


def known_of_needed(
    camera: CameraEstimate, targets: ConvergenceTargets, *, enough: bool = False
) -> list[dict[str, Any]]:
    """Return a meter for each axis of translation and rotation (camera frame) and for the time shift.

    A meter shows the information that the data have given over what is needed: the squared ratio of the
    sigma that counts as converged to the present one. With steady motion it grows steadily.

    Args:
        camera: Its estimate.
        targets: Sigmas that count as converged.
        enough: The estimator calls it converged: every meter is full. (The sigma of the time shift then still
            contains what the IMU's driver does not know of its stamps, which no motion can improve.)

    Returns:
        `name`, `kind` (translation, rotation or time), `share` (0 to 1) and `sigma` with `unit`. What was
        held fixed has no meter.
    """
    pose = camera.T_imu_cam
    covariance = np.asarray(pose.covariance, dtype=np.float64)
    R = so3.matrix_from_quat(np.asarray(pose.q_wxyz, dtype=np.float64))
    in_cam = np.diag(R.T @ covariance[:3, :3] @ R), np.diag(covariance)[3:]
    meters: list[dict[str, Any]] = []
    for kind, variances, limit, unit, scale in (
        ("translation", in_cam[0], targets.position_m, "mm", 1e3),
        ("rotation", in_cam[1], targets.rotation_rad, "°", 180.0 / math.pi),
        ("time", np.array([camera.timeshift_sigma_s**2]), targets.timeshift_s, "ms", 1e3),
    ):
        names = ("x", "y", "z") if len(variances) == 3 else ("shift",)
        for name, variance in zip(names, variances, strict=True):
            if variance > 0.0 and math.isfinite(variance):
                share = 1.0 if enough else min(limit**2 / float(variance), 1.0)
                sigma = float(f"{scale * math.sqrt(variance):.3g}")
                meters.append(
                    {"kind": kind, "name": name, "share": round(share, 3), "sigma": sigma, "unit": unit}
                )
    return meters


class Motion:
    """Speed of the corners in the image, rate of the images, and how much of the board they show."""

    def __init__(self) -> None:
        self._last: tuple[float, IntArray, FloatArray] | None = None
        self._speeds: deque[float] = deque(maxlen=_MEMORY)
        self._stamps: deque[float] = deque(maxlen=_MEMORY)
        self._most = 0
        self.count = 0

    def add(self, t_s: float, ids: IntArray, uv_px: FloatArray) -> None:
        """Take the corners of one image: stamp, ids (n,), pixels (n, 2)."""
        self._stamps.append(t_s)
        self.count, self._most = len(ids), max(self._most, len(ids))
        if self._last is not None and 0.0 < t_s - self._last[0] < _GAP_S:
            _, a, b = np.intersect1d(ids, self._last[1], return_indices=True)
            if len(a):
                moved = np.linalg.norm(uv_px[a] - self._last[2][b], axis=1)
                self._speeds.append(float(np.median(moved)) / (t_s - self._last[0]))
        self._last = t_s, ids, uv_px

    @property
    def rate_hz(self) -> float | None:
        """Images with corners a second, over the last ones."""
        if len(self._stamps) < 2 or self._stamps[-1] <= self._stamps[0]:
            return None
        return (len(self._stamps) - 1) / (self._stamps[-1] - self._stamps[0])

    @property
    def speed_px_s(self) -> float | None:
        """How fast corners move at the faster moments, px/s: nine of ten images are slower."""
        return float(np.percentile(self._speeds, 90)) if self._speeds else None

    def board_share(self, points: int) -> float | None:
        """Share of the board that the last image shows.

        Args:
            points: Of the whole board; 0: not known, the most that an image has shown counts as the whole.
        """
        whole = points or self._most
        return min(self.count / whole, 1.0) if whole else None


def blur(speed_px_s: float | None, exposure_s: float | None) -> dict[str, Any] | None:
    """Return how far corners move in an exposure, and what to do about it; None: not known.

    >>> blur(500.0, 0.0046)
    {'px': 2.3, 'advice': 'corners move 2.3 px in an exposure of 4.6 ms: shorten it to 2 ms'}
    >>> blur(100.0, 0.002)
    {'px': 0.2, 'advice': ''}
    """
    if speed_px_s is None or exposure_s is None or not exposure_s > 0.0:
        return None
    px = speed_px_s * exposure_s
    advice = ""
    if px > BLUR_PX:
        best_ms = 1e3 * BLUR_PX / speed_px_s
        shown = f"{best_ms:.0f}" if best_ms >= 1.5 else f"{best_ms:.1f}"
        advice = (
            f"corners move {px:.1f} px in an exposure of {1e3 * exposure_s:.3g} ms: shorten it to {shown} ms"
        )
    return {"px": round(px, 2), "advice": advice}


def light(pixels: npt.NDArray[np.uint8]) -> dict[str, Any]:
    """Return how bright an image is: level of its bright parts, share of saturated pixels, and advice.

    Args:
        pixels: 8-bit image, shape (h, w) or (h, w, c).
    """
    few = pixels[::4, ::4]
    top, saturated = float(np.percentile(few, 95)), float(np.mean(few >= 250))
    advice = ""
    if top < _DARK:
        advice = "dark image: more light, or more gain"
    elif saturated > _SATURATED and top >= _BRIGHT:
        advice = f"{100 * saturated:.0f} % of the image is saturated: less light, gain or exposure"
    return {"level": round(top / 255.0, 3), "saturated": round(saturated, 4), "advice": advice}
