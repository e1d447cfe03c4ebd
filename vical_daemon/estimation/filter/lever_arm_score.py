"""Bias of lever arms by noise of the gyro, and of the target's size by noise of the accelerometer.

Both are errors in variables, predicted and subtracted image by image.

A lever arm p shows in how the camera moves when the rig turns. The turn is measured with noise, and the same
noise is in the innovations r, so that dr/dp and r are correlated. A filter does not differentiate its gains,
and solves sum (dr/dp)' S^-1 r = 0. At the true p, however,

    E[(dr/dp)' S^-1 r] = 1/2 tr(S^-1 dS/dp) = 1/2 d log det S / dp,

because S(p) is the covariance of r(p). Each image adds this to the information vector, and P times the sum is
the bias. The sum does not depend on how fast the rig moves; P does. Likewise the size of the target shows in
moves of the camera, which accelerations predict with noise.
[docs/math/filter.md, "Lever arms and noise of the gyro"]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.state import ATTITUDE, BIASES, MOTION
from vical_daemon.estimation.model.unscented import unit

MOTION_ERRORS = BIASES.stop
"""Number of errors of attitude, position, velocity and biases."""
UNCERTAIN = 0.5
"""Share of the bias: it goes with the square of the gyro's noise, which a data sheet gives to a quarter."""
_STEP = 1e-3
"""Of a lever arm, m, or of a size, for differences: log det S is straight over a hundred times that."""
_STEPS = _STEP * so3.hat(so3.IDENTITY)


@dataclass(slots=True)
class LeverArmScore:
    """Covariances of motion and biases, calibration known, for the present lever arms and for different ones.

    Attributes:
        P: For the present lever arms and target, with one component of one lever arm moved by a step, and
            with a larger target, shape (2 + 3 cameras, MOTION_ERRORS, MOTION_ERRORS).
    """

    P: FloatArray

    @classmethod
    def of(cls, covariance: FloatArray, cameras: int) -> LeverArmScore:
        """Begin with a covariance of the motion and biases, shape (MOTION_ERRORS, MOTION_ERRORS)."""
        return cls(np.repeat(covariance[None], 2 + 3 * cameras, axis=0))

    def predict(self, slopes: FloatArray, Q: FloatArray, walk: FloatArray) -> None:
        """Propagate.

        Args:
            slopes: Of the motion by itself and the biases, shape (9, MOTION_ERRORS).
            Q: Covariance of the noise that the motion gathers, shape (9, 9).
            walk: Variances that the biases gain, shape (6,).
        """
        F, gained = np.eye(MOTION_ERRORS), np.zeros((MOTION_ERRORS, MOTION_ERRORS))
        F[MOTION] = slopes
        gained[MOTION, MOTION] = Q
        gained[BIASES, BIASES] = np.diag(walk)
        self.P = F @ self.P @ F.T + gained

    def update(
        self, information: FloatArray, by_motion: FloatArray, to_cam: FloatArray, at: int
    ) -> FloatArray:
        """Update with an image.

        Args:
            information: What it says about turn and move of its camera, in its frame, shape (6, 6).
            by_motion: That turn and move by the motion and biases, shape (6, MOTION_ERRORS).
            to_cam: R_imu_cam', shape (3, 3).
            at: Index of the camera.

        Returns:
            1/2 d log det S / dp of all lever arms, 1/m, and by the logarithm of the target's size, shape
            (3 cameras + 1,).
        """
        T = np.repeat(by_motion[None], len(self.P), axis=0)
        T[1 + 3 * at : 4 + 3 * at, 3:6, ATTITUDE] -= to_cam @ _STEPS
        T[-1, 3:6] /= 1.0 + _STEP  # pixels show moves over distances, which are those of the target
        PT = self.P @ np.swapaxes(T, 1, 2)
        A = unit(6) + information @ (T @ PT)
        P = self.P - PT @ np.linalg.solve(A, information @ np.swapaxes(PT, 1, 2))
        self.P = 0.5 * (P + np.swapaxes(P, 1, 2))
        log_det = np.linalg.slogdet(A)[1]
        return np.asarray((log_det[1:] - log_det[0]) / (2.0 * _STEP))
