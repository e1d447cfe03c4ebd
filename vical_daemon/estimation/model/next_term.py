"""The term that a radtan lens has beyond its model, k3: estimated as an alternative model, but not reported.

What is reported is the radtan lens that projects the points nearest to where they were seen.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from vical_daemon.estimation.geometry.camera_model import RADTAN, project_jacobians
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.camera_rays import patch_centres, unproject
from vical_daemon.estimation.model.state import CameraState

UNSEEN_PX = 100.0  # patches of the image in which no points were seen count as known to so many pixels
Numbers = tuple[float, ...]


def onto_model(camera: CameraState, seen: FloatArray) -> FloatArray:
    """What leads from the lens that is estimated to the one that is reported, shape (m, n).

    With N = sum J'J over the points, J their derivatives by the lens, a term k moves the coefficients of the
    model by N_mm^-1 N_mk k. [weighted least squares]

    Args:
        camera: Its lens counts.
        seen: N, over the variance of the points, shape (n, n); or zero: before points are seen, the whole
            image counts alike.
    """
    n = 4 + len(camera.distortion)
    if not camera.term:
        return np.eye(n)
    by = lens_slopes(*rounded(camera)).reshape(-1, n)
    N = seen + UNSEEN_PX**-2.0 * by.T @ by
    # least squares: of a lens that is far off, no patch may have rays, and N may be zero
    moved = np.linalg.lstsq(N[:-1, :-1], N[:-1, -1:], rcond=None)[0]
    return np.concatenate([np.eye(n - 1), moved], axis=1)


def reported_camera(camera: CameraState, onto: FloatArray) -> CameraState:
    """The camera with the lens that is reported; `onto`: see `onto_model`."""
    if not camera.term:
        return camera
    lens = onto @ np.concatenate([camera.intrinsics, camera.distortion])
    return replace(camera, intrinsics=lens[:4], distortion=lens[4:], distortion_model=RADTAN, term=False)


def rounded(camera: CameraState) -> tuple[Numbers, Numbers, str, tuple[int, int]]:
    """Lens and image as the arguments of `lens_slopes`: rounded, they rarely have to be computed again."""
    K = tuple(float(f"{x:.3g}") for x in camera.intrinsics.tolist())
    D = tuple(round(x, 3) for x in camera.distortion.tolist())
    return K, D, camera.distortion_model, camera.resolution


@lru_cache(maxsize=64)
def lens_slopes(K: Numbers, D: Numbers, model: str, resolution: tuple[int, int]) -> FloatArray:
    """Derivatives of the centres of 48 patches by the lens, zeros where it has no rays, shape (48, 2, n)."""
    intrinsics, distortion = np.array(K), np.array(D)
    rays, ok = unproject(patch_centres(resolution), intrinsics, distortion, model)
    by = project_jacobians(np.where(ok[:, None], rays, [0.0, 0.0, 1.0]), intrinsics, distortion, model)[2]
    return np.where(ok[:, None, None], by, 0.0)
