"""Estimate, sigma and truth side by side, and the verdict of `vical demo`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from vical_drivers.samples import ImuSample, ImuSource

from vical_daemon.acquire.imu import open_imu
from vical_daemon.config.model import ImuConfig
from vical_daemon.estimation.geometry import so3

SIGMAS_ALLOWED = 4.0
_RESTARTED_NS = 20_000_000  # larger: the device's timer was set anew, its ticks no longer tell when


@dataclass(frozen=True, slots=True)
class Comparison:
    """One number and its truth.

    `truth_sigma` is how well the truth itself is one number: how late a busy host stamps changes during
    the run.
    """

    name: str
    unit: str
    estimate: float
    sigma: float
    truth: float
    error: float
    truth_sigma: float = 0.0

    @property
    def sigmas(self) -> float:
        """Error in standard deviations; infinite where a wrong number claims to be exact."""
        if self.sigma > 0:
            return abs(self.error) / math.hypot(self.sigma, self.truth_sigma)
        return 0.0 if abs(self.error) < 1e-12 else math.inf


class StampWitness:
    """Stands between driver and role, and compares each stamp with when the emulator really measured.

    What a time shift relates are the *stamps* of two sensors. How late those of the IMU are on this machine
    (the shortest time from the device to the end of a read, 0.1 to 0.3 ms) is part of the truth that a
    calibration should find; only an emulation knows it.

    Args:
        instant_ns: Device ticks and filter width -> when the gyro measured, CLOCK_MONOTONIC ns.
        filter_samples: Width of the device's moving average.
    """

    def __init__(self, instant_ns: Callable[[int, int], int], filter_samples: int) -> None:
        self._instant_ns, self._filter_samples = instant_ns, filter_samples
        self._errors_ns: list[int] = []

    @property
    def error_s(self) -> float:
        """Median of stamp minus truth, s."""
        return float(np.median(self._errors_ns)) * 1e-9 if self._errors_ns else 0.0

    @property
    def wander_s(self) -> float:
        """How much that changed during the run, one sigma, s."""
        if not self._errors_ns:
            return 0.0
        low, high = np.percentile(self._errors_ns, [16, 84])
        return float(high - low) / 2 * 1e-9

    def open(self, config: ImuConfig) -> ImuSource:
        """Open the real driver and listen to what it gives."""
        source = open_imu(config)
        read = source.read

        def heard(timeout_s: float) -> list[ImuSample]:
            samples = read(timeout_s)
            for sample in samples:
                true_ns = self._instant_ns(sample.device_ticks, self._filter_samples)
                error_ns = sample.t_host_ns - true_ns
                if abs(error_ns) < _RESTARTED_NS:
                    self._errors_ns.append(error_ns)
            return samples

        source.read = heard  # type: ignore[method-assign]
        return source


def truth_of_stamps(
    simulated: dict[str, Any], imu_stamp_error_s: float, wander_s: float, camera: str
) -> dict[str, Any]:
    """Return the truth in the form of a result; the time shift is that between the stamps (see above)."""
    entry = simulated["cameras"][camera]
    simulated_s = entry["timeshift_cam_imu_s"]
    entry = entry | {"timeshift_cam_imu_s": simulated_s + imu_stamp_error_s}
    extra = {
        "simulated_timeshift_s": simulated_s,
        "imu_stamp_error_s": imu_stamp_error_s,
        "imu_stamp_wander_s": wander_s,
    }
    return simulated | {"cameras": {camera: entry}} | extra


def compare(result: dict[str, Any], truth: dict[str, Any], camera: str) -> list[Comparison]:
    """Compare extrinsics and time shift of one camera (both in the form of `vical calibrate --json`).

    The rotation error is local, exp(error) = R_estimate^T R_truth, as its covariance is.
    """
    estimate, true = result["cameras"][camera], truth["cameras"][camera]
    pose, true_pose = estimate["T_imu_cam"], true["T_imu_cam"]
    sigma = np.sqrt(np.maximum(np.diag(np.asarray(pose["covariance"])), 0.0))
    table = [
        Comparison(f"position {axis}", "mm", 1e3 * p, 1e3 * s, 1e3 * t, 1e3 * (p - t))
        for axis, p, s, t in zip("xyz", pose["p_m"], sigma[:3], true_pose["p_m"], strict=True)
    ]
    R_estimate = so3.matrix_from_quat(np.asarray(pose["q_wxyz"]))
    R_truth = so3.matrix_from_quat(np.asarray(true_pose["q_wxyz"]))
    about_deg = np.degrees(so3.log(R_estimate))
    true_deg = np.degrees(so3.log(R_truth))
    error_deg = np.degrees(so3.log(R_truth.T @ R_estimate))
    table += [
        Comparison(f"rotation {axis}", "deg", a, s, t, e)
        for axis, a, s, t, e in zip(
            "xyz", about_deg.tolist(), np.degrees(sigma[3:]).tolist(), true_deg.tolist(), error_deg.tolist(),
            strict=True,
        )
    ]  # fmt: skip
    shift, true_shift = estimate["timeshift_cam_imu_s"], true["timeshift_cam_imu_s"]
    table.append(
        Comparison(
            "time shift", "ms", 1e3 * shift, 1e3 * estimate["timeshift_sigma_s"], 1e3 * true_shift,
            1e3 * (shift - true_shift), 1e3 * truth.get("imu_stamp_wander_s", 0.0),
        )
    )  # fmt: skip
    return table


def as_text(table: list[Comparison]) -> str:
    """Return the table for people."""
    lines = [f"{'':<14}{'estimate':>12}{'sigma':>10}{'truth':>12}{'error':>10}{'error/sigma':>13}"]
    lines += [
        f"{c.name:<14}{c.estimate:>12.3f}{c.sigma:>10.3f}{c.truth:>12.3f}{c.error:>+10.3f}"
        f"{c.sigmas:>13.1f}  {c.unit}"
        for c in table
    ]
    return "\n".join(lines)


def as_json(table: list[Comparison]) -> dict[str, Any]:
    """Return the errors in SI units (m, rad, s) and in sigmas."""
    p, r, shift = table[:3], table[3:6], table[6]
    return {
        "p_m": [c.error * 1e-3 for c in p],
        "r_rad": [math.radians(c.error) for c in r],
        "timeshift_s": shift.error * 1e-3,
        "largest_sigmas": max(c.sigmas for c in table),
    }


def verdict(result: dict[str, Any], table: list[Comparison]) -> str:
    """Return what is wrong with the outcome; empty when it converged and lies within its own 4 sigma."""
    if result["status"] != "converged":
        return f"it did not converge: {result['status']}: {result['reason'] or result['guidance']}"
    outside = [c for c in table if not c.sigmas <= SIGMAS_ALLOWED]
    if outside:
        worst = max(outside, key=lambda c: c.sigmas)
        return f"{worst.name} is {worst.sigmas:.1f} of its own sigmas from the truth"
    return ""
