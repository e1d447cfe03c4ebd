"""Temporal calibration: the delay between an imu and a camera from the orientations of both (TD-ICP).

Two sensors on one rigid body trace the same curve in the rotation group, one of them late and turned by the
mounting. Registering the curves gives the delay and the mounting from 5 to 10 s of hand motion; neither needs
to be known beforehand, and positions play no part. `t_imu = t_cam + timeshift_cam_imu_s`.

Stages: `rotation_registration` (coarse start over several seconds, mounting, closest points), then
`orientation_fit` (joint polish with the covariance of gyro integration). See docs/math/td_icp.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation import so3
from vical_daemon.estimation.orientation_fit import DriftNoise, Fit, OrientationSensor, polish
from vical_daemon.estimation.rotation_curves import GyroCurve
from vical_daemon.estimation.rotation_registration import (
    Registration,
    Start,
    camera_turns,
    closest_point_registration,
    debiased_start,
)

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

OK = "ok"
DEGENERATE = "degenerate"
REFUSED = "refused"

_DEG = np.pi / 180.0
_MIN_ORIENTATIONS = 12
_MIN_RATE_RPS = 3.0 * _DEG  # slower than this is "not moving"
_SHIFT_LOST_S = 3e-3
_ROTATION_LOST_RAD = 3.0 * _DEG


@dataclass(frozen=True, slots=True)
class TdIcpOptions:
    """Settings; the defaults suit a 3DM-GX3-25 or better.

    Attributes:
        search_s: The shift is looked for within +- this of the guess, s.
        timeshift_guess_s: Middle of the search, s.
        gyro_density: Gyro noise density, rad/s/sqrt(Hz).
        gyro_walk: Gyro bias walk, rad/s^2/sqrt(Hz).
        gyro_log_sigma: How well the density is known (sigma of its logarithm).
        bias_sigma_rps: The bias is expected to lie around zero with this sigma, rad/s.
        stamp_jitter_s: Standard deviation of camera stamps, independent from frame to frame, s.
        estimate_noise: Measure the noises' scales; False: take rotation_sigma and gyro_density as they are.
        gyro_matrix_sigma: Expected size of each scale and misalignment error of the gyro (0.003: 0.3 %); they
            are estimated along with the rest. 0: a perfect gyro.
    """

    search_s: float = 5.0
    timeshift_guess_s: float = 0.0
    gyro_density: float = 5.2e-4
    gyro_walk: float = 2.0e-5
    gyro_log_sigma: float = 0.2
    bias_sigma_rps: float = 0.1
    stamp_jitter_s: float = 0.0
    estimate_noise: bool = True
    gyro_matrix_sigma: float = 0.003


@dataclass(frozen=True)
class TdIcpResult:
    """What registration found.

    Attributes:
        status: "ok"; "degenerate": part of the answer is not determined, `reason` says which; "refused":
            there is no answer, and all numbers are not-a-number.
        reason: Why, in words; empty when ok.
        timeshift_cam_imu_s: t_imu = t_cam + shift, s.
        timeshift_sigma_s: Its standard deviation, s.
        R_imu_cam: Rotation of the camera in the imu frame, shape (3, 3).
        rotation_sigma_rad: Standard deviations of its local (right) error, rad, shape (3,).
        covariance: Of [R_imu_cam (3, local, rad), gyro bias (3, rad/s), shift (s)], shape (7, 7).
        gyro_bias_rps: Bias in the middle of the data, rad/s, shape (3,).
        pairs: Orientations that took part.
        rejected: Orientations refused as outliers or without imu data at their time.
        iterations: Rounds of both iterative phases.
        camera_noise_rad: Measured noise of one orientation, rms per axis, rad.
        gyro_noise_ratio: Measured drift of the gyro over the stated one.
        used: Which of the given orientations took part, shape (n,).
    """

    status: str
    reason: str
    timeshift_cam_imu_s: float = float("nan")
    timeshift_sigma_s: float = float("nan")
    R_imu_cam: FloatArray = field(default_factory=lambda: np.full((3, 3), np.nan))
    rotation_sigma_rad: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    covariance: FloatArray = field(default_factory=lambda: np.full((7, 7), np.nan))
    gyro_bias_rps: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    pairs: int = 0
    rejected: int = 0
    iterations: int = 0
    camera_noise_rad: float = float("nan")
    gyro_noise_ratio: float = float("nan")
    used: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))

    def to_json(self) -> dict[str, object]:
        """Return what `vical td-icp --json` prints."""
        q = so3.quat_from_matrix(self.R_imu_cam) if self.status != REFUSED else np.full(4, np.nan)
        return {
            "status": self.status,
            "reason": self.reason,
            "timeshift_cam_imu_s": _number(self.timeshift_cam_imu_s),
            "timeshift_sigma_s": _number(self.timeshift_sigma_s),
            "R_imu_cam_q_wxyz": [_number(v) for v in q],
            "rotation_sigma_rad": [_number(v) for v in self.rotation_sigma_rad],
            "gyro_bias_rps": [_number(v) for v in self.gyro_bias_rps],
            "pairs": self.pairs,
            "rejected": self.rejected,
            "iterations": self.iterations,
            "camera_noise_rad": _number(self.camera_noise_rad),
        }


def _number(value: float) -> float | None:
    """JSON knows no not-a-number."""
    return float(value) if np.isfinite(value) else None


def world_cam_from_cam_target(
    R_cam_target: FloatArray, covariance: FloatArray | None = None
) -> tuple[FloatArray, FloatArray | None]:
    """Turn target poses as seen by the camera into camera orientations in the world (= target).

    Args:
        R_cam_target: Rotations, shape (n, 3, 3).
        covariance: Of their local (right) errors, rad^2, shape (n, 3, 3), or None.

    Returns:
        R_world_cam (n, 3, 3), and the covariance of its local error (n, 3, 3) or None.
    """
    R_world_cam = np.swapaxes(R_cam_target, 1, 2)
    if covariance is None:
        return R_world_cam, None
    return R_world_cam, R_cam_target @ covariance @ R_world_cam


def td_icp(
    t_imu_s: FloatArray,
    gyro_rps: FloatArray,
    t_cam_s: FloatArray,
    R_world_cam: FloatArray,
    rotation_sigma: float | FloatArray = 0.1 * _DEG,
    options: TdIcpOptions | None = None,
) -> TdIcpResult:
    """Find delay, mounting and gyro bias from a gyro and camera orientations.

    Args:
        t_imu_s: Stamps of the gyro in its clock, s, shape (m,).
        gyro_rps: Rates in the imu frame, rad/s, shape (m, 3).
        t_cam_s: Stamps of the orientations in the camera's clock (same kind of seconds), shape (n,).
        R_world_cam: Orientations of the camera in any fixed world, shape (n, 3, 3).
        rotation_sigma: Their noise, rad: one number, or (n,), or covariances of the local error (n, 3, 3).
            With `estimate_noise` only the proportions between orientations matter.
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
    t_imu, gyro = imu[0] - base, imu[1]
    t_cam, R, covariance, index = cam[0] - base, cam[1], cam[2], cam[3]
    q = so3.quat_from_matrix(R)
    reason = _refuse_motion(t_imu, gyro, t_cam, q, options)
    if reason:
        return TdIcpResult(REFUSED, reason, rejected=n_given)
    guess, reach = options.timeshift_guess_s, options.search_s
    start, bias = debiased_start(t_imu, gyro, t_cam, q, (guess - reach, guess + reach))
    reason = refuse_start(start, t_cam, q, options)
    if reason or start is None:
        return TdIcpResult(REFUSED, reason, rejected=n_given)
    curve = GyroCurve.integrate(t_imu, gyro, bias)
    rough = closest_point_registration(curve, t_cam, q, replace(start, bias_rps=np.zeros(3)))
    try:
        fit = _polish(t_imu, gyro, t_cam, R, covariance, bias, rough, options)
    except np.linalg.LinAlgError:
        return TdIcpResult(REFUSED, "the orientations do not fit the gyro at any delay", rejected=n_given)
    return _result(fit, rough, (t_imu[0], t_imu[-1]), index, n_given)


def clean_gyro(t_s: FloatArray, gyro: FloatArray) -> tuple[FloatArray, FloatArray] | str:
    """Sort, drop what is not a number or stamped twice; a string says why nothing is left."""
    t_s, gyro = np.asarray(t_s, dtype=np.float64), np.asarray(gyro, dtype=np.float64)
    good = np.isfinite(t_s) & np.isfinite(gyro).all(axis=-1) if len(t_s) else np.zeros(0, dtype=bool)
    t_s, gyro = t_s[good], gyro[good]
    if len(t_s) < 2 * _MIN_ORIENTATIONS:
        return f"{len(t_s)} gyro samples: too few"
    order = np.argsort(t_s, kind="stable")
    t_s, gyro = t_s[order], gyro[order]
    keep = np.concatenate(([True], np.diff(t_s) > 1e-6))  # a sample stamped twice adds nothing
    return t_s[keep], gyro[keep]


def clean_orientations(
    t_s: FloatArray, R: FloatArray, rotation_sigma: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.intp]] | str:
    """Sort, drop what is not a number, and bring the noise into the form of covariances.

    Returns:
        Stamps, orientations, covariances, and the index of each in the input; or why nothing is left.
    """
    t_s, R = np.asarray(t_s, dtype=np.float64), np.asarray(R, dtype=np.float64)
    n = len(t_s)
    if n < _MIN_ORIENTATIONS:
        return f"{n} camera orientations: at least {_MIN_ORIENTATIONS} are needed (is the target in view?)"
    sigma = np.asarray(rotation_sigma, dtype=np.float64)
    if sigma.ndim < 3:
        sigma = (np.broadcast_to(sigma, (n,)) ** 2)[:, None, None] * np.eye(3)
    good = np.flatnonzero(
        np.isfinite(t_s) & np.isfinite(R).all(axis=(1, 2)) & np.isfinite(sigma).all(axis=(1, 2))
    )
    index = good[np.argsort(t_s[good], kind="stable")]
    index = index[np.concatenate(([True], np.diff(t_s[index]) > 1e-6))] if len(index) else index
    if len(index) < _MIN_ORIENTATIONS:
        return f"{len(index)} usable camera orientations: at least {_MIN_ORIENTATIONS} are needed"
    return t_s[index], R[index], sigma[index] + 1e-14 * np.eye(3), index


def _refuse_motion(
    t_imu: FloatArray, gyro: FloatArray, t_cam: FloatArray, q: FloatArray, options: TdIcpOptions
) -> str:
    """Say why the motion cannot be used, from the rotation rates alone; empty if it can."""
    turns = camera_turns(t_cam, q)
    if len(turns.first) < 8:
        return "the camera orientations are too far apart in time: at least 5 a second are needed"
    rate_cam = float(np.median(turns.angle / (t_cam[turns.second] - t_cam[turns.first])))
    reach = options.search_s + abs(options.timeshift_guess_s)
    near = (t_imu > t_cam[0] - reach) & (t_imu < t_cam[-1] + reach)
    if np.count_nonzero(near) < 2 * _MIN_ORIENTATIONS:
        return (
            f"camera and imu do not overlap in time: the camera covers {t_cam[0]:.1f} to {t_cam[-1]:.1f} s, "
            f"the imu 0.0 to {t_imu[-1]:.1f} s, more than {reach:.1f} s apart (two clocks?)"
        )
    length = max(1, round(0.2 / float(np.median(np.diff(t_imu)))))
    kernel = np.ones(length) / length
    mean_rate = np.stack([np.convolve(gyro[near, i], kernel, mode="valid") for i in range(3)], axis=1)
    rate_imu = float(np.median(np.linalg.norm(mean_rate, axis=1)))
    swing = float(np.median(np.linalg.norm(mean_rate - np.median(mean_rate, axis=0), axis=1)))
    ratio = rate_imu / max(rate_cam, 1e-9)
    if rate_cam < _MIN_RATE_RPS and swing < _MIN_RATE_RPS:
        return (
            f"no motion: the camera turns at {rate_cam / _DEG:.1f} deg/s (median); "
            "turn the rig to and fro about all axes at 20 to 60 deg/s"
        )
    if rate_cam < _MIN_RATE_RPS and swing > 5.0 * _MIN_RATE_RPS:
        return "the imu turns but the camera does not: is the camera fixed to the imu, are its poses fresh?"
    if 35.0 < ratio < 95.0:
        return (
            f"the gyro's rates are {ratio:.1f} times the camera's: they look like degrees per second "
            "(factor 57.3); convert them to rad/s"
        )
    if 1 / 95.0 < ratio < 1 / 35.0:
        return (
            f"the gyro's rates are {1 / ratio:.1f} times smaller than the camera's: they look as if divided "
            "by 57.3 once too often; they must be in rad/s"
        )
    return ""


def refuse_start(start: Start | None, t_cam: FloatArray, q: FloatArray, options: TdIcpOptions) -> str:
    """Say why no start was found; empty if there is one."""
    reach = f"within {options.search_s:g} s of {options.timeshift_guess_s:g} s"
    if start is None:
        return f"no delay {reach} makes the rotations of camera and gyro agree (not the same recording?)"
    turns = camera_turns(t_cam, q)
    typical = float(np.median(turns.angle))
    if start.mirrored:
        return (
            "the rotations agree in size but are mirrored: one gyro axis has the wrong sign, or two axes are "
            "swapped; the imu frame must be right-handed"
        )
    if start.agreement < 0.3:
        return (
            f"no delay {reach} makes the rotations of camera and gyro agree in size "
            f"(best: {100 * start.agreement:.0f} % of the turns at {start.timeshift_s:+.2f} s)"
        )
    if start.misfit_rad > max(0.5 * typical, 0.01):
        return (
            "the rotations agree in size but not in direction: are the orientations of the camera inverted "
            "(world in camera instead of camera in world), or gyro axes mixed up?"
        )
    return ""


def _polish(
    t_imu: FloatArray,
    gyro: FloatArray,
    t_cam: FloatArray,
    R_world_cam: FloatArray,
    covariance: FloatArray,
    bias: FloatArray,
    rough: Registration,
    options: TdIcpOptions,
) -> Fit:
    sensor = OrientationSensor(
        t_s=t_cam,
        R_world_sensor=R_world_cam,
        covariance=covariance,
        timeshift_s=rough.timeshift_s,
        R_imu_sensor=rough.R_imu_cam,
        R_world_ref=rough.R_world_ref,
        used=rough.weight > 0.2,
        jitter_s=options.stamp_jitter_s,
    )
    noise = DriftNoise(
        options.gyro_density,
        options.gyro_walk,
        options.bias_sigma_rps,
        options.gyro_log_sigma,
        options.estimate_noise,
        options.gyro_matrix_sigma,
    )
    return polish(lambda b: GyroCurve.integrate(t_imu, gyro, b), (sensor,), bias + rough.bias_rps, noise)


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
    noise = float(np.exp(sensor.log_scale) * np.sqrt(np.trace(sensor.covariance.mean(axis=0)) / 3.0))
    status, reason = _judge(sensor, covariance, pairs, len(tau), noise)
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
        camera_noise_rad=noise,
        gyro_noise_ratio=float(np.exp(fit.log_gyro_scale)),
        used=used,
    )


def _judge(
    sensor: OrientationSensor, covariance: FloatArray, pairs: int, n: int, noise: float
) -> tuple[str, str]:
    """Status and reason from the final covariance and residuals."""
    if pairs < max(_MIN_ORIENTATIONS, 0.25 * n):
        return REFUSED, f"only {pairs} of {n} orientations fit the gyro at the best delay"
    if noise > 3.0 * _DEG:
        return REFUSED, f"gyro and camera disagree by {noise / _DEG:.1f} deg (rms) at the best delay"
    reasons = []
    if covariance[6, 6] > _SHIFT_LOST_S**2:
        reasons.append(
            f"the delay is not determined (sigma {1e3 * np.sqrt(covariance[6, 6]):.1f} ms): "
            "the rotation rate hardly changed; turn to and fro"
        )
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    if values[2] > _ROTATION_LOST_RAD**2:
        axis = sensor.R_imu_sensor @ vectors[:, 2]
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        words = " ".join(f"{a:+.2f}" for a in axis)
        reasons.append(
            f"the mounting about the axis ({words}) of the imu is not determined "
            f"(sigma {np.sqrt(values[2]) / _DEG:.0f} deg): the motion turned about this axis only; "
            "turn about another"
        )
    return (DEGENERATE if reasons else OK), "; ".join(reasons)
