"""Temporal calibration of any number of sensors at once: an imu, cameras, any stream of orientations.

Every sensor is registered against one reference curve (the gyro where there is one, else the stream with the
highest rate); then all are polished together, so that one drift of the reference is shared by all and the
delays between any two sensors come with their covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.significance import CHANGED_SIGMAS
from vical_daemon.estimation.temporal.orientation_fit import Fit, OrientationSensor, polish
from vical_daemon.estimation.temporal.rotation_curves import GyroCurve, OrientationCurve, RotationCurve
from vical_daemon.estimation.temporal.rotation_registration import closest_point_registration
from vical_daemon.estimation.temporal.rotation_start import coarse_start
from vical_daemon.estimation.temporal.rotation_suspects import explain_stream, stretched
from vical_daemon.estimation.temporal.rotation_turns import without_long_rest
from vical_daemon.estimation.temporal.td_icp import USUAL_RAD, td_icp
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions, clean_gyro, clean_orientations
from vical_daemon.estimation.temporal.td_icp_joint_result import JointResult, PairDelay, SensorDelay
from vical_daemon.estimation.temporal.td_icp_refusals import UNEVEN, refuse_start
from vical_daemon.estimation.temporal.td_icp_result import OK, REFUSED

__all__ = [
    "JointResult",
    "OrientationStream",
    "PairDelay",
    "SensorDelay",
    "joint_of_orientations",
    "joint_with_gyro",
]

_MOST = 3000  # orientations in all; more would add minutes and little accuracy


@dataclass(frozen=True)
class OrientationStream:
    """Orientations of one sensor in any fixed world.

    Attributes:
        name: For the report.
        t_s: Stamps in the sensor's clock, s, shape (n,).
        R_world_sensor: Orientations, shape (n, 3, 3).
        rotation_sigma: Their noise: rad, or (n,), or covariances (n, 3, 3); only proportions matter.
    """

    name: str
    t_s: FloatArray
    R_world_sensor: FloatArray
    rotation_sigma: float | FloatArray = USUAL_RAD


def _thinned(streams: Sequence[OrientationStream], most: int = _MOST) -> list[OrientationStream]:
    """Leave out long rest, then every other orientation of the largest stream until all are few enough."""
    out = [_without_rest(s) for s in streams]
    while sum(len(s.t_s) for s in out) > most:
        i = int(np.argmax([len(s.t_s) for s in out]))
        out[i] = _some(out[i], slice(None, None, 2))
    return out


def _some(stream: OrientationStream, index: slice | npt.NDArray[Any]) -> OrientationStream:
    sigma = np.asarray(stream.rotation_sigma)
    return replace(
        stream,
        t_s=stream.t_s[index],
        R_world_sensor=stream.R_world_sensor[index],
        rotation_sigma=stream.rotation_sigma if sigma.ndim == 0 else sigma[index],
    )


def _without_rest(stream: OrientationStream) -> OrientationStream:
    """The stream without most of its rest, where it mostly rests; as it is where it cannot be used anyway."""
    cleaned = clean_orientations(stream.t_s, stream.R_world_sensor, stream.rotation_sigma)
    if isinstance(cleaned, str):
        return stream
    t, R, _, index = cleaned
    keep = without_long_rest(t, so3.quat_from_matrix(R))
    return stream if keep.all() else _some(stream, index[keep])


def joint_with_gyro(
    name: str,
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    streams: Sequence[OrientationStream],
    options: TdIcpOptions | None = None,
) -> JointResult:
    """Register orientation streams against a gyro, together.

    Args:
        name: Of the gyro.
        t_imu_s: Its stamps, s, shape (m,).
        gyro_rps: Its rates, rad/s, shape (m, 3).
        streams: The others.
        options: As for `td_icp`.
    """
    options = options or TdIcpOptions()
    cleaned = clean_gyro(t_imu_s, gyro_rps)
    if isinstance(cleaned, str):
        return JointResult(REFUSED, cleaned, name)
    base = float(cleaned[0][0])
    t_imu, gyro = cleaned[0] - base, cleaned[1]
    sensors: list[tuple[str, OrientationSensor]] = []
    reasons: list[str] = []
    bias = np.zeros(3)
    for stream in _thinned(streams):
        alone = td_icp(t_imu, gyro, stream.t_s - base, stream.R_world_sensor, stream.rotation_sigma, options)
        if alone.status == REFUSED:
            reasons.append(f"{stream.name}: {alone.reason}")
            continue
        if alone.status != OK:
            reasons.append(f"{stream.name}: {alone.reason}")
        bias = alone.gyro_bias_rps
        if alone.sensor is not None:
            sensors.append((stream.name, alone.sensor))
    return _together(name, sensors, lambda b: GyroCurve.integrate(t_imu, gyro, b), bias, options, reasons)


def joint_of_orientations(
    streams: Sequence[OrientationStream], options: TdIcpOptions | None = None
) -> JointResult:
    """Register orientation streams against the one with the highest rate, without any gyro.

    Args:
        streams: At least two.
        options: As for `td_icp`; those about the gyro have no effect.
    """
    options = options or TdIcpOptions()
    if len(streams) < 2:
        return JointResult(REFUSED, "two sensors at least are needed", streams[0].name if streams else "")
    # the reference is only interpolated: it costs nothing, and thinned it would be interpolated worse
    reference = min(streams, key=lambda s: np.median(np.diff(np.sort(s.t_s))) if len(s.t_s) > 1 else 9.9)
    streams = _thinned([s for s in streams if s is not reference])
    cleaned = clean_orientations(reference.t_s, reference.R_world_sensor, reference.rotation_sigma)
    if isinstance(cleaned, str):
        return JointResult(REFUSED, f"{reference.name}: {cleaned}", reference.name)
    base = float(cleaned[0][0])
    curve = OrientationCurve.interpolate(cleaned[0] - base, so3.quat_from_matrix(cleaned[1]))
    guess, reach = options.timeshift_guess_s, options.search_s
    sensors: list[tuple[str, OrientationSensor]] = []
    reasons: list[str] = []
    for stream in streams:
        other = clean_orientations(stream.t_s - base, stream.R_world_sensor, stream.rotation_sigma)
        if isinstance(other, str):
            reasons.append(f"{stream.name}: {other}")
            continue
        t, R, covariance, _ = other
        q = so3.quat_from_matrix(R)
        start = coarse_start(curve, t, q, (guess - reach, guess + reach))
        reason = refuse_start(start, options)
        if start is None or reason:
            mistake = explain_stream(curve, t, q, (guess - reach, guess + reach), start)
            reasons.append(f"{stream.name}: {mistake or reason}")
            continue
        rough = closest_point_registration(curve, t, q, start)
        sensors.append(
            (
                stream.name,
                OrientationSensor(
                    t, R, covariance, rough.timeshift_s, rough.R_imu_cam, rough.R_world_ref,
                    rough.weight > 0.2,
                ),
            )
        )  # fmt: skip
    return _together(reference.name, sensors, lambda _: curve, np.zeros(3), options, reasons)


def _together(
    reference: str,
    sensors: list[tuple[str, OrientationSensor]],
    make_curve: Callable[[FloatArray], RotationCurve],
    bias: FloatArray,
    options: TdIcpOptions,
    reasons: list[str],
) -> JointResult:
    if not sensors:
        return JointResult(REFUSED, "; ".join(reasons) or "no sensor to register", reference)
    names = [name for name, _ in sensors]
    try:
        fit = polish(make_curve, tuple(sensor for _, sensor in sensors), bias, options)
    except np.linalg.LinAlgError:
        return JointResult(REFUSED, "the orientations do not fit the reference together", reference)
    reasons += _uneven(names, fit, known="".join(reasons))
    S = len(names)
    covariance = fit.covariance[: 4 * S, : 4 * S]
    low, high = make_curve(bias).span_s
    delays = {name: _delay(fit, i, (low, high)) for i, name in enumerate(names)}
    return JointResult(
        OK if not reasons else "degenerate",
        "; ".join(reasons),
        reference,
        delays,
        _pairs(reference, names, fit, covariance),
        names,
        covariance,
        fit.bias_rps,
    )


def _uneven(names: list[str], fit: Fit, known: str) -> list[str]:
    """Sensors whose delay does not stay, unless that has been said."""
    limit = np.maximum(UNEVEN, CHANGED_SIGMAS * fit.stamp_rate_sigma)
    bad = np.flatnonzero(np.abs(fit.stamp_rate) > limit)
    rates = {names[i]: float(fit.stamp_rate[i]) for i in bad if f"{names[i]}: " not in known}
    return [f"{name}: {stretched(rate, 'sensor', 'reference')}" for name, rate in rates.items()]


def _delay(fit: Fit, i: int, span_s: tuple[float, float]) -> SensorDelay:
    sensor = fit.sensors[i]
    variance = np.diagonal(fit.covariance)[4 * i : 4 * i + 4]
    tau = sensor.t_s + sensor.timeshift_s
    pairs = int(np.count_nonzero(sensor.used & (tau >= span_s[0]) & (tau <= span_s[1])))
    return SensorDelay(
        sensor.timeshift_s,
        float(np.sqrt(variance[3])),
        sensor.R_imu_sensor,
        np.sqrt(variance[:3]),
        sensor.noise_rad,
        pairs,
        len(sensor.t_s) - pairs,
        float(fit.widened[i].max()),
    )


def _pairs(reference: str, names: list[str], fit: Fit, covariance: FloatArray) -> list[PairDelay]:
    """All pairs: t_b = t_a + (shift_a - shift_b), the reference's shift being exactly zero."""
    all_names = [reference, *names]
    shift = np.array([0.0, *(s.timeshift_s for s in fit.sensors)])
    P = np.zeros((len(all_names), len(all_names)))
    P[1:, 1:] = covariance[3::4, 3::4]
    return [
        PairDelay(
            a, b, float(shift[i] - shift[j]), float(np.sqrt(max(P[i, i] + P[j, j] - 2.0 * P[i, j], 0.0)))
        )
        for i, a in enumerate(all_names)
        for j, b in enumerate(all_names)
        if i < j
    ]
