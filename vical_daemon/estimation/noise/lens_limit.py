"""Floor on the sigmas of a lens: the bias of a detector does not average out."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.camera_rays import patch_centres, unproject
from vical_daemon.estimation.model.state import CameraState

_UNSEEN = 1e-2  # of the weight of a patch: its error is a hundred times as large
Numbers = tuple[float, ...]

SYSTEMATIC_PX = 0.003
"""Constant error that corners of one patch of the image share, px; the curvature of edges alone makes up to
0.005 px at the border of a picture (docs/detection.md)."""


def limit(camera: CameraState) -> FloatArray:
    """Standard deviations below which no lens is known: fx fy cx cy (px), distortion; shape (n,).

    Least squares of the lens to patches, eight by six over the image, that are each off by as much. It hardly
    depends on the lens: rounded to three digits, it rarely has to be computed again.
    """
    return np.asarray(SYSTEMATIC_PX * np.linalg.norm(np.linalg.inv(patches(camera)), axis=1))


def patches(camera: CameraState, seen: BoolArray | None = None) -> FloatArray:
    """R with R'R = J'J, J the derivatives of the patches by fx fy cx cy and the distortion, shape (n, n).

    Args:
        camera: Its lens counts.
        seen: Patches that are left out count next to nothing, shape (48,); None: all count.
    """
    K = tuple(float(f"{x:.3g}") for x in camera.intrinsics.tolist())
    D = tuple(round(x, 3) for x in camera.distortion.tolist())
    by = _slopes(K, D, camera.distortion_model, camera.resolution)
    if seen is not None:
        by = np.where(seen[:, None, None], by, _UNSEEN * by)
    return np.asarray(np.linalg.qr(by.reshape(-1, by.shape[-1]))[1])


@lru_cache(maxsize=64)
def _slopes(K: Numbers, D: Numbers, model: str, resolution: tuple[int, int]) -> FloatArray:
    intrinsics, distortion = np.array(K), np.array(D)
    rays, ok = unproject(patch_centres(resolution), intrinsics, distortion, model)
    by = project_jacobians(np.where(ok[:, None], rays, [0.0, 0.0, 1.0]), intrinsics, distortion, model)[2]
    return np.where(ok[:, None, None], by, 0.0)
