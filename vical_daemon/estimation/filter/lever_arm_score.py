"""Bias of lever arms by noise of the gyro, and of the target's size by noise of the accelerometer.

Both are errors in variables, predicted and subtracted image by image.

A lever arm p shows in how the camera moves when the rig turns. The turn is measured with noise, and the same
noise is in the innovations r, so that dr/dp and r are correlated. A filter does not differentiate its gains,
and solves sum (dr/dp)' S^-1 r = 0. At the true p, however,

    E[(dr/dp)' S^-1 r] = 1/2 tr(S^-1 dS/dp) = 1/2 d log det S / dp,

because S(p) is the covariance of r(p). Each image adds this to the information vector, and P times the sum is
the bias. The sum does not depend on how fast the rig moves; P does. Likewise the size of the target shows in
moves of the camera, which accelerations predict with noise. Likewise the accelerometer's scale.
[docs/math/filter.md, "Lever arms and noise of the gyro"]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dgesv

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import ATTITUDE, BIASES, LOWER, MOTION, Layout, State
from vical_daemon.estimation.model.unscented import unit

MOTION_ERRORS = BIASES.stop
"""Number of errors of attitude, position, velocity and biases."""
UNCERTAIN = 0.5
"""Share of the bias: it goes with the square of the gyro's noise, which a data sheet gives to a quarter."""
_BIASES = np.arange(BIASES.start, BIASES.stop)
_DIAGONAL = np.flatnonzero(LOWER[:, 0] == LOWER[:, 1])  # of the accelerometer matrix, among its entries
_BY_ARM = -so3.hat(so3.IDENTITY)
"""Derivative of -hat(p) by each component of p, shape (3, 3, 3)."""


@dataclass(slots=True)
class LeverArmScore:
    """Covariance of motion and biases, calibration known, and its derivatives.

    Attributes:
        P: The covariance, then its derivatives by the components of all lever arms, 1/m, and by the logarithm
            of the target's size, shape (2 + 3 cameras, MOTION_ERRORS, MOTION_ERRORS).
    """

    P: FloatArray

    @classmethod
    def of(cls, covariance: FloatArray, cameras: int) -> LeverArmScore:
        """Begin with a covariance of the motion and biases, shape (MOTION_ERRORS, MOTION_ERRORS)."""
        P = np.zeros((2 + 3 * cameras, *covariance.shape))
        P[0] = covariance
        return cls(P)

    def predict(self, slopes: FloatArray, Q: FloatArray, walk: FloatArray) -> None:
        """Propagate.

        Args:
            slopes: Of the motion by itself and the biases, shape (9, MOTION_ERRORS).
            Q: Covariance of the noise that the motion gathers, shape (9, 9).
            walk: Variances that the biases gain, shape (6,).
        """
        F = np.eye(MOTION_ERRORS)
        F[MOTION] = slopes
        self.P = F @ self.P @ F.T
        self.P[0, MOTION, MOTION] += Q
        self.P[0, _BIASES, _BIASES] += walk

    def update(
        self, information: FloatArray, by_motion: FloatArray, to_cam: FloatArray, at: int
    ) -> FloatArray:
        """Update with an image.

        With N the information, T its derivatives by the motion and S the covariance of turn and move as the
        image shows them, S^-1 = B = (1 + N T P T')^-1 N, the gain is G = P T' B and 1 - G T = J. Then
        d log det S = tr(B dS), dS = dT P T' + T P dT' + T dP T', and the new P has the derivative
        J dP J' - G dT P - (G dT P)'. [tested against differences]

        Args:
            information: What it says about turn and move of its camera, in its frame, shape (6, 6).
            by_motion: That turn and move by the motion and biases, shape (6, MOTION_ERRORS).
            to_cam: R_imu_cam', shape (3, 3).
            at: Index of the camera.

        Returns:
            1/2 d log det S / dp of all lever arms, 1/m, and by the logarithm of the target's size, shape
            (3 cameras + 1,).
        """
        P, dP, T = self.P[0], self.P[1:], by_motion
        dT = np.zeros((len(dP), *T.shape))
        dT[3 * at : 3 * at + 3, 3:6, ATTITUDE] = to_cam @ _BY_ARM
        dT[-1, 3:6] = -T[3:6]  # pixels show moves over distances, which are those of the target
        PT = P @ T.T
        B = dgesv(unit(6) + information @ (T @ PT), information)[2]
        G = PT @ B
        J = unit(MOTION_ERRORS) - G @ T
        score = (dT @ PT).reshape(-1, B.size) @ B.T.ravel()
        score += 0.5 * (dP.reshape(-1, P.size) @ (T.T @ B @ T).ravel())
        new = np.empty(self.P.shape)
        new[0] = P - G @ PT.T
        new[1:] = J @ dP @ J.T - 2.0 * (G @ dT @ new[0])
        self.P = 0.5 * (new + np.swapaxes(new, 1, 2))
        return np.asarray(score)


def information(score: FloatArray, state: State, layout: Layout) -> FloatArray:
    """Information vector of a score, shape (layout.size,).

    If target, lever arms, gravity and the accelerometer's matrix grow by one factor, no innovation changes,
    and no S either. Gravity has no noise. So the score by the logarithm of the matrix is minus that of the
    size and all arms together; each axis gets a third, as if all were equally noisy. Without this part every
    image would move all of these by one factor, which only the prior of gravity limits.

    Args:
        score: By all lever arms, 1/m, and the logarithm of the target's size, shape (3 cameras + 1,).
        state: Nominal state.
        layout: Where the errors live.
    """
    out = np.zeros(layout.size)
    for k, where in enumerate(layout.cameras.values()):
        if where.position is not None:
            out[where.position] = score[3 * k : 3 * k + 3]
    if layout.target_scale is not None:
        out[layout.target_scale] = score[-1] / state.target_scale
    if layout.accel_matrix is not None:
        arms_m = np.concatenate([state.cameras[name].p_imu_cam for name in layout.cameras])
        by_matrix = -(score[-1] + arms_m @ score[:-1]) / 3.0
        out[layout.accel_matrix.start + _DIAGONAL] = by_matrix / np.diag(state.accel_matrix)
    return out
