"""One camera and the imu as the plain numbers of an estimate, with a target and without."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import CameraSlices, CameraState, Layout
from vical_daemon.estimation.result import CameraEstimate, ImuEstimate, PoseEstimate


def joint_covariance(S: FloatArray, where: CameraSlices, onto: FloatArray) -> FloatArray:
    """Covariance of [lever arm, rotation, time shift, lens], zeros where not estimated, shape (7 + n, 7 + n).

    Args:
        S: Square root of the covariance of the errors.
        where: Of the camera.
        onto: From its lens to what is reported of it, see `next_term.onto_model`, shape (n, k).
    """
    shift = None if where.timeshift is None else slice(where.timeshift, where.timeshift + 1)
    places = (where.position, where.rotation, shift, where.intrinsics, where.distortion)
    rows = np.zeros((7 + onto.shape[1], S.shape[1]))
    for place, (begin, end) in zip(places, pairwise((0, 3, 6, 7, 11, len(rows))), strict=True):
        if place is not None:
            rows[begin:end] = S[place]
    rows = np.concatenate([rows[:7], onto @ rows[7:]])
    return np.asarray(rows @ rows.T)


def camera_snapshot(
    camera: CameraState,
    *,
    joint: FloatArray,
    lens: FloatArray,
    lens_sigma: FloatArray,
    readout_sigma_s: float,
    rms_px: float,
    sigma_px: float,
    rolling: bool = True,
    jitter_s: float = 0.0,
    model_fits: bool | None = None,
) -> CameraEstimate:
    """Put what is reported of one camera together.

    Args:
        camera: Its nominal values.
        joint: See `joint_covariance`.
        lens: fx fy cx cy and the distortion as reported, shape (n,).
        lens_sigma: Standard deviations, shape (n,).
        readout_sigma_s: Of the readout, s.
        rms_px: RMS of the residuals, px.
        sigma_px: Corner or feature noise, px.
        rolling: Its shutter is known to roll, or taken to: its readout is reported.
        jitter_s: Of its stamps, s.
        model_fits: See `CameraEstimate`.
    """
    q = so3.quat_from_matrix(camera.R_imu_cam)
    return CameraEstimate(
        T_imu_cam=PoseEstimate(camera.p_imu_cam.tolist(), q.tolist(), joint[:6, :6].tolist()),
        timeshift_cam_imu_s=float(camera.timeshift_s),
        timeshift_sigma_s=float(np.sqrt(joint[6, 6])),
        intrinsics=lens[:4].tolist(),
        intrinsics_sigma=lens_sigma[:4].tolist(),
        distortion_model=camera.distortion_model,
        distortion=lens[4:].tolist(),
        distortion_sigma=lens_sigma[4:].tolist(),
        reprojection_rms_px=float(rms_px),
        corner_sigma_px=float(sigma_px),
        readout_s=float(camera.readout_s) if rolling else 0.0,
        readout_sigma_s=float(readout_sigma_s) if rolling else 0.0,
        resolution=[int(size) for size in camera.resolution],
        readout_axis=camera.readout_axis if rolling else "",
        stamp_jitter_s=float(jitter_s),
        calibration_covariance=joint.tolist(),
        model_fits=model_fits,
    )


def imu_snapshot(
    bias: FloatArray,
    sigma: FloatArray,
    matrices: Sequence[FloatArray] = (),
    positions_m: FloatArray | None = None,
) -> ImuEstimate:
    """Put what is reported of the imu together.

    Args:
        bias: Of gyro (rad/s) and accelerometer (m/s^2), shape (6,).
        sigma: Standard deviations, shape (6,).
        matrices: M_g and M_a where they are asked for, shape (3, 3) each.
        positions_m: Of the accelerometer's axes where they are asked for or known to be apart, shape (3, 3).
    """
    blocks = [np.asarray(x).tolist() for x in (bias[:3], bias[3:], sigma[:3], sigma[3:])]
    found = ImuEstimate(*blocks, *(m.tolist() for m in matrices))
    return found if positions_m is None else replace(found, accel_positions_m=positions_m.tolist())


def in_gyro_frame(
    layout: Layout, gyro_matrix: FloatArray, cameras: Mapping[str, CameraState], S: FloatArray
) -> tuple[dict[str, CameraState], FloatArray]:
    """Mounting and lever arm in the frame in which M_g is symmetric: as by plain integration.

    The accelerometer's matrix is lower triangular in another frame. In this one the mounting is known twice
    as well. With the polar decomposition M_g = Q A, A symmetric, it is turned by Q. A change dM of M_g turns
    it by w, (tr(A) I - A) w = 2 k, hat(k) the antisymmetric part of Q^T dM. (tested against differences)
    [docs/math/filter.md, after eq. (18)]

    Args:
        layout: Where the errors live.
        gyro_matrix: M_g.
        cameras: By name.
        S: Square root of the covariance, shape (n, m).

    Returns:
        Cameras and square root in that frame.
    """
    found = dict(cameras)
    if layout.gyro_matrix is None:
        return found, S
    U, scales, Vt = np.linalg.svd(gyro_matrix)
    back, A, S = (U @ Vt).T, (Vt.T * scales) @ Vt, S.copy()
    changes = np.einsum("ij,jkn->ikn", back, S[layout.gyro_matrix].reshape(3, 3, -1))
    turned = np.linalg.solve(np.trace(A) * np.eye(3) - A, 2.0 * _antisymmetric(changes))
    for name, where in layout.cameras.items():
        if where.position is None or where.rotation is None:
            continue
        cam = found[name]
        R, p = back @ cam.R_imu_cam, back @ cam.p_imu_cam
        S[where.rotation] -= R.T @ turned
        S[where.position] = back @ S[where.position] + so3.hat(p) @ turned
        found[name] = replace(cam, R_imu_cam=R, p_imu_cam=p)
    return found, S


def _antisymmetric(M: FloatArray) -> FloatArray:
    """The vector whose cross-product matrix the antisymmetric part of M is, shape (3, ...)."""
    return np.asarray(0.5 * (M[[2, 0, 1], [1, 2, 0]] - M[[1, 2, 0], [2, 0, 1]]))
