"""A calibration result in words and columns, for `vical calibrate` and `vical demo`."""

from __future__ import annotations

import math
from typing import Any

from vical_daemon.estimation.wording import digits_that_show
from vical_daemon.results.euler import euler_deg, euler_sigma_deg


def describe(result: dict[str, Any]) -> str:
    """Return the text of a result document (see `vical calibrate --json`)."""
    lines = [_headline(result)]
    for name, camera in result["cameras"].items():
        lines += ["", f"{name} in the imu frame", *_camera_lines(camera)]
    imu = result.get("imu")
    if imu is not None:
        lines += ["", "imu"]
        lines.append(_row("gyro bias", imu["gyro_bias_rps"], imu.get("gyro_bias_sigma_rps"), "rad/s", 6))
        lines.append(
            _row("accelerometer bias", imu["accel_bias_mps2"], imu.get("accel_bias_sigma_mps2"), "m/s^2", 4)
        )
        for key, label in (("gyro_matrix", "gyro matrix"), ("accel_matrix", "accel. matrix")):
            for axis, row in zip("xyz", imu.get(key) or [], strict=False):
                lines.append(_row(f"{label} {axis}", row, None, "", 5))
        for axis, row in zip("xyz", imu.get("accel_positions_m") or [], strict=False):
            lines.append(_row(f"accel. axis {axis} at", [1e3 * r for r in row], None, "mm", 1))
        lines.append(_row("gravity in the world", result["gravity_world_mps2"], None, "m/s^2", 4))
    if result.get("inputs") and "disagreeing" not in result:  # `vical merge` has its own lines
        lines += ["", "recordings"]
        for part in result["inputs"]:
            used = f"{part['frames']} frames" if part["used"] else "not in the result"
            lines.append(
                f"  {part['path']}: {part['duration_s']:.1f} s from {part['begin_s']:.1f} s on, {used}"
            )
    if result.get("events"):
        lines += ["", *(f"  {event['text']}" for event in result["events"])]
    left_out = {name: count for name, count in result.get("left_out", {}).items() if count}
    if left_out:
        counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in left_out.items())
        lines += ["", f"  not used: {counts}"]
    if result.get("guidance"):
        lines += ["", f"  what would help: {result['guidance']}"]
    return "\n".join([*lines, "", f"  {_consistency(result)}"])


def _consistency(result: dict[str, Any]) -> str:
    nis, refused = result["nis_per_dof"], f"{100 * result['rejected_fraction']:.2f} % of the points rejected"
    if _target_free(result):
        return (
            f"stretches of the data differ by {nis:.2f} times the expected variance (1: consistent; "
            f"above 1: the sigmas are inflated), {refused}"
        )
    return f"NIS per degree of freedom {nis:.2f} (1: consistent; below 1: cautious), {refused}"


def _target_free(result: dict[str, Any]) -> bool:
    return result.get("mode") == "target_free"


def _headline(result: dict[str, Any]) -> str:
    reason = f": {result['reason']}" if result["reason"] else ""
    without = "without a target, " if _target_free(result) else ""
    return (
        f"{result['status']}{reason}  ({without}{result['duration_s']:.1f} s, {result['frames']} frames, "
        f"{result['imu_samples']} IMU samples, {result.get('cpu_s', 0.0):.1f} s of CPU)"
    )


def _own_clock_lines(camera: dict[str, Any]) -> list[str]:
    """Say from what a time shift counts where the stamps of a video were moved first."""
    added_s = camera.get("added_to_stamps_s")
    return [] if added_s is None else [f"  {'':<22}t_cam = time in the video + {added_s:.3f} s"]


def _camera_lines(camera: dict[str, Any]) -> list[str]:
    pose = camera["T_imu_cam"]
    sigma = [math.sqrt(max(row[i], 0.0)) for i, row in enumerate(pose["covariance"])]
    angle_sigmas = euler_sigma_deg(pose["q_wxyz"], pose["covariance"])
    shift_ms = 1e3 * camera["timeshift_cam_imu_s"]
    lines = [
        _row("position", [1e3 * p for p in pose["p_m"]], [1e3 * s for s in sigma[:3]], "mm", 2),
        _row("quaternion w x y z", pose["q_wxyz"], None, "", 6),
        _row("roll pitch yaw", list(euler_deg(pose["q_wxyz"])), angle_sigmas, "deg", 3),
        _row("sigma about cam x y z", [math.degrees(s) for s in sigma[3:]], None, "deg", 4),
        _row("time shift", [shift_ms], [1e3 * camera["timeshift_sigma_s"]], "ms", 3)
        + "  (t_imu = t_cam + shift)",
        *_own_clock_lines(camera),
        *_readout_lines(camera),
        _row("fx fy cx cy", camera["intrinsics"], camera["intrinsics_sigma"], "px", 2),
        _row(camera["distortion_model"], camera["distortion"], camera["distortion_sigma"], "", 5),
        f"  {'reprojection rms':<22}{camera['reprojection_rms_px']:.3f} px",
    ]
    lines += [f"  withheld: {what}" for what in camera["unobservable"]]
    return lines


def _readout_lines(camera: dict[str, Any]) -> list[str]:
    """The readout of a rolling shutter, given or found."""
    readout_s, sigma_s = camera.get("readout_s", 0.0), camera.get("readout_sigma_s", 0.0)
    if not (readout_s or sigma_s):
        return []
    what = "column" if camera.get("readout_axis") == "columns" else "row"
    return [_row("readout", [1e3 * readout_s], [1e3 * sigma_s], "ms", 3) + f"  (first {what} to last)"]


def _row(name: str, values: list[float], sigmas: list[float] | None, unit: str, digits: int) -> str:
    if sigmas and any(sigmas):
        pairs = [(v, s, digits_that_show(s, digits)) for v, s in zip(values, sigmas, strict=True)]
        text = "  ".join(f"{v:.{shown}f} ± {s:.{shown}f}" for v, s, shown in pairs)
    else:
        text = "  ".join(f"{v:.{digits}f}" for v in values)
    return f"  {name:<22}{text} {unit}".rstrip()
