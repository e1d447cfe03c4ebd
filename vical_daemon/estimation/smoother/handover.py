"""What a window of the target-free calibration hands to the next: a prior with process noise, an image."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.measurements import (
    BoolArray,
    CameraPrior,
    FloatArray,
    ImuNoise,
    PointsFrame,
)
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.priors import (
    ACCEL_BIAS_SIGMA_MPS2,
    GYRO_BIAS_SIGMA_RPS,
    SHIFT_WALK,
    SKEW_WALK,
)
from vical_daemon.estimation.smoother.marginal_prior import (
    ARM,
    BIASES,
    CALIBRATION,
    DRIFT,
    SHIFT,
    MarginalPrior,
    first_carry,
    held_along,
    root_of,
)
from vical_daemon.estimation.smoother.target_free_initializer import prior_centre, start_sigmas
from vical_daemon.estimation.smoother.window import KNOT_S, Landmarks, Window

_GYRO_BIAS_RPS, _ACCEL_BIAS_MPS2 = 4e-4, 5e-3  # by which biases may have walked while nothing was seen


def initial_prior(
    window: Window,
    known: MarginalPrior | None,
    active: BoolArray,
    held: FloatArray | None,
    imu_sigma: float,
    given: CameraPrior,
    reopened: Collection[int] = (),
    fixed: FixedLens | None = None,
) -> MarginalPrior:
    """Prior of a window that starts from nothing: wide, or with the calibration and biases known before.

    Args:
        window: As the start left it; takes the known time shift along.
        known: What was known, or None.
        active: Which calibration errors are estimated, shape (n,).
        held: Axis along which the lever arm is held, see `TargetFreeInitializer`.
        imu_sigma: Of the entries of the imu's matrices, where nothing is known.
        given: What is known about the camera without any data.
        reopened: Errors of the calibration of which nothing is known any more; of mounting and time shift.
        fixed: The lens, where it is fixed and its errors are considered.
    """
    centre = prior_centre(window.camera, given)
    wide = first_carry(window, centre, active, start_sigmas(centre, imu_sigma, fixed))
    if known is None:
        return wide if held is None else held_along(wide, held)
    known = known.at(wide.t_cam_s)
    keep = known.covariance()[5:, 5:]
    keep[:3, :3] += _GYRO_BIAS_RPS**2 * np.eye(3)
    keep[3:6, 3:6] += _ACCEL_BIAS_MPS2**2 * np.eye(3)
    covariance = np.diag(np.diag(wide.root) ** -2.0)
    kept = 5 + np.flatnonzero([True] * 6 + [k not in reopened for k in np.flatnonzero(active)])
    covariance[np.ix_(kept, kept)] = keep[np.ix_(kept - 5, kept - 5)]
    camera, found = known.camera, window.camera
    if SHIFT in reopened:
        camera = replace(camera, timeshift_s=found.timeshift_s)
    else:
        window.camera = replace(found, timeshift_s=camera.timeshift_s)
    if ARM.start in reopened:
        camera = replace(camera, R_imu_cam=found.R_imu_cam, p_imu_cam=found.p_imu_cam)
    return replace(wide, root=root_of(covariance), bias=known.bias.copy(), camera=camera)


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
    if known.active[SHIFT]:
        place = CALIBRATION + int(known.active[:SHIFT].sum())
        P[place, place] += stepped_s**2
    return replace(known, bias=window.bias[0].copy(), root=root_of(P), t_cam_s=window.frames[0][0])


def with_process_noise(
    carry: MarginalPrior, noise: ImuNoise, active: BoolArray, span_s: float, *, drifting: bool
) -> MarginalPrior:
    """Let biases and delay walk a little before the next window."""
    P = carry.covariance()
    P[range(5, 8), range(5, 8)] += noise.gyro_walk**2 * KNOT_S
    P[range(8, 11), range(8, 11)] += noise.accel_walk**2 * KNOT_S
    for error, walk in ((SHIFT, SHIFT_WALK), (DRIFT, SKEW_WALK if drifting else 0.0)):
        if active[error]:
            place = CALIBRATION + int(active[:error].sum())
            P[place, place] += walk**2 * span_s
    return replace(carry, root=root_of(P))


def next_window(window: Window, carry: MarginalPrior) -> Window:
    """A window that begins at the last image of this one; that image has been used."""
    t, last = window.frames[-1]
    none = PointsFrame(last.camera, last.t_cam_ns, last.ids[:0], last.uv_px[:0])
    empty = Landmarks(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return Window(
        carry.camera,
        window.noise,
        [(t, none)],
        carry.R[None],
        np.zeros((1, 3)),
        (carry.R @ carry.speed)[None],
        carry.bias[None].copy(),
        [],
        carry.camera.timeshift_s,
        empty,
        gravity=window.gravity,
        imu=window.imu,
        jumps=carry.jumps.copy(),
    )
