"""How two calibrations of one camera differ: errors with their joint covariance; docs/math/verify.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS, project, project_jacobians
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.camera_rays import rays_over_image
from vical_daemon.estimation.status.reading_sample import common_share
from vical_daemon.results.known import KnownCamera

_LEAST_SHARE = 0.1
"""Of the sum of variances, the least that a difference has whose data are common: estimates of the same data
with other settings differ by linearisation and by the images they refuse, which the formula of efficient
estimates leaves out (up to a third of a sigma)."""


class NotComparableError(ValueError):
    """Two calibrations are not of the same thing; the message says why."""


@dataclass(frozen=True, slots=True)
class Difference:
    """B minus A.

    Attributes:
        a: One calibration, in the lens model of the difference.
        b: The other.
        d: Errors [position, rotation (local), time shift, lens] that lead from A to B, shape (7 + n,).
        covariance: Of them, shape (7 + n, 7 + n), for joint tests.
        sigma: Standard deviation of each, shape (7 + n,).
        covariance_a: Of the errors of A alone, shape (7 + n, 7 + n).
        model: Lens model of the errors.
        unlike_px: RMS over the image of what the lens models cannot have in common, px.
        common_s: Seconds of data that both have used.
    """

    a: KnownCamera
    b: KnownCamera
    d: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    covariance_a: FloatArray
    model: str
    unlike_px: float = 0.0
    common_s: float = 0.0

    @property
    def has_lens(self) -> bool:
        """Whether the lenses are part of it."""
        return len(self.d) > 7


def difference(a: KnownCamera, b: KnownCamera) -> Difference:
    """Return B minus A.

    Raises:
        NotComparableError: Images of other sizes, or other devices.
    """
    if a.resolution and b.resolution and a.resolution != b.resolution:
        sizes = ["{} x {}".format(*k.resolution) for k in (a, b) if k.resolution]
        raise NotComparableError(f"images of {sizes[0]} and of {sizes[1]} px: not the same lens or mode")
    for what, x, y in zip(("imu", "camera"), a.serials, b.serials, strict=True):
        if x and y and x != y:
            raise NotComparableError(f"not the same {what}: serial numbers {x} and {y}")
    pose = np.concatenate(
        [
            b.p_imu_cam - a.p_imu_cam,
            so3.log(a.R_imu_cam.T @ b.R_imu_cam),
            [b.timeshift_s - a.timeshift_s],
        ]
    )
    if a.lens is None or b.lens is None:
        A, B = a.covariance[:7, :7], b.covariance[:7, :7]
        S, common_s = _joint(a, b, A, B)
        return Difference(a, b, pose, S, _sigmas(a, b, A, B, S), A, a.model, 0.0, common_s)
    lens, T_a, T_b, model, unlike_px = _lens_difference(a, b)
    A, B = _in_lens(a.covariance, T_a), _in_lens(b.covariance, T_b)
    S, common_s = _joint(a, b, A, B)
    d = np.concatenate([pose, lens])
    return Difference(a, b, d, S, _sigmas(a, b, A, B, S), A, model, unlike_px, common_s)


def _lens_difference(a: KnownCamera, b: KnownCamera) -> tuple[FloatArray, FloatArray, FloatArray, str, float]:
    """Lens of B minus that of A, and what turns the errors of each into such ones.

    Lenses of two models are compared where both can be: in the parameters of the one with fewer, the other's
    being those that project least differently, in the least squares over the image.
    """
    assert a.lens is not None
    assert b.lens is not None
    n = len(a.lens)
    if a.model == b.model:
        return b.lens - a.lens, np.eye(n), np.eye(n), a.model, 0.0
    if len(COEFFICIENTS[b.model]) < len(COEFFICIENTS[a.model]):
        lens, T_b, T_a, model, unlike_px = _lens_difference(b, a)
        return -lens, T_a, T_b, model, unlike_px
    size = a.resolution or b.resolution or (round(2 * a.lens[2]), round(2 * a.lens[3]))
    rays = rays_over_image(a.lens[:4], a.lens[4:], a.model, size)
    uv_a, uv_b = (project(rays, k.lens[:4], k.lens[4:], k.model) for k in (a, b) if k.lens is not None)
    J_a, J_b = (
        project_jacobians(rays, k.lens[:4], k.lens[4:], k.model)[2].reshape(2 * len(rays), -1)
        for k in (a, b)
        if k.lens is not None
    )
    scale = np.linalg.norm(J_a, axis=0)
    back = np.linalg.pinv(J_a / scale) / scale[:, None]
    apart = (uv_b - uv_a).ravel()
    lens = back @ apart
    left = (apart - J_a @ lens).reshape(-1, 2)
    return lens, np.eye(n), back @ J_b, a.model, float(np.sqrt((left**2).sum(axis=1).mean()))


def _in_lens(covariance: FloatArray, T: FloatArray) -> FloatArray:
    J = np.zeros((7 + T.shape[0], 7 + T.shape[1]))
    J[:7, :7], J[7:, 7:] = np.eye(7), T
    return np.asarray(J @ covariance @ J.T)


def _joint(a: KnownCamera, b: KnownCamera, A: FloatArray, B: FloatArray) -> tuple[FloatArray, float]:
    """Covariance of B - A, and the seconds of data that are in both.

    The estimate of more data is the efficient one, whose error is not correlated with its difference from
    any other estimate [Hausman 1978]: for data that are all common, cov(B - A) = P_less - P_more; for a
    share s of the shorter, P_a + P_b - 2 s P_more.
    """
    share = common_share(a.reading_hashes, b.reading_hashes)
    if not share:
        return A + B, 0.0
    spans_s = [a.duration_s, b.duration_s]
    scale = np.sqrt(np.diag(A + B))
    A, B = A / np.outer(scale, scale), B / np.outer(scale, scale)
    alike = abs(spans_s[0] - spans_s[1]) < 0.1 * max(spans_s)
    more = A if (np.trace(A) < np.trace(B) if alike else spans_s[0] > spans_s[1]) else B
    root = np.linalg.cholesky(A + B + 1e-12 * np.eye(len(A)))
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ (A + B - 2.0 * share * more) @ inverse.T)
    root = root @ vectors
    S = (root * np.maximum(values, _LEAST_SHARE)) @ root.T
    return np.asarray(S * np.outer(scale, scale)), share * min(spans_s)


def _sigmas(a: KnownCamera, b: KnownCamera, A: FloatArray, B: FloatArray, S: FloatArray) -> FloatArray:
    """Standard deviation of each error: without the inflation that only joint tests need."""
    plain = np.diag(A) / a.inflation + np.diag(B) / b.inflation
    return np.asarray(np.sqrt(np.diag(S) * plain / np.diag(A + B)))
