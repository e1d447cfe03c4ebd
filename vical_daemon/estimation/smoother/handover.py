"""What a window of the target-free calibration hands to the next: a prior with process noise, an image."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.measurements import CameraPrior, FloatArray, ImuNoise, PointsFrame
from vical_daemon.estimation.model.inertial_links import PreintegratedLinks
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    GYRO_BIAS_SIGMA_RPS,
    SHIFT_WALK,
    SKEW_WALK,
    WINDOW_START,
)
from vical_daemon.estimation.model.start_sigmas import start_sigmas
from vical_daemon.estimation.model.state import Layout
from vical_daemon.estimation.smoother.marginal_prior import (
    BIASES,
    MarginalPrior,
    first_carry,
    held_along,
    root_of,
)
from vical_daemon.estimation.smoother.target_free_initializer import prior_centre
from vical_daemon.estimation.smoother.window import KNOT_S, Landmarks, Window


def initial_prior(
    window: Window,
    known: MarginalPrior | None,
    layout: Layout,
    held: FloatArray | None,
    imu_sigma: float,
    gravity_sigma_mps2: float,
    given: CameraPrior,
    reopened: Collection[int] = (),
) -> MarginalPrior:
    """Prior of a window that starts from nothing: wide, or with the calibration and biases known before.

    Args:
        window: As the start left it; takes the known time shift along.
        known: What was known, or None.
        layout: Where the errors live.
        held: Axis along which the lever arm is held, see `TargetFreeInitializer`.
        imu_sigma: Of the entries of the imu's matrices, where nothing is known.
        gravity_sigma_mps2: Of the magnitude of gravity.
        given: What is known about the camera without any data.
        reopened: Errors of which nothing is known any more; of mounting and time shift.
    """
    centre = prior_centre(window.camera, given)
    (name,) = layout.cameras
    sigmas = start_sigmas(
        layout, {name: centre}, WINDOW_START, imu_sigma=imu_sigma, gravity_sigma_mps2=gravity_sigma_mps2
    )
    wide = first_carry(window, centre, layout, sigmas)
    if known is None:
        return wide if held is None else held_along(wide, held)
    unseen_s = max(wide.t_cam_s - known.t_cam_s, KNOT_S)
    known = known.at(wide.t_cam_s)
    covariance, before = np.diag(np.diag(wide.root) ** -2.0), known.covariance()
    before[BIASES, BIASES] += _walked(window.noise, unseen_s)
    kept = [k for k in range(BIASES.start, layout.size) if k not in reopened]
    covariance[np.ix_(kept, kept)] = before[np.ix_(kept, kept)]
    camera, found, where = known.camera, window.camera, layout.camera
    if where.timeshift in reopened:
        camera = replace(camera, timeshift_s=found.timeshift_s)
    else:
        window.camera = replace(found, timeshift_s=camera.timeshift_s)
    if where.position is not None and where.position.start in reopened:
        camera = replace(camera, R_imu_cam=found.R_imu_cam, p_imu_cam=found.p_imu_cam)
    return replace(wide, root=root_of(covariance), bias=known.bias.copy(), camera=camera, imu=known.imu)


def of_another_recording(known: MarginalPrior, window: Window, stepped_s: float) -> MarginalPrior:
    """What was known, for the first window of another recording: its biases are those that its start finds.

    Args:
        known: At the end of the recording before.
        window: As a start from nothing makes it.
        stepped_s: By how much the imu's stamps were moved there, s: they may begin as far off here.

    The time between the recordings is not known, and taken as none.
    """
    P = known.covariance()
    P[BIASES], P[:, BIASES] = 0.0, 0.0
    P[BIASES, BIASES] = np.diag(np.repeat([GYRO_BIAS_SIGMA_RPS, ACCEL_BIAS_SIGMA_MPS2], 3) ** 2)
    shift = known.layout.camera.timeshift
    if shift is not None:
        P[shift, shift] += stepped_s**2
    return replace(known, bias=window.bias[0].copy(), root=root_of(P), t_cam_s=window.frames[0][0])


def with_process_noise(
    carry: MarginalPrior, noise: ImuNoise, span_s: float, *, drifting: bool
) -> MarginalPrior:
    """Let biases and delay walk a little before the next window."""
    P, where = carry.covariance(), carry.layout.camera
    P[BIASES, BIASES] += _walked(noise, KNOT_S)
    for place, walk in ((where.timeshift, SHIFT_WALK), (where.skew, SKEW_WALK if drifting else 0.0)):
        if place is not None:
            P[place, place] += walk**2 * span_s
    return replace(carry, root=root_of(P))


def _walked(noise: ImuNoise, seconds: float) -> FloatArray:
    """Covariance that biases gain in some seconds, shape (6, 6)."""
    return np.diag(np.repeat([noise.gyro_walk, noise.accel_walk], 3) ** 2 * seconds)


def next_window(window: Window, carry: MarginalPrior) -> Window:
    """A window that begins at the last image of this one; that image has been used."""
    t, last = window.frames[-1]
    none = PointsFrame(last.camera, last.t_cam_ns, last.ids[:0], last.uv_px[:0])
    return Window(
        carry.camera,
        window.noise,
        [(t, none)],
        carry.R[None],
        np.zeros((1, 3)),
        (carry.R @ carry.speed)[None],
        carry.bias[None].copy(),
        PreintegratedLinks.none(6 + len(window.imu) - 1),
        carry.camera.timeshift_s,
        Landmarks.none(),
        window.imu,
        jumps=carry.jumps.copy(),
    )
