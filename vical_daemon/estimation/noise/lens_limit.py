"""How well a lens can be known at all: what a detector gets wrong alike everywhere does not average out."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.camera_rays import rays_over_image
from vical_daemon.estimation.model.state import CameraState

Numbers = tuple[float, ...]

_SYSTEMATIC_PX = 0.003
"""Error that corners of one patch of the image share for ever, px; the curvature of edges alone makes up to
0.005 px at the border of a picture (docs/detection.md)."""


def limit(camera: CameraState) -> FloatArray:
    """Standard deviations below which no lens is known: fx fy cx cy (px), distortion; shape (n,).

    Least squares of the lens to patches, eight by six over the image, that are each off by as much. It hardly
    depends on the lens: rounded to three digits, it seldom has to be computed anew.
    """
    K = tuple(float(f"{x:.3g}") for x in camera.intrinsics.tolist())
    D = tuple(round(x, 3) for x in camera.distortion.tolist())
    return _limit(K, D, camera.distortion_model, camera.resolution)


@lru_cache(maxsize=64)
def _limit(K: Numbers, D: Numbers, model: str, resolution: tuple[int, int]) -> FloatArray:
    intrinsics, distortion = np.array(K), np.array(D)
    rays = rays_over_image(intrinsics, distortion, model, resolution)
    by = project_jacobians(rays, intrinsics, distortion, model)[2]
    flat = by.reshape(-1, by.shape[-1])
    size = np.linalg.norm(flat, axis=0)  # columns of px and of px per unit of distortion
    information = (flat / size).T @ (flat / size)
    return np.asarray(_SYSTEMATIC_PX * np.sqrt(np.diag(np.linalg.pinv(information))) / size)
