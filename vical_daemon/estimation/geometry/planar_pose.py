"""Pose of a camera from one view of a planar target: both solutions, refined, with covariance.

A plane seen in perspective has two poses that explain the image almost equally well; the nearer the view
is to an affine one (small or distant or fronto-parallel board), the harder they are to tell apart. This
module returns both and says whether the data can decide.

Method: homography by normalised DLT; its first-order behaviour at the board's centre fixes the rotation up to
the sign of one square root (the two solutions); both are then refined by Levenberg-Marquardt on the
reprojection error, together in one batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.significance import MEDIAN_RAYLEIGH, SURE_SIGMAS

FloatArray = npt.NDArray[np.float64]

_STEPS = 15
_GAIN_DONE = 1e-6  # of the cost: far below what the noise makes uncertain (1 / n)
_COLLINEAR = 1e-6  # ratio of the board's two extents below which it is a line
_SAME_ROTATION_RAD = 1e-4
_HOPELESS_CHI2 = 100.0


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
        ambiguous: The data cannot tell the two apart at five sigma.
        reason: Why there is no candidate, in words; empty otherwise.
    """

    candidates: tuple[PlanarPose, ...]
    ambiguous: bool = False
    reason: str = ""


def planar_pose(points_m: FloatArray, xy: FloatArray, sigma: float | None = None) -> PlanarPoses:
    """Find the poses of a planar target from undistorted image points.

    Args:
        points_m: Points in the target frame with z = 0, m, shape (n, 3) or (n, 2), n >= 4.
        xy: Undistorted normalised coordinates X/Z, Y/Z, shape (n, 2).
        sigma: Noise of xy per axis (pixels / fx); None: taken from the residuals of the best pose.

    Returns:
        Up to two poses, best first; a second that is clearly worse is refined only so far that this is sure.
        None where the points are too few, on a line or behind the camera.
    """
    plane = np.asarray(points_m, dtype=np.float64)[:, :2]
    xy = np.asarray(xy, dtype=np.float64)
    good = np.isfinite(xy).all(axis=1)
    if not good.all():
        plane, xy = plane[good], xy[good]
    if len(plane) < 4:
        return PlanarPoses((), reason=f"{len(plane)} points: a pose needs at least 4")
    centre = plane.mean(axis=0)
    centred = plane - centre
    extent = np.linalg.eigvalsh(centred.T @ centred)
    if extent[0] <= _COLLINEAR**2 * extent[1]:
        return PlanarPoses((), reason="the points lie on one line: show more rows of the target")
    H = _homography(centred, xy)
    if H is None:
        return PlanarPoses((), reason="no homography fits the points")
    R, p = _both_poses(H, centred, xy)
    R, p, rms, information = _refine(R, p, centred, xy)
    p = p - (R[:, :, :2] @ centre)
    information = _move_origin(information, R, centre)
    return _rank(R, p, rms, information, len(xy), sigma)


def inliers(far: FloatArray) -> npt.NDArray[np.bool_]:
    """Which points lie within six sigmas of where they should, by the sigma that half of them show.

    Args:
        far: Distance of each point from its place, shape (n,).
    """
    sigma = np.median(far) / MEDIAN_RAYLEIGH
    return np.asarray(far <= 6.0 * sigma)


def _homography(plane: FloatArray, xy: FloatArray) -> FloatArray | None:
    """Normalised DLT: xy ~ H [X Y 1]', scaled to H[2, 2] = 1; the board is centred, so H[2, 2] > 0."""
    s_plane = np.sqrt(2.0 / np.mean(np.einsum("ij,ij->i", plane, plane)))
    mean = xy.mean(axis=0)
    spread = xy - mean
    variance = np.mean(np.einsum("ij,ij->i", spread, spread))
    if variance < 1e-24:
        return None
    s_xy = float(np.sqrt(2.0 / variance))
    n = len(xy)
    P = np.column_stack((plane * s_plane, np.ones(n)))
    u = spread * s_xy
    # rows [P 0 -x P], [0 P -y P]: the normal matrix is four 3x3 blocks of weighted P'P
    A = np.zeros((9, 9))
    PP = P.T @ P
    xPP = (P * u[:, :1]).T @ P
    yPP = (P * u[:, 1:]).T @ P
    A[:3, :3] = A[3:6, 3:6] = PP
    A[:3, 6:] = A[6:, :3] = -xPP
    A[3:6, 6:] = A[6:, 3:6] = -yPP
    A[6:, 6:] = (P * np.einsum("ij,ij->i", u, u)[:, None]).T @ P
    H: FloatArray = np.linalg.eigh(A)[1][:, 0].reshape(3, 3).copy()
    H *= np.array([s_plane, s_plane, 1.0])
    H[:2] /= s_xy
    H[:2] += mean[:, None] * H[2]
    if abs(H[2, 2]) < 1e-12:
        return None
    out: FloatArray = H / H[2, 2]
    return out


def _both_poses(H: FloatArray, plane: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the two rotations (2, 3, 3) whose plane moves like H at the board's centre, and positions.

    Turn the camera so that the centre lies on its axis: there the derivative of the image by the board is
    the upper 2x2 block of the rotation over the depth. Its largest singular value is 1 / depth (a plane is
    foreshortened in one direction only); what lacks to unit columns is the third row, up to sign.
    """
    c = H[:2, 2]
    J = H[:2, :2] - np.outer(c, H[2, :2])
    ray = np.array([c[0], c[1], 1.0])
    ray /= np.sqrt(ray @ ray)
    R_turn = _rotation_from_axis_z(ray)
    B = R_turn[:2, :2] - np.outer(c, R_turn[2, :2])
    A = np.linalg.solve(B, J)
    M = A / np.linalg.norm(A, 2)
    gap = np.eye(2) - M.T @ M
    b0 = np.sqrt(max(gap[0, 0], 0.0))
    b1 = np.sqrt(max(gap[1, 1], 0.0)) * (-1.0 if gap[0, 1] < 0.0 else 1.0)
    R = np.empty((2, 3, 3))
    R[:, :2, :2] = M
    R[0, 2, :2] = b0, b1
    R[1, 2, :2] = -b0, -b1
    R[:, :, 2] = np.cross(R[:, :, 0], R[:, :, 1])
    R = so3.matrix_from_quat(so3.quat_from_matrix(R_turn @ R))  # M is exact only without noise
    return R, _positions(R, plane, xy)


def _rotation_from_axis_z(ray: FloatArray) -> FloatArray:
    """Return the smallest rotation that turns the z axis onto a unit ray with z > 0."""
    x, y, z = ray
    k = 1.0 / (1.0 + z)
    return np.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])


def _positions(R: FloatArray, plane: FloatArray, xy: FloatArray) -> FloatArray:
    """Least squares for the position given rotations (2, 3, 3): linear in p, shape (2, 3)."""
    turned = plane @ np.swapaxes(R[:, :, :2], 1, 2)  # (2, n, 3)
    n = len(xy)
    A = np.zeros((2 * n, 3))
    A[:n, 0] = A[n:, 1] = 1.0
    A[:n, 2], A[n:, 2] = -xy[:, 0], -xy[:, 1]
    rhs = np.concatenate(
        (
            xy[:, 0] * turned[:, :, 2] - turned[:, :, 0],
            xy[:, 1] * turned[:, :, 2] - turned[:, :, 1],
        ),
        axis=1,
    )
    return np.asarray(np.linalg.solve(A.T @ A, (rhs @ A).T).T, dtype=np.float64)


def _residuals(
    R: FloatArray, p: FloatArray, plane: FloatArray, xy: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (c, 2, n), predictions (c, 2, n) and inverse depths (c, n) of c candidates."""
    q = R[:, :, :2] @ plane + p[:, :, None]
    iz = 1.0 / np.where(q[:, 2] > 0.0, q[:, 2], np.nan)
    predicted = q[:, :2] * iz[:, None]
    return xy - predicted, predicted, iz


# The derivative of a point in the camera frame, R (X, Y, 0) + p, by [p, local rotation] is
# A0 + X A1 + Y A2 with A0 = [I 0], A1 = [0, -R hat(ex)], A2 = [0, -R hat(ey)]. So J'J needs of the points
# only the moments sum(m W'W), m in {1, X, Y, X^2, XY, Y^2}, where W is the 2x3 derivative of the image and
# W'W = w [[1, 0, -x], [0, 1, -y], [-x, -y, x^2 + y^2]], w = 1 / z^2. The tables place them in a 9x9 matrix.
_MINUS_HATS = np.concatenate((-so3.hat(np.array([1.0, 0, 0])), -so3.hat(np.array([0, 1.0, 0]))), axis=1)
_MOMENT = np.kron(np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]]), np.ones((3, 3), dtype=int))
_ENTRY = np.tile(np.array([[0, 0, 1], [0, 0, 2], [1, 2, 3]]), (3, 3))
_SIGN = np.tile(np.array([[1.0, 0, -1], [0, 1, -1], [-1, -1, 1]]), (3, 3))


def _normal_equations(
    R: FloatArray, moments: FloatArray, e: FloatArray, predicted: FloatArray, iz: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return J'J (c, 6, 6) and J'e (c, 6) of the prediction by [p, local rotation].

    Args:
        R: Rotations of c candidates, shape (c, 3, 3).
        moments: 1, X, Y, X^2, XY, Y^2 of the points, shape (n, 6).
        e: Residuals, shape (c, 2, n).
        predicted: Predictions, shape (c, 2, n).
        iz: Inverse depths, shape (c, n).
    """
    c, n = iz.shape
    rows = np.empty((c, 7, n))
    w = np.multiply(iz, iz, out=rows[:, 0])
    np.multiply(predicted, w[:, None], out=rows[:, 1:3])
    rows[:, 3] = predicted[:, 0] * rows[:, 1] + predicted[:, 1] * rows[:, 2]
    np.multiply(e, iz[:, None], out=rows[:, 4:6])
    rows[:, 6] = -(predicted[:, 0] * rows[:, 4] + predicted[:, 1] * rows[:, 5])
    sums = rows @ moments  # (c, 7, 6)
    S = sums[:, _ENTRY, _MOMENT] * _SIGN
    A = np.zeros((c, 9, 6))
    A[:, :3, :3] = np.eye(3)
    A[:, 3:6, 3:] = R @ _MINUS_HATS[:, :3]
    A[:, 6:, 3:] = R @ _MINUS_HATS[:, 3:]
    At = np.swapaxes(A, 1, 2)
    g = np.swapaxes(sums[:, 4:, :3], 1, 2).reshape(c, 9, 1)
    return At @ S @ A, (At @ g)[..., 0]


def _refine(
    R: FloatArray, p: FloatArray, plane: FloatArray, xy: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Levenberg-Marquardt on all candidates at once; returns R, p, rms and J'J (c, 6, 6)."""
    X, Y = plane[:, 0], plane[:, 1]
    moments = np.column_stack((np.ones_like(X), X, Y, X * X, X * Y, Y * Y))
    plane_t, xy_t = np.ascontiguousarray(plane.T), np.ascontiguousarray(xy.T)
    damping = np.full(len(R), 1e-6)
    e, predicted, iz = _residuals(R, p, plane_t, xy_t)
    cost = np.einsum("cin,cin->c", e, e)
    with np.errstate(invalid="ignore"):
        information, gradient = _normal_equations(R, moments, e, predicted, iz)
        for _ in range(_STEPS):
            alive = np.isfinite(cost)
            A = np.where(alive[:, None, None], information, np.eye(6))
            A = A + np.eye(6) * (damping[:, None] * np.einsum("cii->ci", A))[:, None, :]
            g = np.where(alive[:, None], gradient, 0.0)
            step = np.linalg.solve(A, g[..., None])[..., 0]
            R_new, p_new = R @ so3.exp(step[:, 3:]), p + step[:, :3]
            e_new, predicted_new, iz_new = _residuals(R_new, p_new, plane_t, xy_t)
            cost_new = np.einsum("cin,cin->c", e_new, e_new)
            better = cost_new <= cost
            damping = np.where(better, damping * 0.1, damping * 30.0)
            R, p = np.where(better[:, None, None], R_new, R), np.where(better[:, None], p_new, p)
            e, iz = np.where(better[:, None, None], e_new, e), np.where(better[:, None], iz_new, iz)
            predicted = np.where(better[:, None, None], predicted_new, predicted)
            cost = np.where(better, cost_new, cost)
            information, gradient = _normal_equations(R, moments, e, predicted, iz)
            gain = np.einsum("ci,ci->c", g, step)  # of the cost, as the linear model promised
            done = (gain <= _GAIN_DONE * cost + 1e-26) | (damping > 1e6) | ~alive
            # a second pose that is clearly worse need not be refined to its last digit
            hopeless = cost - 5.0 * gain > cost.min() * (1.0 + _HOPELESS_CHI2 / (2 * len(xy)))
            if np.all(done | hopeless):
                break
    return R, p, np.sqrt(cost / (2 * len(xy))), information


def _move_origin(information: FloatArray, R: FloatArray, centre: FloatArray) -> FloatArray:
    """Information of the pose of the target's origin from that of its centre (c, 6, 6)."""
    T = np.zeros_like(information)
    T[:] = np.eye(6)
    # p_centre = p_origin + R exp(d) c, so its derivative by d is -R hat(c)
    T[:, :3, 3:] = -R @ so3.hat(np.array([centre[0], centre[1], 0.0]))
    out: FloatArray = np.swapaxes(T, 1, 2) @ information @ T
    return out


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse, in scaled units; a direction without information gets a huge variance, not an exception."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    w, V = np.linalg.eigh(information * np.outer(scale, scale))
    W = (V * scale[:, None]) / np.sqrt(np.maximum(w, 1e-14))
    out: FloatArray = W @ W.T
    return out


def _rank(
    R: FloatArray, p: FloatArray, rms: FloatArray, information: FloatArray, n: int, sigma: float | None
) -> PlanarPoses:
    order = [int(i) for i in np.argsort(np.where(np.isfinite(rms), rms, np.inf)) if np.isfinite(rms[i])]
    if not order:
        return PlanarPoses((), reason="the points lie behind the camera")
    if len(order) == 2:
        turn = np.linalg.norm(so3.log(R[order[0]].T @ R[order[1]]))
        if turn < _SAME_ROTATION_RAD:
            order = order[:1]
    best = rms[order[0]]
    measured = best * np.sqrt(2 * n / max(2 * n - 6, 1))
    noise = max(measured if sigma is None else sigma, 1e-12)
    candidates = tuple(
        PlanarPose(R[i], p[i], float(rms[i]), _inverse(information[i]) * noise**2) for i in order
    )
    ambiguous = False
    if len(order) == 2:
        ambiguous = bool(2 * n * (rms[order[1]] ** 2 - best**2) < SURE_SIGMAS**2 * noise**2)
    return PlanarPoses(candidates, ambiguous)
