"""Uncertainty of a projection: sigma, in pixels, of where a point of the imu frame falls in the image.

A point is fixed in the imu frame. Where it falls in the image depends on the mounting and on the lens; their
joint covariance is propagated to first order:

    X_cam = R^T (X_imu - p),  R' = R exp(r),  p' = p + dp
    dX_cam = X_cam x r - R^T dp,  duv = J_point dX_cam + J_lens dlens

For a point at infinity the lever arm has no part. As in mrcal, sigma is that of the worst direction in the
image: the root of the larger eigenvalue of the covariance of (u, v), shape (2, 2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS, RADTAN, project_jacobians
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.camera_rays import unproject

POSITION, ROTATION = ("px", "py", "pz"), ("rx", "ry", "rz")
INTRINSICS = ("fx", "fy", "cx", "cy")


def projection_sigma_px(
    uv_px: FloatArray,
    distance_m: float,
    R_imu_cam: FloatArray,
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str,
    order: Sequence[str],
    covariance: FloatArray,
) -> FloatArray:
    """Return sigma of the projection of points of the imu frame, in its worst direction, px.

    Args:
        uv_px: Where the points fall in the image, px, shape (n, 2).
        distance_m: Of the points from the camera, m; may be infinite.
        R_imu_cam: Mounting, shape (3, 3).
        intrinsics: fx fy cx cy, px, shape (4,).
        distortion: Coefficients of the model, shape (d,).
        model: radtan, plumb_bob or equidistant.
        order: Names of the rows of `covariance`: px py pz rx ry rz timeshift fx fy cx cy and coefficients.
        covariance: Joint covariance; what is not in it counts as known.

    Returns:
        Shape (n,), not-a-number where the lens has no ray for the pixel.
    """
    rays, ok = unproject(uv_px, intrinsics, distortion, model)
    rays = np.where(ok[:, None], rays, (0.0, 0.0, 1.0))
    far = not np.isfinite(distance_m)
    points = rays if far else distance_m * rays
    _, J_point, J_lens = project_jacobians(points, intrinsics, distortion, model)
    J = dict.fromkeys(POSITION, np.zeros((len(points), 2)))
    if not far:
        J |= dict(zip(POSITION, np.moveaxis(-J_point @ R_imu_cam.T, -1, 0), strict=True))
    J |= dict(zip(ROTATION, np.moveaxis(J_point @ so3.hat(points), -1, 0), strict=True))
    J |= dict(zip((*INTRINSICS, *COEFFICIENTS[model]), np.moveaxis(J_lens, -1, 0), strict=True))
    use = [i for i, name in enumerate(order) if name in J]
    stacked = np.stack([J[order[i]] for i in use], axis=-1)
    in_image = stacked @ covariance[np.ix_(use, use)] @ np.swapaxes(stacked, -1, -2)
    worst = np.linalg.eigvalsh(in_image)[:, 1]
    return np.where(ok, np.sqrt(np.maximum(worst, 0.0)), np.nan)


def over_image(
    size: tuple[int, int],
    distance_m: float,
    R_imu_cam: FloatArray,
    intrinsics: FloatArray,
    distortion: FloatArray,
    model: str,
    order: Sequence[str],
    covariance: FloatArray,
    across: int = 40,
) -> FloatArray:
    """Return `projection_sigma_px` at the centres of about square cells, shape (rows, across), px."""
    width, height = size
    down = max(1, round(across * height / width))
    u = (np.arange(across) + 0.5) * width / across - 0.5
    v = (np.arange(down) + 0.5) * height / down - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    sigma = projection_sigma_px(uv, distance_m, R_imu_cam, intrinsics, distortion, model, order, covariance)
    return sigma.reshape(down, across)


def sigma_if_known(
    order: Sequence[str], covariance: FloatArray, block: Sequence[str], known: Sequence[str]
) -> float:
    """Return the largest sigma of a block of parameters, were others known exactly.

    The conditional covariance of Gaussian variables, S_bb - S_bk S_kk^-1 S_kb. It shows, for example, what
    the unknown lens adds to the uncertainty of the lever arm.

    Args:
        order: Names of the rows of `covariance`.
        covariance: Joint covariance.
        block: Names of the block.
        known: Names of what would be known; those that are not in `order` are known already.

    Returns:
        Square root of the largest eigenvalue, in the unit of the block.
    """
    b = [order.index(name) for name in block if name in order]
    k = [order.index(name) for name in known if name in order]
    if not b:
        return 0.0
    S = covariance[np.ix_(b, b)]
    if k:
        # scaled to correlations: pixels and distortion coefficients differ by orders of magnitude
        unit = np.sqrt(np.diag(covariance)[k])
        cross = covariance[np.ix_(b, k)] / unit
        S = S - cross @ np.linalg.pinv(covariance[np.ix_(k, k)] / np.outer(unit, unit)) @ cross.T
    return float(np.sqrt(max(float(np.linalg.eigvalsh(S)[-1]), 0.0)))


def lens_names(model: str = RADTAN) -> tuple[str, ...]:
    """Names of a lens in a joint covariance."""
    return (*INTRINSICS, *COEFFICIENTS[model])
