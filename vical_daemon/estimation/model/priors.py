"""Priors: one table for calibration with a target and without.

Prior sigmas are many times what a start is worth, so that its data do not count twice.
[docs/math/filter.md, eq. (16), (18) and (20)]
"""

from __future__ import annotations

import math
from typing import NamedTuple

GYRO_BIAS_SIGMA_RPS = 0.02
"""1.1 deg/s: four times the initial bias error of the datasheet (3DM-GX3-25: 0.25 deg/s)."""
ACCEL_BIAS_SIGMA_MPS2 = 0.3
"""Fifteen times the initial bias error of the datasheet (3DM-GX3-25: 0.002 g)."""
GRAVITY_SIGMA_RAD = 0.1
"""Tilt of gravity in the world of a board that the closed form has found."""
SKEW_SIGMA = 1e-4
"""Drift of clocks that do not run alike, s/s; two poor crystals."""
SKEW_WALK = 1e-8
"""How such a drift wanders (temperature), s/s per sqrt(s)."""
STEP_SIGMA_S = 1e-3
"""By how much a time shift steps where a clock or its driver changes, s."""
CLOCK_CHANGES_HZ = 1 / 3600
"""How often that happens: about once an hour."""
SHIFT_WALK = 2e-6
"""How a time shift wanders without a drift, s/sqrt(s): clocks are not quite constant."""
ENTRY_SIGMA = 2e-3
"""Scale or alignment of an IMU that is not as it says, each entry."""
KNOWN_OFF_SIGMA = 1e-2
"""The same of an IMU that is known to be off, or whose matrices are asked for."""
G_SENSITIVITY_S_PER_M = math.radians(0.1) / 9.81
"""Rate that a gyro shows for a specific force, rad/s over m/s^2: 0.1 deg/s for 1 g in data sheets of consumer
gyros, 0.01 to 0.02 of industrial ones. Not estimated."""
APART_SIGMA_M = 5e-3
"""How far the axes of an accelerometer are from each other where they are chips of their own, m."""
LAG_SIGMA_S = 3e-4
"""By how much the delays of accelerometer and gyro differ in an IMU where they do, s."""
SIZE_SIGMA = 0.02
"""Of a target that has not the size in its file, relative; pages fitted to the paper: 3 to 6 %."""
KNOWN_SIZE_SIGMA = 0.1
"""Of the size of a target that is known to be off, or where it is asked for, relative."""
OFF = 0.05
"""Share of rigs of which any one thing is not as specified, clocks that do not run alike included."""
SURE = 0.99
"""Probability from which on something is known, and announced."""


class StartSigmas(NamedTuple):
    """How far motion and calibration may be off at a start, one sigma.

    Attributes:
        attitude_rad: Of the imu in the world; without a target only its tilt counts.
        velocity_mps: Of the imu.
        lever_arm_m: Of each component: a robot's, not a telephone's.
        rotation_rad: Of the mounting.
        timeshift_s: Of the camera.
        focal, centre: Of fx fy and of cx cy, over the focal length.
        distortion, tangential: Of radial and of tangential coefficients.
        equidistant: Of each coefficient of an equidistant lens.
        readout_s: From first to last row.
    """

    attitude_rad: float
    velocity_mps: float
    lever_arm_m: float
    rotation_rad: float
    timeshift_s: float
    focal: float
    centre: float
    distortion: float
    tangential: float
    equidistant: float
    readout_s: float


ROTATION_SIGMA_RAD, SHIFT_SIGMA_S = math.radians(1.0), 1e-3
"""So well mounting and time shift must be known for a start: 0.06 deg at 60 deg/s. [docs/design/filter.md]"""
LONG_SHIFT_SIGMA_S = 8e-3
"""Likewise of a start after a long time: slow rigs show no more. [docs/design/filter.md]"""
AGAIN_SIGMAS = 5.0
"""Prior over sigma of what was found from data that are used once more: they count again by 4 % at most."""
FILTER_START = StartSigmas(0.1, 0.5, 0.3, 0.1, 0.05, 0.05, 0.05, 0.1, 0.1, 0.1, 0.01)
"""With a target: the closed form has found all of it but lever arms, to about a fifth of these."""
WINDOW_START = StartSigmas(1.0, 5.0, 0.3, 0.2, 0.05, 0.05, 0.03, 0.1, 0.01, 0.05, 0.015)
"""Without a target: next to nothing is known of the motion, and of the rest what a rig can be."""
