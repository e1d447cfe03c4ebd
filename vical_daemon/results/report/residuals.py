"""Residuals of all frames of one camera, gathered and binned for the report's figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.measurements import FloatArray, IntArray


class FrameResiduals(Protocol):
    """The fields of a frame that the report uses; see the calibrator's FrameReport."""

    @property
    def t_ns(self) -> int:
        """Stamp of the frame, ns."""
        ...

    @property
    def camera(self) -> str:
        """Name of the camera."""
        ...

    @property
    def ids(self) -> IntArray:
        """Point ids, shape (n,)."""
        ...

    @property
    def uv_px(self) -> FloatArray:
        """Measured pixels, shape (n, 2)."""
        ...

    @property
    def residual_px(self) -> FloatArray:
        """Measured minus predicted, shape (n, 2)."""
        ...

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """Points that passed their gate, shape (n,)."""
        ...

    @property
    def nis(self) -> float:
        """Normalised innovation squared of the frame."""
        ...

    @property
    def dof(self) -> int:
        """Its degrees of freedom; 0: the frame was not used."""
        ...


@dataclass(frozen=True, slots=True)
class CameraResiduals:
    """All points of one camera in one table, and its frames.

    Attributes:
        uv_px: shape (n, 2).
        residual_px: shape (n, 2).
        ids: shape (n,).
        accepted: shape (n,).
        frame_t_s: Time of each frame since the first, s, shape (f,).
        frame_nis: shape (f,).
        frame_dof: shape (f,).
        frame_rms_px: RMS of the accepted residuals of each frame, nan where there are none, shape (f,).
    """

    uv_px: FloatArray
    residual_px: FloatArray
    ids: IntArray
    accepted: npt.NDArray[np.bool_]
    frame_t_s: FloatArray
    frame_nis: FloatArray
    frame_dof: IntArray
    frame_rms_px: FloatArray

    @property
    def rms_px(self) -> float:
        """RMS over accepted points and both axes, px; nan without any."""
        kept = self.residual_px[self.accepted]
        return float(np.sqrt(np.mean(kept**2))) if len(kept) else float("nan")


@dataclass(frozen=True, slots=True)
class CellMap:
    """Residuals binned over the image.

    Attributes:
        x_edges: Column edges, px, shape (c + 1,).
        y_edges: Row edges, px, shape (r + 1,).
        count: Points per cell, shape (r, c).
        mean_px: Mean residual, nan below 5 points, shape (r, c, 2).
        rms_px: RMS per axis, nan below 5 points, shape (r, c).
    """

    x_edges: FloatArray
    y_edges: FloatArray
    count: IntArray
    mean_px: FloatArray
    rms_px: FloatArray

    @property
    def coverage(self) -> float:
        """Share of cells with at least 5 points."""
        return float(np.mean(self.count >= 5))


def gather(frames: Iterable[FrameResiduals], camera: str) -> CameraResiduals | None:
    """Collect the frames of one camera; None where it has none with predicted points."""
    own = [f for f in frames if f.camera == camera and len(f.ids)]
    if not own:
        return None
    residual = np.concatenate([np.asarray(f.residual_px, dtype=np.float64).reshape(-1, 2) for f in own])
    predicted = np.isfinite(residual).all(axis=1)
    if not predicted.any():
        return None
    start = own[0].t_ns
    return CameraResiduals(
        uv_px=np.concatenate([np.asarray(f.uv_px, dtype=np.float64).reshape(-1, 2) for f in own])[predicted],
        residual_px=residual[predicted],
        ids=np.concatenate([np.asarray(f.ids, dtype=np.int64) for f in own])[predicted],
        accepted=np.concatenate([np.asarray(f.accepted, dtype=np.bool_) for f in own])[predicted],
        frame_t_s=np.array([(f.t_ns - start) * 1e-9 for f in own]),
        frame_nis=np.array([float(f.nis) for f in own]),
        frame_dof=np.array([int(f.dof) for f in own]),
        frame_rms_px=np.array([_frame_rms(f) for f in own]),
    )


def _frame_rms(frame: FrameResiduals) -> float:
    kept = np.asarray(frame.residual_px)[np.asarray(frame.accepted, dtype=np.bool_)]
    return float(np.sqrt(np.mean(kept**2))) if len(kept) else float("nan")


def cells(points: CameraResiduals, size: tuple[int, int], across: int = 16) -> CellMap:
    """Bin the accepted residuals into about square cells, `across` of them over the image's width."""
    width, height = size
    down = max(1, round(across * height / width))
    x_edges, y_edges = np.linspace(0, width, across + 1), np.linspace(0, height, down + 1)
    uv, residual = points.uv_px[points.accepted], points.residual_px[points.accepted]
    column = np.clip(np.digitize(uv[:, 0], x_edges) - 1, 0, across - 1)
    line = np.clip(np.digitize(uv[:, 1], y_edges) - 1, 0, down - 1)
    cell = line * across + column
    count = np.bincount(cell, minlength=across * down)
    sums = [np.bincount(cell, residual[:, i], minlength=across * down) for i in (0, 1)]
    squares = np.bincount(cell, (residual**2).sum(axis=1), minlength=across * down)
    enough = count >= 5
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(enough[:, None], np.stack(sums, axis=-1) / count[:, None], np.nan)
        rms = np.where(enough, np.sqrt(squares / (2.0 * count)), np.nan)
    shape = (down, across)
    return CellMap(x_edges, y_edges, count.reshape(shape), mean.reshape(*shape, 2), rms.reshape(shape))


def per_point_rms(points: CameraResiduals) -> tuple[IntArray, FloatArray, FloatArray]:
    """RMS of the accepted residuals of each board point, and the share of it that was refused.

    Returns:
        Ids (ascending), RMS per axis in px (nan where all were refused), refused share.
    """
    ids, index = np.unique(points.ids, return_inverse=True)
    total = np.bincount(index)
    kept = np.bincount(index[points.accepted], minlength=len(ids))
    squares = np.bincount(
        index[points.accepted], (points.residual_px[points.accepted] ** 2).sum(axis=1), minlength=len(ids)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.where(kept > 0, np.sqrt(squares / (2.0 * kept)), np.nan)
    return ids, rms, 1.0 - kept / total
