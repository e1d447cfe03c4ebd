"""Tables of values with sigmas, and the warnings that follow from a result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS, RADTAN
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.euler import euler_deg, euler_sigma_deg

Row = tuple[str, str, str, str]
HEAD = ("quantity", "value", "1 sigma", "unit")


def value(number: float, sigma: float | None) -> tuple[str, str]:
    """Write a value with the number of digits that shows two of its sigma.

    >>> value(12.34567, 0.0123)
    ('12.346', '0.012')
    >>> value(12.34567, None)
    ('12.3457', '')
    """
    if sigma is None or not math.isfinite(sigma) or sigma <= 0.0:
        return f"{number:.6g}", "fixed" if sigma == 0.0 else ""
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), 12)
    return f"{number:.{digits}f}", f"{sigma:.{digits}f}"


def camera_rows(camera: dict[str, Any]) -> list[Row]:
    """Rows for extrinsics and time shift: lever arm in mm, rotation in degrees, shift in ms."""
    pose = camera["T_imu_cam"]
    sigma = np.sqrt(np.maximum(np.diag(np.array(pose["covariance"], dtype=np.float64)), 0.0))
    q = [float(v) for v in pose["q_wxyz"]]
    rows: list[Row] = []
    for i, axis in enumerate("xyz"):
        rows.append((f"lever arm {axis}", *value(1e3 * pose["p_m"][i], 1e3 * sigma[i]), "mm"))
    angles = zip(euler_deg(q), euler_sigma_deg(q, pose["covariance"]), strict=True)
    for name, (angle, spread) in zip(("roll (x)", "pitch (y)", "yaw (z)"), angles, strict=True):
        rows.append((name, *value(angle, spread), "deg"))
    rows.append(("quaternion w x y z", " ".join(f"{v:+.6f}" for v in q), "", ""))
    about = " ".join(f"{s:.4f}" for s in np.degrees(sigma[3:]))
    rows.append(("sigma about cam x y z", about, "", "deg"))
    shift = value(1e3 * camera["timeshift_cam_imu_s"], 1e3 * camera["timeshift_sigma_s"])
    rows.append(("time shift (t_imu - t_cam)", *shift, "ms"))
    if camera.get("readout_s"):
        rows.append(
            ("readout", *value(1e3 * camera["readout_s"], 1e3 * camera.get("readout_sigma_s", 0)), "ms")
        )
    return rows


def lens_rows(camera: dict[str, Any]) -> list[Row]:
    """Rows for intrinsics and distortion."""
    model = camera.get("distortion_model", RADTAN)
    names = COEFFICIENTS[model]
    rows: list[Row] = []
    for key, units, labels in (
        ("intrinsics", "px", ("fx", "fy", "cx", "cy")),
        ("distortion", "", tuple(f"{n} ({model})" for n in names)),
    ):
        sigmas: Sequence[float | None] = camera.get(f"{key}_sigma") or [None] * len(labels)
        for label, number, sigma in zip(labels, camera.get(key, []), sigmas, strict=False):
            rows.append((label, *value(number, sigma), units))
    rows.append(("reprojection RMS", f"{camera['reprojection_rms_px']:.3f}", "", "px"))
    if camera.get("corner_sigma_px"):
        rows.append(("corner noise per axis (measured)", f"{camera['corner_sigma_px']:.3f}", "", "px"))
    return rows


def imu_rows(result: dict[str, Any]) -> list[Row]:
    """Rows for biases, IMU matrices and gravity."""
    imu = result.get("imu") or {}
    rows: list[Row] = []
    for key, label, sigma_key, unit, scale in (
        ("gyro_bias_rps", "gyro bias", "gyro_bias_sigma_rps", "mrad/s", 1e3),
        ("accel_bias_mps2", "accelerometer bias", "accel_bias_sigma_mps2", "mm/s^2", 1e3),
    ):
        sigmas: Sequence[float | None] = imu.get(sigma_key) or [None] * 3
        for axis, number, sigma in zip("xyz", imu.get(key) or [], sigmas, strict=False):
            shown = value(scale * number, None if sigma is None else scale * sigma)
            rows.append((f"{label} {axis}", *shown, unit))
    for key, label in (("gyro_matrix", "gyro"), ("accel_matrix", "accelerometer")):
        matrix = np.array(imu.get(key) or [])
        if matrix.shape == (3, 3):
            scale_ppm = " ".join(f"{1e6 * (matrix[i, i] - 1):+.0f}" for i in range(3))
            rows.append((f"{label} scale x y z", scale_ppm, "", "ppm"))
    gravity = result.get("gravity_world_mps2") or []
    if gravity:
        text = " ".join(f"{g:+.4f}" for g in gravity)
        rows.append(("gravity in the world (target) frame", text, "", "m/s^2"))
    return rows


def warnings_of(result: dict[str, Any]) -> list[str]:
    """Return warnings that apply before this result is used."""
    lines = []
    status = str(result.get("status", ""))
    if status != "converged":
        lines.append(f"The status is {status!r}: {result.get('reason') or 'the filter had not converged'}.")
    for name, camera in (result.get("cameras") or {}).items():
        withheld = camera.get("unobservable") or []
        lines += [f"{name}: not determined by the motion, do not use: {direction}." for direction in withheld]
    free = result.get("mode") == "target_free"
    nis = float(result.get("nis_per_dof") or 0.0)
    if nis > 1.5 and free:
        lines.append(
            f"Stretches of the data differ by {nis:.2f} times the expected variance. The sigmas "
            "include that. Check the lens model, the shutter and the stamps."
        )
    elif nis > 1.5:
        lines.append(
            f"NIS per degree of freedom is {nis:.2f}: the innovations are larger than the filter "
            "expects; the sigmas may be too small. Check the lens model, the board's size and flatness, "
            "and the stamps."
        )
    rejected = float(result.get("rejected_fraction") or 0.0)
    if rejected > 0.05:
        why = "blur, or things that move?" if free else "blur, wrong ids or a wrong board?"
        lines.append(f"{100 * rejected:.1f} % of the measurements were rejected: {why}")
    lines += advice_of(result.get("events") or [])
    if result.get("guidance"):
        lines.append(f"What would help: {result['guidance']}")
    return lines


def advice_of(events: Sequence[dict[str, Any] | str]) -> list[str]:
    """Texts of the events that ask for something to be done, the last of each kind and camera."""
    last = {
        (event["kind"], event.get("camera")): str(event["text"])
        for event in events
        if isinstance(event, dict) and event["kind"] in _ACTIONABLE
    }
    return list(last.values())


_ACTIONABLE = {
    EventKind.FIXED_LENS,
    EventKind.LENS_TERM_MISSING,
    EventKind.STAMP_JITTER,
    EventKind.IMAGES_WANDER,
    EventKind.TIMESHIFT_VARIES,
    EventKind.IMU_NOISE,
    EventKind.IMU_CLIPPED,
    EventKind.IMU_UNITS,
    EventKind.ACCEL_LAG,
    EventKind.TARGET_SIZE,
    EventKind.TARGET_RATIO,
    EventKind.TARGET_SHAPE,
    EventKind.ROLLING_SHUTTER,
    EventKind.CLOCK_DRIFT,
    EventKind.CLOCK_WANDER,
    EventKind.BUMPED,
}


def event_rows(events: Sequence[dict[str, Any] | str]) -> list[tuple[str, str]]:
    """Rows of what was announced: time and text; results of version 0.1.0 have only text."""
    rows = []
    for event in events:
        when = event.get("t_s") if isinstance(event, dict) else None
        text = event if isinstance(event, str) else str(event["text"])
        rows.append(("" if when is None else f"{float(when):.1f}\N{NO-BREAK SPACE}s", text))
    return rows


def held_out_text(checks: Sequence[dict[str, float]], noise: dict[str, float] | None) -> str:
    """Say how well the IMU alone predicted images, and what that means for its stated noise, as HTML."""
    ratio = [float(check["ratio"]) for check in checks]
    rms, median = math.sqrt(sum(ratio) / len(ratio)), math.sqrt(float(np.median(ratio)))
    text = (
        f"The IMU alone predicted {len(ratio)} images 0.3 s ahead, before they were used. The errors are "
        f"{rms:.2f} times (RMS) and {median:.2f} times (median) those expected from the stated noise of IMU "
        "and corners."
    )
    if noise:
        text += (
            f" Stated noise: gyro {noise['gyro_density']:.3g} rad/s/√Hz, accelerometer "
            f"{noise['accel_density']:.3g} m/s²/√Hz; walks {noise['gyro_walk']:.3g} and "
            f"{noise['accel_walk']:.3g}."
        )
    return f"<p>{escape(text)}</p>"


def matrix_text(R: FloatArray, p: FloatArray, name: str) -> str:
    """Write a pose as a 4x4 matrix with its name, as numpy and most other software reads it.

    >>> print(matrix_text(np.eye(3), np.array([0.1, 0, 0]), "T_a_b"))
    T_a_b = [[ 1.00000000,  0.00000000,  0.00000000,  0.10000000],
             [ 0.00000000,  1.00000000,  0.00000000,  0.00000000],
             [ 0.00000000,  0.00000000,  1.00000000,  0.00000000],
             [ 0.00000000,  0.00000000,  0.00000000,  1.00000000]]
    """
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    lines = ["[" + ", ".join(f"{v + 0.0:11.8f}" for v in row) + "]" for row in T]
    head = f"{name} = ["
    return head + (",\n" + " " * len(head)).join(lines) + "]"
