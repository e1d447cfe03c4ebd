"""Temporal calibration: the delay between an imu and a camera from the orientations of both (TD-ICP).

Two sensors on one rigid body trace the same curve in the rotation group, one of them late and turned by the
mounting. Registering the curves gives the delay and the mounting from 5 to 10 s of hand motion; neither needs
to be known beforehand, and positions play no part. `t_imu = t_cam + timeshift_cam_imu_s`.

Stages: `rotation_start` (coarse start over several seconds, mounting), `rotation_registration` (closest
points), then `orientation_fit` (joint polish with the covariance of gyro integration). See
docs/math/td_icp.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.temporal.orientation_fit import Fit, OrientationSensor, polish
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.temporal.rotation_registration import Registration, closest_point_registration
from vical_daemon.estimation.temporal.rotation_start import Start, debiased_start
from vical_daemon.estimation.temporal.rotation_suspects import explain
from vical_daemon.estimation.temporal.rotation_turns import without_long_rest
from vical_daemon.estimation.temporal.td_icp_input import (
    TdIcpOptions,
    clean_gyro,
    clean_orientations,
)
from vical_daemon.estimation.temporal.td_icp_refusals import judge, refuse_motion, refuse_start
from vical_daemon.estimation.temporal.td_icp_result import DEGENERATE, OK, REFUSED, TdIcpResult

__all__ = [
    "DEGENERATE",
    "OK",
    "REFUSED",
    "TdIcpOptions",
    "TdIcpResult",
    "td_icp",
]

ENOUGH_S = 5.0  # in less than this any mistake can be made to fit
# noise of one orientation: above which the usual mistakes are tried out, and of a board as it usually is
_DOUBTFUL_RAD, USUAL_RAD = float(np.deg2rad(0.5)), float(np.deg2rad(0.1))


def td_icp(
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    t_cam_s: FloatArray,
    R_world_cam: FloatArray,
    rotation_sigma: float | FloatArray = USUAL_RAD,
    options: TdIcpOptions | None = None,
) -> TdIcpResult:
    """Find delay, mounting and gyro bias from a gyro and camera orientations.

    Args:
        t_imu_s: Stamps of the gyro in its clock, s, shape (m,).
        gyro_rps: Rates in the imu frame, rad/s, shape (m, 3).
        t_cam_s: Stamps of the orientations in the camera's clock (same kind of seconds), shape (n,).
        R_world_cam: Orientations of the camera in any fixed world, shape (n, 3, 3).
        rotation_sigma: Their noise, rad: one number, or (n,), or covariances of the local error (n, 3, 3).
            Only the proportions between orientations matter: the noise is measured.
        options: Settings.

    Returns:
        The result; never raises on data: a refusal says why in `reason`.
    """
    options = options or TdIcpOptions()
    imu = clean_gyro(t_imu_s, gyro_rps)
    cam = clean_orientations(t_cam_s, R_world_cam, rotation_sigma)
    n_given = len(t_cam_s)
    if isinstance(imu, str) or isinstance(cam, str):
        return TdIcpResult(REFUSED, imu if isinstance(imu, str) else str(cam), rejected=n_given)
    base = float(imu[0][0])
    shifts = (options.timeshift_guess_s - options.search_s, options.timeshift_guess_s + options.search_s)
    t_cam, R, covariance, index = cam
    q = so3.quat_from_matrix(R)
    keep = without_long_rest(t_cam, q)
    data = _Data(
        imu[0] - base, imu[1], t_cam[keep] - base, R[keep], covariance[keep], q[keep], index[keep], n_given
    )
    result = _register(data, shifts, options)
    return replace(result, at_rest=int(np.count_nonzero(~keep)))


@dataclass(frozen=True)
class _Data:
    """Cleaned input; stamps from the first gyro sample on."""

    t_imu: FloatArray
    gyro: FloatArray
    t_cam: FloatArray
    R_world_cam: FloatArray
    covariance: FloatArray
    q: FloatArray
    index: npt.NDArray[np.intp]
    n_given: int

    def refused(self, reason: str, *, still: bool = False) -> TdIcpResult:
        return TdIcpResult(REFUSED, reason, rejected=self.n_given, still=still)

    def mistake(self, shifts: tuple[float, float], start: Start | None) -> str:
        """The usual mistake that explains why the rotations do not fit; empty if none, or too few data."""
        if self.t_cam[-1] - self.t_cam[0] < ENOUGH_S:
            return ""
        return explain(self.t_imu, self.gyro, self.t_cam, self.q, shifts, start)


def _register(data: _Data, shifts: tuple[float, float], options: TdIcpOptions) -> TdIcpResult:
    """Start, closest points, polish; or the reason why not."""
    t_cam, q = data.t_cam, data.q
    refusal = refuse_motion(data.t_imu, data.gyro, t_cam, q, options)
    if refusal.reason:
        return data.refused(refusal.reason, still=refusal.still)
    start, bias = debiased_start(data.t_imu, data.gyro, t_cam, q, shifts)
    reason = refuse_start(start, options)
    if start is None or reason:
        return data.refused(data.mistake(shifts, start) or reason)
    curve = GyroCurve.integrate(data.t_imu, data.gyro, bias)
    rough = closest_point_registration(curve, t_cam, q, replace(start, bias_rps=np.zeros(3)))
    try:
        fit = _polish(data, bias, rough, options)
    except np.linalg.LinAlgError:
        result = data.refused("the orientations do not fit the gyro at any delay")
    else:
        result = _result(fit, rough, (data.t_imu[0], data.t_imu[-1]), data.index, data.n_given)
    uneven = abs(result.stamp_rate) > 3.0 * result.stamp_rate_sigma and result.status == DEGENERATE
    if result.camera_noise_rad < _DOUBTFUL_RAD and not uneven:
        return result
    reason = data.mistake(shifts, start)
    return data.refused(reason) if reason else result


def _polish(data: _Data, bias: FloatArray, rough: Registration, options: TdIcpOptions) -> Fit:
    sensor = OrientationSensor(
        t_s=data.t_cam,
        R_world_sensor=data.R_world_cam,
        covariance=data.covariance,
        timeshift_s=rough.timeshift_s,
        R_imu_sensor=rough.R_imu_cam,
        R_world_ref=rough.R_world_ref,
        used=rough.weight > 0.2,
    )
    return polish(
        lambda b: GyroCurve.integrate(data.t_imu, data.gyro, b),
        (sensor,),
        bias + rough.bias_rps,
        options,
    )


def _result(
    fit: Fit,
    rough: Registration,
    span_s: tuple[float, float],
    index: npt.NDArray[np.intp],
    n_given: int,
) -> TdIcpResult:
    sensor = fit.sensors[0]
    tau = sensor.t_s + sensor.timeshift_s
    took_part = sensor.used & (tau >= span_s[0]) & (tau <= span_s[1])
    used = np.zeros(n_given, dtype=np.bool_)
    used[index] = took_part
    pairs = int(np.count_nonzero(took_part))
    order = [0, 1, 2, 4, 5, 6, 3]
    covariance = fit.covariance[np.ix_(order, order)]
    status, reason = judge(fit, covariance, pairs, len(tau))
    if status == REFUSED:
        return TdIcpResult(REFUSED, reason, rejected=n_given)
    return TdIcpResult(
        status=status,
        reason=reason,
        timeshift_cam_imu_s=sensor.timeshift_s,
        timeshift_sigma_s=float(np.sqrt(covariance[6, 6])),
        R_imu_cam=sensor.R_imu_sensor,
        rotation_sigma_rad=np.sqrt(np.diagonal(covariance)[:3]),
        covariance=covariance,
        gyro_bias_rps=fit.bias_rps,
        pairs=pairs,
        rejected=n_given - pairs,
        iterations=rough.iterations + fit.rounds,
        camera_noise_rad=sensor.noise_rad,
        used=used,
        stamp_rate=float(fit.stamp_rate[0]),
        stamp_rate_sigma=float(fit.stamp_rate_sigma[0]),
        widened=float(fit.widened[0].max()),
        sensor=sensor,
    )
