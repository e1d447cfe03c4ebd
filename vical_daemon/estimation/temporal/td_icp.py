"""Temporal calibration: the delay between sensors from their orientations (TD-ICP).

Two sensors on one rigid body trace the same curve in the rotation group, one of them late and turned by the
mounting. Registering the curves gives the delay and the mounting from 5 to 10 s of hand motion; neither needs
to be known beforehand, and positions play no part. `t_imu = t_cam + timeshift_cam_imu_s`.

Stages: `rotation_start` (coarse start over several seconds, mounting), `rotation_registration` (closest
points), then `orientation_fit` (joint polish with the covariance of gyro integration). Of several sensors
each is registered alone, then all are polished together, so that they share one drift of the reference and
the delays between any two come with their covariance. See docs/math/td_icp.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.significance import STRETCH_S
from vical_daemon.estimation.temporal.orientation_fit import Fit, polish
from vical_daemon.estimation.temporal.orientation_problem import OrientationSensor
from vical_daemon.estimation.temporal.rotation_curves import OrientationCurve
from vical_daemon.estimation.temporal.rotation_registration import closest_point_registration
from vical_daemon.estimation.temporal.rotation_start import GyroReference, Reference, StreamReference
from vical_daemon.estimation.temporal.td_icp_input import (
    USUAL_RAD,
    CleanStream,
    OrientationStream,
    TdIcpOptions,
    clean_gyro,
    clean_stream,
)
from vical_daemon.estimation.temporal.td_icp_refusals import explain, judge, refuse_motion, refuse_start
from vical_daemon.estimation.temporal.td_icp_result import (
    DEGENERATE,
    OK,
    REFUSED,
    JointResult,
    TdIcpResult,
    pair_delays,
)

DOUBTFUL_RAD = float(np.deg2rad(0.5))
"""Noise of one orientation above which the usual mistakes are tried out, or a target is said to be too far
away. Targets that fill the image have 0.04 to 0.3 deg (12 random rigs); of four times as far away those with
which a start fails 0.6 to 2 deg (four of 8)."""
_MOST = 3000  # orientations of several sensors in all; more would add minutes and little accuracy


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
        rotation_sigma: Their noise, see `OrientationStream`.
        options: Settings.

    Returns:
        The result; never raises on data: a refusal says why in `reason`.
    """
    gyro = clean_gyro(t_imu_s, gyro_rps)
    if isinstance(gyro, str):
        return TdIcpResult(REFUSED, gyro, rejected=len(t_cam_s))
    base_s = float(gyro[0][0])
    cam = clean_stream(OrientationStream("camera", t_cam_s, R_world_cam, rotation_sigma), base_s)
    if isinstance(cam, str):
        return TdIcpResult(REFUSED, cam, rejected=len(t_cam_s))
    return _register(GyroReference(gyro[0] - base_s, gyro[1]), cam.moving(), options or TdIcpOptions())


def joint_with_gyro(
    name: str,
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    streams: Sequence[OrientationStream],
    options: TdIcpOptions | None = None,
) -> JointResult:
    """Register orientation streams with a gyro, together.

    Args:
        name: Of the gyro.
        t_imu_s: Its stamps, s, shape (m,).
        gyro_rps: Its rates, rad/s, shape (m, 3).
        streams: The others.
        options: As for `td_icp`.
    """
    gyro = clean_gyro(t_imu_s, gyro_rps)
    if isinstance(gyro, str):
        return JointResult(REFUSED, gyro, name)
    base_s = float(gyro[0][0])
    return _joint(name, GyroReference(gyro[0] - base_s, gyro[1]), base_s, streams, options or TdIcpOptions())


def joint_of_orientations(
    streams: Sequence[OrientationStream], options: TdIcpOptions | None = None
) -> JointResult:
    """Register orientation streams with the one of the highest rate, without any gyro.

    Args:
        streams: At least two.
        options: As for `td_icp`; those about the gyro have no effect.
    """
    if len(streams) < 2:
        return JointResult(REFUSED, "two sensors at least are needed", streams[0].name if streams else "")
    # the reference is only interpolated: it costs nothing, and thinned it would be interpolated worse
    fastest = min(streams, key=lambda s: np.median(np.diff(np.sort(s.t_s))) if len(s.t_s) > 1 else np.inf)
    clean = clean_stream(fastest)
    if isinstance(clean, str):
        return JointResult(REFUSED, f"{fastest.name}: {clean}", fastest.name)
    base_s = float(clean.t_s[0])
    reference = StreamReference(OrientationCurve.interpolate(clean.t_s - base_s, clean.q))
    others = [s for s in streams if s is not fastest]
    return _joint(fastest.name, reference, base_s, others, options or TdIcpOptions())


def _register(reference: Reference, data: CleanStream, options: TdIcpOptions) -> TdIcpResult:
    """Register one sensor: start, closest points, polish; or the reason why not."""
    reach = (options.timeshift_guess_s - options.search_s, options.timeshift_guess_s + options.search_s)
    motion = refuse_motion(reference, data.t_s, data.q, options)
    if motion.reason:
        return _refused(data, motion.reason, still=motion.still)
    start, bias = reference.start(data.t_s, data.q, reach)

    def mistake() -> str:
        long = data.t_s[-1] - data.t_s[0] >= STRETCH_S  # in less any mistake can be made to fit
        return explain(reference, data.t_s, data.q, reach, start) if long else ""

    reason = refuse_start(start, options, reference, data.t_s, data.q)
    if start is None or reason:
        return _refused(data, mistake() or reason)
    curve = reference.curve(bias)
    rough = closest_point_registration(curve, data.t_s, data.q, replace(start, bias_rps=np.zeros(3)))
    sensor = OrientationSensor(
        data.t_s, data.R_world_sensor, data.covariance, rough.timeshift_s, rough.R_imu_cam, rough.R_world_ref,
        rough.weight > 0.2,
    )  # fmt: skip
    try:
        fit = polish(reference.curve, (sensor,), bias + rough.bias_rps, options)
        result = _result(fit, 0, reference, data, options, rough.iterations)
        result = _refused(data, result.reason) if result.status == REFUSED else result
    except np.linalg.LinAlgError:
        result = _refused(data, f"the orientations do not fit the {reference.name} at any delay")
    uneven = abs(result.stamp_rate) > 3.0 * result.stamp_rate_sigma and result.status == DEGENERATE
    if result.camera_noise_rad < DOUBTFUL_RAD and not uneven:
        return result
    reason = mistake()
    return _refused(data, reason) if reason else result


def _joint(
    name: str,
    reference: Reference,
    base_s: float,
    streams: Sequence[OrientationStream],
    options: TdIcpOptions,
) -> JointResult:
    """Register each sensor alone, then polish all together with the reference called `name`."""
    cleaned = [(s.name, clean_stream(s, base_s)) for s in streams]
    reasons = {other: data for other, data in cleaned if isinstance(data, str)}
    kept, sensors, bias = [], [], np.zeros(3)
    for data in _thinned([data.moving() for _, data in cleaned if isinstance(data, CleanStream)]):
        alone = _register(reference, data, options)
        if alone.reason:
            reasons[data.name] = alone.reason
        if alone.sensor is not None:
            kept.append(data)
            sensors.append(alone.sensor)
            bias = alone.gyro_bias_rps
    if not sensors:
        return JointResult(REFUSED, _listed(reasons) or "no sensor to register", name)
    try:
        fit = polish(reference.curve, tuple(sensors), bias, options)
    except np.linalg.LinAlgError:
        return JointResult(REFUSED, "the orientations do not fit the reference together", name)
    results = {data.name: _result(fit, i, reference, data, options) for i, data in enumerate(kept)}
    reasons = {other: r.reason for other, r in results.items() if r.reason} | reasons
    names, covariance = list(results), fit.covariance[: 4 * len(kept), : 4 * len(kept)]
    delays = pair_delays([name, *names], [s.timeshift_s for s in fit.sensors], covariance[3::4, 3::4])
    status = DEGENERATE if reasons else OK
    return JointResult(status, _listed(reasons), name, results, delays, names, covariance, fit.bias_rps)


def _listed(reasons: dict[str, str]) -> str:
    return "; ".join(f"{name}: {reason}" for name, reason in reasons.items())


def _thinned(streams: list[CleanStream], most: int = _MOST) -> list[CleanStream]:
    """Leave out every other orientation of the largest stream until all are few enough."""
    out = list(streams)
    while sum(len(s.t_s) for s in out) > most:
        i = int(np.argmax([len(s.t_s) for s in out]))
        out[i] = out[i].thinned()
    return out


def _refused(data: CleanStream, reason: str, *, still: bool = False) -> TdIcpResult:
    return TdIcpResult(REFUSED, reason, rejected=data.n_given, at_rest=data.at_rest, still=still)


def _result(
    fit: Fit, i: int, reference: Reference, data: CleanStream, options: TdIcpOptions, rounds: int = 0
) -> TdIcpResult:
    """What the fit says of sensor `i`, whose orientations are `data`; `rounds` were needed before."""
    sensor, S = fit.sensors[i], len(fit.sensors)
    tau, (low, high) = sensor.t_s + sensor.timeshift_s, reference.span_s
    took_part = sensor.used & (tau >= low) & (tau <= high)
    used = np.zeros(data.n_given, dtype=np.bool_)
    used[data.index] = took_part
    pairs = int(np.count_nonzero(took_part))
    order = [4 * i, 4 * i + 1, 4 * i + 2, 4 * S, 4 * S + 1, 4 * S + 2, 4 * i + 3]
    covariance = fit.covariance[np.ix_(order, order)]
    result = TdIcpResult(
        status=OK,
        reason="",
        timeshift_cam_imu_s=sensor.timeshift_s,
        timeshift_sigma_s=float(np.sqrt(covariance[6, 6])),
        R_imu_cam=sensor.R_imu_sensor,
        rotation_sigma_rad=np.sqrt(np.diagonal(covariance)[:3]),
        covariance=covariance,
        gyro_bias_rps=fit.bias_rps,
        pairs=pairs,
        rejected=data.n_given - pairs,
        at_rest=data.at_rest,
        iterations=rounds + fit.rounds,
        camera_noise_rad=sensor.noise_rad,
        used=used,
        stamp_rate=float(fit.stamp_rate[i]),
        stamp_rate_sigma=float(fit.stamp_rate_sigma[i]),
        widened=float(fit.widened[i].max()),
        sensor=sensor,
    )
    status, reason = judge(result, len(tau), reference, options.lost_s)
    return replace(result, status=status, reason=reason)
