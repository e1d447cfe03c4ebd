"""What else could be wrong when rotations of two sensors do not fit: the usual mistakes are tried out.

Orientations may be inverted, the gyro mirrored (an axis of the wrong sign, two swapped), stamps stretched.
From the misfit alone these look alike: for small turns, inverted orientations are a mirrored mounting. So the
start is repeated with each mistake undone, and the one that makes the rotations fit is named.
"""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve, RotationCurve
from vical_daemon.estimation.temporal.rotation_start import Start, coarse_start, debiased_start
from vical_daemon.estimation.temporal.stamp_stretch import BETTER, estimate_clock_rate

_CLEAR = 0.25  # misfit of turns over their size below which they fit


def explain(
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    t_cam_s: FloatArray,
    q_world_cam: FloatArray,
    shifts_s: tuple[float, float],
    found: Start | None,
) -> str:
    """Name the mistake that, undone, makes the rotations fit.

    Args:
        t_imu_s: Stamps, s, shape (m,).
        gyro_rps: Rates, rad/s, shape (m, 3).
        t_cam_s: Camera stamps, increasing, s, shape (n,).
        q_world_cam: Camera orientations, shape (n, 4).
        shifts_s: Lowest and highest shift to look at, s.
        found: The start that the data gave as they are.

    Returns:
        In words; empty where no mistake explains it.
    """
    as_is = _score(found)
    q_cam_world = so3.quat_conjugate(q_world_cam)
    inverted = _score(debiased_start(t_imu_s, gyro_rps, t_cam_s, q_cam_world, shifts_s)[0])
    flipped = gyro_rps * np.array([-1.0, 1.0, 1.0])  # every mirrored mounting is this and a rotation
    mirrored = _score(debiased_start(t_imu_s, flipped, t_cam_s, q_world_cam, shifts_s)[0])
    limit = min(_CLEAR, BETTER * as_is)
    if inverted < min(limit, mirrored):
        return (
            "the orientations of the camera are inverted: the world's in the camera, not the camera's in "
            "the world (with their inverses the rotations fit)"
        )
    if mirrored < limit:
        return (
            "the rotations are mirrored: one gyro axis has the wrong sign, or two axes are swapped; the IMU "
            "frame must be right-handed"
        )
    curve = GyroCurve.integrate(t_imu_s, gyro_rps, np.zeros(3))
    factor = estimate_clock_rate(curve, t_cam_s, q_world_cam, shifts_s)
    return "" if factor is None else stretched(1.0 / factor - 1.0)


def explain_stream(
    curve: RotationCurve,
    t_s: FloatArray,
    q_world_sensor: FloatArray,
    shifts_s: tuple[float, float],
    found: Start | None,
) -> str:
    """The same for two streams of orientations, without a gyro; arguments as in `explain`."""
    inverted = _score(coarse_start(curve, t_s, so3.quat_conjugate(q_world_sensor), shifts_s))
    if inverted < min(_CLEAR, BETTER * _score(found)):
        return (
            "its orientations or the reference's are inverted: the world's in the sensor, not the sensor's "
            "in the world (with the inverses the rotations fit)"
        )
    factor = estimate_clock_rate(curve, t_s, q_world_sensor, shifts_s)
    return "" if factor is None else stretched(1.0 / factor - 1.0, "sensor", "reference")


def _score(start: Start | None) -> float:
    """How badly a start fits: misfit over size of the turns; infinite where it is none."""
    if start is None or start.mirrored or start.agreement < 0.3:
        return float("inf")
    return start.misfit_share


def stretched(rate: float, sensor: str = "camera", reference: str = "IMU") -> str:
    """Words for a delay that grows by `rate` seconds a second."""
    excess = 1.0 / (1.0 + rate) - 1.0
    size = f"{100 * abs(excess):.1f} %" if abs(excess) >= 2e-3 else f"{1e6 * abs(excess):.0f} ppm"
    return (
        f"the stamps of {sensor} and {reference} advance at different rates: the {sensor}'s are {size} too "
        f"{'fast' if excess > 0 else 'slow'} for the {reference}'s (or those the other way round); the "
        "rotations fit once that is taken out: look at how the stamps are made (a nominal rate, a "
        "wrong tick length?)"
    )
