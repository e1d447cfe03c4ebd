"""The verdict on one image, as the status, the recorder and the page see it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vical_daemon.estimation.measurements import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class FrameReport:
    """What one image did.

    Attributes:
        t_ns: Image stamp, camera clock, ns.
        camera: Camera name.
        ids: Point ids, shape (n,).
        uv_px: Measured pixels, shape (n, 2).
        residual_px: Measured minus predicted after the update, shape (n, 2); not-a-number if not predicted.
        accepted: Which points entered, shape (n,).
        used: Whether the frame entered at all.
        nis: Normalised innovation squared of what the state can explain.
        dof: Its degrees of freedom.
        sigma_px: Corner noise of this image as used, px.
        predicted_px: Where the points were expected before the update, shape (n, 2); not-a-number where
            they could not be.
        log_likelihood: Of the image by what was predicted, up to a constant.
    """

    t_ns: int
    camera: str
    ids: IntArray
    uv_px: FloatArray
    residual_px: FloatArray
    accepted: BoolArray
    used: bool
    nis: float = 0.0
    dof: int = 0
    sigma_px: float = 0.0
    predicted_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    log_likelihood: float = 0.0
