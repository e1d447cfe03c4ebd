"""Pose of a camera from views of a planar target: both solutions of each, refined, with covariance.

A plane seen in perspective has two poses that explain the image almost equally well; the nearer the view
is to an affine one (small or distant or fronto-parallel board), the harder they are to tell apart. This
module returns both and says whether the data can decide.

Method: homography by normalised DLT; its first-order behaviour at the board's centre fixes the rotation up to
the sign of one square root (the two solutions); both are then refined by Levenberg-Marquardt on the
reprojection error. All views and both solutions are worked on in one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.robust import MEDIAN_RAYLEIGH, MOST_STEPS, median
from vical_daemon.estimation.significance import SURE_SIGMAS

FloatArray = npt.NDArray[np.float64]

MIN_POINTS = 4  # of a view: as many as its pose needs
_GAIN_DONE = 1e-6  # of the cost: far below what the noise makes uncertain (1 / n)
_COLLINEAR = 1e-6  # ratio of the board's two extents below which it is a line
_SAME_ROTATION_RAD = 1e-4  # both poses of a plane have become one: far below the noise of any view
TOGETHER = 64  # views, or pairs of images, in one batch: with more, arrays leave the cache


@dataclass(frozen=True, slots=True)
class PlanarPose:
    """One pose of the target in the camera frame.

    Attributes:
        R_cam_target: Rotation, shape (3, 3).
        p_cam_target: Origin of the target in the camera frame, m, shape (3,).
        rms: Root mean square of the residuals per axis, normalised image units (times fx: pixels).
        covariance: 6x6, order [px py pz rx ry rz], m and rad, rotation error local (right).
    """

    R_cam_target: FloatArray
    p_cam_target: FloatArray
    rms: float
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class PlanarPoses:
    """The candidates, best first, and whether the second explains the image about as well.

    Attributes:
        candidates: None, one or two poses.
        ambiguous: The data cannot tell the two apart at six sigma.
    """

    candidates: tuple[PlanarPose, ...]
    ambiguous: bool = False


class _Views(NamedTuple):
    """Points of m views side by side, zero where a view has fewer than n.

    Attributes:
        plane: About their mean, m, shape (m, 2, n).
        xy: Undistorted normalised coordinates, shape (m, 2, n).
        seen: One for a point, zero for none, shape (m, n).
        points: Their number in each view, shape (m,).
        centre: Their mean, m, shape (m, 2).
    """

    plane: FloatArray
    xy: FloatArray
    seen: FloatArray
    points: FloatArray
    centre: FloatArray

    @classmethod
    def of(cls, points_m: Sequence[FloatArray], xy: Sequence[FloatArray]) -> _Views:
        rows = np.concatenate(
            [np.concatenate([np.asarray(p)[:, :2] for p in points_m]), np.concatenate(xy)], axis=1
        )
        view = np.repeat(np.arange(len(xy)), [len(x) for x in xy])
        good = np.isfinite(rows).all(axis=1)
        count = np.bincount(view[good], minlength=len(xy))
        seen = np.arange(count.max()) < count[:, None]
        packed = np.zeros((*seen.shape, 4))
        packed[seen] = rows[good]
        centre = packed[..., :2].sum(axis=1) / np.maximum(count, 1)[:, None]
        packed[..., :2] -= centre[:, None] * seen[..., None]
        both = np.ascontiguousarray(np.swapaxes(packed, 1, 2))
        return cls(both[:, :2], both[:, 2:], seen.astype(np.float64), count.astype(np.float64), centre)

    def only(self, which: npt.NDArray[np.intp]) -> _Views:
        """Some of the views."""
        return _Views(*(x[which] for x in self))


def planar_poses(
    points_m: Sequence[FloatArray], xy: Sequence[FloatArray], sigma: float | None = None
) -> list[PlanarPoses]:
    """Find the poses of a planar target from undistorted image points, in each of several views.

    Args:
        points_m: By view, points in the target frame with z = 0, m, shape (n, 3) or (n, 2).
        xy: Likewise, undistorted normalised coordinates X/Z, Y/Z, shape (n, 2).
        sigma: Noise of xy per axis (pixels / fx); None: taken from the residuals of the best pose.

    Returns:
        By view, up to two poses, best first; a second that is clearly worse is refined only so far that this
        is sure. None where there are fewer than four points, or they are on a line or behind the camera.
    """
    if not len(xy):
        return []
    if len(xy) > TOGETHER:
        parts = [slice(k, k + TOGETHER) for k in range(0, len(xy), TOGETHER)]
        return [found for part in parts for found in planar_poses(points_m[part], xy[part], sigma)]
    views = _Views.of(points_m, xy)
    out = [PlanarPoses(()) for _ in xy]
    left = np.flatnonzero(views.points >= MIN_POINTS)
    extent = np.linalg.eigvalsh(views.plane[left] @ np.swapaxes(views.plane[left], 1, 2))
    left = left[extent[:, 0] > _COLLINEAR**2 * extent[:, 1]]
    H, found = _homographies(views.only(left))
    left = left[found]
    views = views.only(left)
    R, p = _both_poses(H[found], views)
    R, p, rms, information = _refine(R, p, views)
    p = p - (R[..., :2] @ views.centre[:, None, :, None])[..., 0]
    information = _move_origin(information, R, views.centre)
    spread = _inverses(information)
    same = np.linalg.norm(so3.log(np.swapaxes(R[:, 0], 1, 2) @ R[:, 1]), axis=1) < _SAME_ROTATION_RAD
    for i, k in enumerate(left):
        out[k] = _rank(R[i], p[i], rms[i], spread[i], int(views.points[i]), sigma, same=bool(same[i]))
    return out


def inliers(far: FloatArray) -> npt.NDArray[np.bool_]:
    """Which points lie within six sigmas of where they should, by the sigma that half of them show.

    Args:
        far: Distance of each point from its place, shape (n,).
    """
    sigma = median(far) / MEDIAN_RAYLEIGH
    return np.asarray(far <= SURE_SIGMAS * sigma)


def _homographies(v: _Views) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Normalised DLT: xy ~ H [X Y 1]', scaled to H[2, 2] = 1 (m, 3, 3), and where there is one (m,).

    The board is centred, so that H[2, 2] > 0.
    """
    n = v.points
    s_plane = np.sqrt(2.0 * n / np.einsum("min,min->m", v.plane, v.plane))
    mean = v.xy.sum(axis=2) / n[:, None]
    spread = (v.xy - mean[..., None]) * v.seen[:, None]
    variance = np.einsum("min,min->m", spread, spread) / n
    apart = variance >= 1e-24  # else all points are in one place
    s_xy = np.sqrt(2.0 / np.where(apart, variance, 1.0))
    P = np.concatenate((v.plane * s_plane[:, None, None], v.seen[:, None]), axis=1)
    u = spread * s_xy[:, None, None]
    # rows [P 0 -x P], [0 P -y P]: the normal matrix is four 3x3 blocks of weighted P'P
    Pt = np.swapaxes(P, 1, 2)
    A = np.zeros((len(n), 9, 9))
    A[:, :3, :3] = A[:, 3:6, 3:6] = P @ Pt
    A[:, :3, 6:] = A[:, 6:, :3] = -(P * u[:, :1]) @ Pt
    A[:, 3:6, 6:] = A[:, 6:, 3:6] = -(P * u[:, 1:]) @ Pt
    A[:, 6:, 6:] = (P * np.einsum("min,min->mn", u, u)[:, None]) @ Pt
    H: FloatArray = np.linalg.eigh(A)[1][:, :, 0].reshape(-1, 3, 3).copy()
    H[:, :, :2] *= s_plane[:, None, None]
    H[:, :2] /= s_xy[:, None, None]
    H[:, :2] += mean[:, :, None] * H[:, 2:]
    found = apart & (np.abs(H[:, 2, 2]) >= 1e-12)
    return H / np.where(found, H[:, 2, 2], 1.0)[:, None, None], found


def _both_poses(H: FloatArray, views: _Views) -> tuple[FloatArray, FloatArray]:
    """Return the two rotations (m, 2, 3, 3) whose plane moves like H at the board's centre, and positions.

    Turn the camera so that the centre lies on its axis: there the derivative of the image by the board is
    the upper 2x2 block of the rotation over the depth. Its largest singular value is 1 / depth (a plane is
    foreshortened in one direction only); what lacks to unit columns is the third row, up to sign.
    """
    c = H[:, :2, 2]
    J = H[:, :2, :2] - c[:, :, None] * H[:, 2:, :2]
    ray = np.concatenate((c, np.ones((len(c), 1))), axis=1)
    ray /= np.sqrt(np.vecdot(ray, ray))[:, None]
    R_turn = _rotations_from_axis_z(ray)
    A = np.linalg.solve(R_turn[:, :2, :2] - c[:, :, None] * R_turn[:, 2:, :2], J)
    M = A / np.linalg.norm(A, 2, axis=(1, 2))[:, None, None]
    gap = np.eye(2) - np.swapaxes(M, 1, 2) @ M
    third = np.sqrt(np.maximum(np.diagonal(gap, axis1=1, axis2=2), 0.0))
    third[:, 1] *= np.where(gap[:, 0, 1] < 0.0, -1.0, 1.0)
    R = np.empty((len(H), 2, 3, 3))
    R[:, :, :2, :2] = M[:, None]
    R[:, 0, 2, :2], R[:, 1, 2, :2] = third, -third
    R[..., 2] = np.cross(R[..., 0], R[..., 1])
    R = so3.matrix_from_quat(so3.quat_from_matrix(R_turn[:, None] @ R))  # M is exact only without noise
    return R, _positions(R, views)


def _rotations_from_axis_z(ray: FloatArray) -> FloatArray:
    """Return the smallest rotations (m, 3, 3) that turn the z axis onto unit rays (m, 3) with z > 0."""
    x, y, z = ray.T
    k = 1.0 / (1.0 + z)
    rows = [[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]]
    return np.moveaxis(np.array(rows), -1, 0)


def _positions(R: FloatArray, v: _Views) -> FloatArray:
    """Least squares for the positions given rotations (m, 2, 3, 3): linear in them, shape (m, 2, 3)."""
    turned = R[..., :2] @ v.plane[:, None]  # (m, 2, 3, n)
    rays = np.concatenate((v.xy, v.seen[:, None]), axis=1)
    A = np.zeros((len(R), 3, 3))
    A[:, 0, 0] = A[:, 1, 1] = v.points
    A[:, :2, 2] = A[:, 2, :2] = -v.xy.sum(axis=2)
    A[:, 2, 2] = np.einsum("min,min->m", v.xy, v.xy)
    off = v.xy[:, None] * turned[:, :, 2:] - turned[:, :, :2]
    right = np.empty((len(R), 2, 3))
    right[..., :2] = np.einsum("mcin,mn->mci", off, rays[:, 2])
    right[..., 2] = -np.einsum("mcin,min->mc", off, v.xy)
    return np.asarray(np.linalg.solve(A[:, None], right[..., None])[..., 0], dtype=np.float64)


# The derivative of a point in the camera frame, R (X, Y, 0) + p, by [p, local rotation] is
# A0 + X A1 + Y A2 with A0 = [I 0], A1 = [0, -R hat(ex)], A2 = [0, -R hat(ey)]. So J'J needs of the points
# only the moments sum(m W'W), m in {1, X, Y, X^2, XY, Y^2}, where W is the 2x3 derivative of the image and
# W'W = w [[1, 0, -x], [0, 1, -y], [-x, -y, x^2 + y^2]], w = 1 / z^2. The tables place them in a 9x9 matrix.
_MINUS_HATS = np.concatenate((-so3.hat(np.array([1.0, 0, 0])), -so3.hat(np.array([0, 1.0, 0]))), axis=1)
_MOMENT = np.kron(np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]]), np.ones((3, 3), dtype=int))
_ENTRY = np.tile(np.array([[0, 0, 1], [0, 0, 2], [1, 2, 3]]), (3, 3))
_SIGN = np.tile(np.array([[1.0, 0, -1], [0, 1, -1], [-1, -1, 1]]), (3, 3))


def _linearised(
    R: FloatArray, p: FloatArray, v: _Views, moments: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sum of squares (m, c), J'J (m, c, 6, 6) and J'e (m, c, 6) of the prediction by [p, local rotation].

    Args:
        R: Rotations of c candidates of each view, shape (m, c, 3, 3).
        p: Their positions, m, shape (m, c, 3).
        v: The views.
        moments: 1, X, Y, X^2, XY, Y^2 of their points, zero for none, shape (m, 1, n, 6).
    """
    q = R[..., :2] @ v.plane[:, None] + p[..., None]
    iz = 1.0 / np.where(q[..., 2, :] > 0.0, q[..., 2, :], np.nan)
    predicted = q[..., :2, :] * iz[..., None, :]
    e = (v.xy[:, None] - predicted) * v.seen[:, None, None]
    rows = np.empty((*iz.shape[:2], 7, iz.shape[2]))
    w = np.multiply(iz, iz, out=rows[:, :, 0])
    np.multiply(predicted, w[:, :, None], out=rows[:, :, 1:3])
    rows[:, :, 3] = predicted[:, :, 0] * rows[:, :, 1] + predicted[:, :, 1] * rows[:, :, 2]
    np.multiply(e, iz[:, :, None], out=rows[:, :, 4:6])
    rows[:, :, 6] = -(predicted[:, :, 0] * rows[:, :, 4] + predicted[:, :, 1] * rows[:, :, 5])
    sums = rows @ moments  # (m, c, 7, 6)
    S = sums[:, :, _ENTRY, _MOMENT] * _SIGN
    A = np.zeros((*R.shape[:2], 9, 6))
    A[:, :, :3, :3] = so3.IDENTITY
    A[:, :, 3:6, 3:] = R @ _MINUS_HATS[:, :3]
    A[:, :, 6:, 3:] = R @ _MINUS_HATS[:, 3:]
    At = np.swapaxes(A, -1, -2)
    g = np.swapaxes(sums[:, :, 4:, :3], -1, -2).reshape(*R.shape[:2], 9, 1)
    return np.einsum("mcin,mcin->mc", e, e), At @ S @ A, (At @ g)[..., 0]


def _refine(
    R: FloatArray, p: FloatArray, views: _Views
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Levenberg-Marquardt on all candidates; returns R, p, rms (m, 2) and J'J (m, 2, 6, 6)."""
    X, Y = views.plane[:, 0], views.plane[:, 1]
    moments = np.stack((views.seen, X, Y, X * X, X * Y, Y * Y), axis=-1)[:, None]
    damping = np.full(R.shape[:2], 1e-6)
    cost, information, gradient = _linearised(R, p, views, moments)
    left = np.arange(len(R))
    with np.errstate(invalid="ignore"):
        for _ in range(MOST_STEPS):
            alive = np.isfinite(cost[left])
            A = np.where(alive[..., None, None], information[left], np.eye(6))
            A = A + np.eye(6) * (damping[left][..., None] * np.einsum("mcii->mci", A))[..., None, :]
            g = np.where(alive[..., None], gradient[left], 0.0)
            step = np.linalg.solve(A, g[..., None])[..., 0]
            trial = R[left] @ so3.exp(step[..., 3:]), p[left] + step[..., :3]
            now = (*trial, *_linearised(*trial, views.only(left), moments[left]))
            better = now[2] <= cost[left]
            for kept, new in zip((R, p, cost, information, gradient), now, strict=True):
                kept[left] = np.where(better.reshape(*better.shape, *[1] * (new.ndim - 2)), new, kept[left])
            damping[left] *= np.where(better, 0.1, 30.0)
            gain = np.einsum("mci,mci->mc", g, step)  # of the cost, as the linear model promised
            worth = cost[left]
            done = (gain <= _GAIN_DONE * worth + 1e-26) | (damping[left] > 1e6) | ~alive
            left = left[~done.all(axis=1)]
            if not len(left):
                break
    return R, p, np.sqrt(cost / (2.0 * views.points)[:, None]), information


def _move_origin(information: FloatArray, R: FloatArray, centre: FloatArray) -> FloatArray:
    """Information of the poses of the target's origin from those of its centre (m, 2), shape (m, c, 6, 6)."""
    T = np.zeros_like(information)
    T[:] = np.eye(6)
    # p_centre = p_origin + R exp(d) c, so its derivative by d is -R hat(c)
    T[..., :3, 3:] = -R @ so3.hat(np.concatenate((centre, np.zeros((len(centre), 1))), axis=1))[:, None]
    out: FloatArray = np.swapaxes(T, -1, -2) @ information @ T
    return out


def _inverses(information: FloatArray) -> FloatArray:
    """Inverses, in scaled units; a direction without information gets a huge variance, not an exception."""
    sound = np.isfinite(information).all(axis=(-1, -2), keepdims=True)
    information = np.where(sound, information, np.eye(6))
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information, axis1=-1, axis2=-2), 1e-300))
    w, V = np.linalg.eigh(information * (scale[..., :, None] * scale[..., None, :]))
    W = (V * scale[..., :, None]) / np.sqrt(np.maximum(w, 1e-14))[..., None, :]
    return np.asarray(W @ np.swapaxes(W, -1, -2))


def _rank(
    R: FloatArray,
    p: FloatArray,
    rms: FloatArray,
    spread: FloatArray,
    n: int,
    sigma: float | None,
    *,
    same: bool,
) -> PlanarPoses:
    order = sorted(np.flatnonzero(np.isfinite(rms)).tolist(), key=lambda i: float(rms[i]))
    if not order:
        return PlanarPoses(())
    if same:
        order = order[:1]
    best = rms[order[0]]
    measured = best * np.sqrt(2 * n / max(2 * n - 6, 1))
    noise = max(measured if sigma is None else sigma, 1e-12)
    candidates = tuple(PlanarPose(R[i], p[i], float(rms[i]), spread[i] * noise**2) for i in order)
    ambiguous = False
    if len(order) == 2:
        ambiguous = bool(2 * n * (rms[order[1]] ** 2 - best**2) < SURE_SIGMAS**2 * noise**2)
    return PlanarPoses(candidates, ambiguous)
