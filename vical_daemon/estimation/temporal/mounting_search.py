"""Likely mountings of a camera from feature tracks and a gyro, looked for everywhere.

Where the scene is flat, or the rig turns slowly while it moves, two views have several solutions that fit
alike, and orientations strung together from them may turn about other axes than the camera. The gyro's turns
and one mounting must fit all pairs of images. So mountings are spread evenly over all rotations and judged by
the epipolar constraint with the directions eliminated; see `epipolar_fit`.
"""

from __future__ import annotations

import math

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray, Frames
from vical_daemon.estimation.model.camera_rays import unproject
from vical_daemon.estimation.temporal.epipolar_pairs import LAGS_S, make_pairs
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve

_TRIED = 600  # mountings: any rotation is within 28 deg of one of them
_NEAR_RAD = float(np.deg2rad(60.0))  # of what is known roughly: one axis may be off by far
_MOST_FEATURES = 3000  # in pairs of images: more would only cost time
_AGREE_PX = 2.0  # a feature so far from its line counts half: several times a tracker's noise
_COUNT = 5  # mountings returned: minima of flat scenes lie up to 70 deg apart


def likely_mountings(
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    frames: Frames,
    lens: tuple[FloatArray, FloatArray, str],
    shifts_s: FloatArray,
    near: FloatArray | None = None,
) -> list[tuple[FloatArray, float]]:
    """Return the mountings, with a time shift each, at which tracks and gyro agree best.

    Through a narrow lens a half turn about the optical axis agrees nearly as well: an image that moves as a
    whole looks like a move sideways. So where the mounting is known roughly, only those near it are tried.

    Args:
        t_imu_s: Stamps of the gyro, s, shape (m,).
        gyro_rps: Rates, rad/s, imu frame, shape (m, 3).
        frames: (stamp in the camera's clock in s, tracks), in order of time.
        lens: fx fy cx cy, distortion, model.
        shifts_s: Time shifts to try, t_imu - t_cam, s, shape (k,).
        near: What is known of R_imu_cam, shape (3, 3); None: nothing.

    Returns:
        R_imu_cam and time shift, best first, each to some 25 deg and half a step of the shifts; nothing
        where too few features are shared by images.
    """
    features = len(LAGS_S) * sum(len(f.ids) for _, f in frames)
    pairs = make_pairs(frames, every=max(1, math.ceil(features / _MOST_FEATURES)))
    if pairs is None:
        return []
    rays, ok = unproject(pairs.uv, *lens)
    rays = np.where(ok[:, None], rays, 0.0)
    a, b = rays[pairs.at_1], rays[pairs.at_2]
    half = (_AGREE_PX / float(np.mean(lens[0][:2]))) ** 2
    t_cam = np.array([t for t, _ in frames])
    curve = GyroCurve.integrate(t_imu_s, gyro_rps, np.zeros(3))
    tried = even_rotations(_TRIED)
    if near is not None:
        tried = tried[np.einsum("nij,ij->n", tried, near) > 1.0 + 2.0 * np.cos(_NEAR_RAD)]
    found: list[tuple[float, FloatArray, float]] = []
    for shift_s in shifts_s.tolist():
        A = curve.at(np.clip(t_cam + shift_s, t_imu_s[0], t_imu_s[-1]))[0]
        turned = np.swapaxes(A[pairs.first], 1, 2) @ A[pairs.second]
        for R in tried:
            second = np.matvec(np.take(R.T @ turned @ R, pairs.of, axis=0), b)
            normal = so3.cross(a, second)
            squares = np.add.reduceat(normal[:, :, None] * normal[:, None, :], pairs.begin)
            along = np.take(np.linalg.eigh(squares)[1][:, :, 0], pairs.of, axis=0)
            by_first, by_second = so3.cross(along, a), so3.cross(along, second)
            size = np.vecdot(by_first, by_first) + np.vecdot(by_second, by_second)
            off = np.vecdot(along, normal) ** 2 / (size + 1e-12)
            found.append((float(np.mean(off / (off + half))), R, shift_s))
    found.sort(key=lambda x: x[0])
    return [(R, shift_s) for _, R, shift_s in found[:_COUNT]]


def even_rotations(count: int) -> FloatArray:
    """Rotations spread evenly, shape (count, 3, 3). [Alexa, "Super-Fibonacci spirals", 2022].

    Args:
        count: How many.
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / 1.533751168755204288
    q = np.stack(
        [outer * np.cos(beta), inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta)], axis=-1
    )
    return so3.matrix_from_quat(q)
