"""Turns what is carried from window to window into the plain numbers of an estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vical_daemon.estimation.filter.unobservable_directions import held_covariance
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model import imu_scale
from vical_daemon.estimation.model.imu_scale import matrices as matrices_of
from vical_daemon.estimation.model.next_term import reported_camera
from vical_daemon.estimation.model.retract import moved_camera
from vical_daemon.estimation.model.snapshot import (
    camera_snapshot,
    imu_snapshot,
    in_gyro_frame,
    joint_covariance,
)
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.result import CameraEstimate, ImuEstimate
from vical_daemon.estimation.selection.model_mixture import Block, Weights, mixture
from vical_daemon.estimation.selection.model_selection import IMU
from vical_daemon.estimation.smoother.clock_changes import Clock, over_clocks
from vical_daemon.estimation.smoother.marginal_prior import BIASES, MarginalPrior, later


@dataclass(frozen=True)
class ReportedModels:
    """How what is carried is to be reported.

    Attributes:
        carry: What is carried.
        factor: Measured variance over the stated one; multiplies the reported covariance.
        clocks: Hypotheses about the clocks; none: the drift is not estimated.
        every: What may be as specified: the imu, a fixed lens.
        weights: Probability of each hypothesis about these.
        asked: Blocks that are to be estimated in any case.
        rolling: The shutter is known to be a rolling one: its readout is reported.
    """

    carry: MarginalPrior
    factor: float
    clocks: tuple[Clock, ...]
    every: Mapping[str, Block]
    weights: Weights
    asked: frozenset[str] = frozenset()
    rolling: bool = True

    @cached_property
    def averaged(self) -> tuple[CameraState, FloatArray]:
        """Camera, and root of the covariance over `factor`, over the models of imu, fixed lens and clock."""
        layout = self.carry.layout
        (name,) = layout.cameras
        d, S = self._over_clocks()
        every = {block: replace(b, values=b.values + d[b.where]) for block, b in self.every.items()}
        step, S = mixture(S, every, self.weights, self.factor, self.asked)
        d = d + step
        camera = moved_camera(self.carry.camera, layout.camera, d)
        if IMU not in self.asked:
            gyro_matrix = matrices_of((self.carry.imu + d[layout.inertial])[1:])[0]
            cameras, S = in_gyro_frame(layout, gyro_matrix, {name: camera}, S)
            camera = cameras[name]
        return camera, S

    def _over_clocks(self) -> tuple[FloatArray, FloatArray]:
        """What the mean moves by, shape (n,), and root of the covariance over its factor, over the clocks."""
        n = self.carry.layout.size
        if not self.clocks:
            return np.zeros(n), self.carry.S[:n]
        d, P = over_clocks(self.carry, self.clocks, self.factor)
        scale = np.sqrt(np.maximum(np.diag(P), 1e-300))  # pixels and microseconds
        values, vectors = np.linalg.eigh(P / np.outer(scale, scale) / self.factor)
        return d, scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def camera_estimate(
    models: ReportedModels,
    sigma_px: float,
    rms_px: float,
    held: FloatArray | None = None,
    later_s: float = 0.0,
) -> CameraEstimate:
    """The camera as it is known.

    Args:
        models: What is known, and how it is to be reported.
        sigma_px: Pixel noise.
        rms_px: RMS of the residuals.
        held: Axis of the imu along which the lever arm is not known, unit, shape (3,); None: there is none.
        later_s: So long after the images the time shift is reported, s: the drift has moved it.
    """
    carry, (camera, S) = models.carry, models.averaged
    camera = replace(camera, timeshift_s=camera.timeshift_s + later_s * camera.skew)
    S = later(carry.layout, later_s) @ S
    (name,), where = carry.layout.cameras, carry.layout.camera
    fixed = carry.layout.held.get(name)
    n = 4 + len(camera.distortion)
    onto = np.eye(n - camera.term, n)
    camera = reported_camera(camera, onto)
    lens = np.concatenate([camera.intrinsics, camera.distortion])
    joint = models.factor * joint_covariance(S, where, onto)
    if held is not None:
        joint[:3, :3] += held_covariance(np.outer(held, held))
    lens_sigma = np.sqrt(np.diag(joint)[7:])
    if fixed is not None:
        lens, lens_sigma = fixed.values[: len(lens)], fixed.reported(lens_sigma)
    return camera_snapshot(
        camera,
        joint=joint,
        lens=lens,
        lens_sigma=lens_sigma,
        readout_sigma_s=float(np.sqrt(models.factor) * np.linalg.norm(S[where.readout])),
        rms_px=rms_px,
        sigma_px=sigma_px,
        rolling=models.rolling,
        model_fits=models.factor == 1.0,
    )


def imu_estimate(carry: MarginalPrior, *, matrices: bool = False, positions: bool = False) -> ImuEstimate:
    """Biases and their sigmas; if wanted, matrices and positions of the accelerometer's axes."""
    sigma, numbers = np.sqrt(np.diag(carry.covariance())[BIASES]), carry.imu[1:]
    positions_m = imu_scale.positions_m(numbers[imu_scale.APART]) if positions else None
    return imu_snapshot(carry.bias, sigma, matrices_of(numbers) if matrices else (), positions_m)
