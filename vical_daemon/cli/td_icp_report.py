"""What `vical td-icp` prints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vical_daemon.estimation.temporal.delay_windows import DelayReport
    from vical_daemon.estimation.temporal.td_icp_result import JointResult, TdIcpResult
    from vical_daemon.offline.td_icp.sources import LensUsed


def report_json(report: DelayReport) -> dict[str, Any]:
    """One window of `--watch`."""
    return {
        "t_s": report.t_s,
        "timeshift_s": report.timeshift_s,
        "timeshift_sigma_s": report.timeshift_sigma_s,
        "drift_ppm": 1e6 * report.drift,
        "drift_sigma_ppm": 1e6 * report.drift_sigma,
        "jumped": report.jumped,
        "window_s": report.window.timeshift_cam_imu_s,
        "window_sigma_s": report.window.timeshift_sigma_s,
    }


def print_single(
    imu: str, camera: str, result: TdIcpResult, used: LensUsed, watch: list[dict[str, Any]]
) -> None:
    """One imu and one camera, for people."""
    import numpy as np

    from vical_daemon.estimation.geometry.so3 import quat_from_matrix

    q = quat_from_matrix(result.R_imu_cam)
    sigma_deg, bias = np.rad2deg(result.rotation_sigma_rad), np.rad2deg(result.gyro_bias_rps)
    print(
        f"{camera} against {imu} ({result.status}), {result.pairs} orientations, {result.rejected} rejected"
    )
    print(f"  time shift   {1e3 * result.timeshift_cam_imu_s:+.3f} ± {1e3 * result.timeshift_sigma_s:.3f} ms")
    print("               t_imu = t_cam + shift")
    print(f"  R_imu_cam    q_wxyz = {q[0]:+.5f} {q[1]:+.5f} {q[2]:+.5f} {q[3]:+.5f}")
    print(f"               ± {sigma_deg[0]:.3f} {sigma_deg[1]:.3f} {sigma_deg[2]:.3f} deg")
    print(f"  gyro bias    {bias[0]:+.3f} {bias[1]:+.3f} {bias[2]:+.3f} deg/s")
    print(f"  lens         {lens_line(used)}")
    print(f"               {used.origin}")
    print(f"  noise per orientation  {np.rad2deg(result.camera_noise_rad):.3f} deg")
    if result.widened > 1.0:
        print(f"  sigmas widened {_because(result.widened)}")
    for row in watch:
        jump = "  jumped" if row["jumped"] else ""
        delay = f"{1e3 * row['timeshift_s']:+.3f} ± {1e3 * row['timeshift_sigma_s']:.3f} ms"
        drift = f"{row['drift_ppm']:+.1f} ± {row['drift_sigma_ppm']:.1f} ppm"
        print(f"  {row['t_s']:8.1f} s  {delay}  drift {drift}{jump}")


def lens_line(used: LensUsed) -> str:
    """One line of numbers: px, then the distortion of the model."""
    fx, fy, cx, cy = used.lens.intrinsics
    distortion = " ".join(f"{k:+.4f}" for k in used.lens.distortion)
    return f"fx {fx:.2f} fy {fy:.2f} cx {cx:.2f} cy {cy:.2f} px, {used.lens.distortion_model} {distortion}"


def print_joint(result: JointResult, lenses: dict[str, LensUsed]) -> None:
    """Any number of sensors, for people."""
    import numpy as np

    from vical_daemon.estimation.geometry.so3 import quat_from_matrix

    print(f"reference: {result.reference}   (t_b = t_a + shift)")
    for pair in result.pairs:
        print(
            f"  {pair.a:>12s} -> {pair.b:<12s} {1e3 * pair.timeshift_s:+10.3f} "
            f"± {1e3 * pair.timeshift_sigma_s:.3f} ms"
        )
    for name, sensor in result.sensors.items():
        q = quat_from_matrix(sensor.R_imu_cam)
        sigma = np.rad2deg(sensor.rotation_sigma_rad).max()
        print(
            f"  {name}: R_{result.reference}_{name} q_wxyz = {q[0]:+.5f} {q[1]:+.5f} {q[2]:+.5f} {q[3]:+.5f} "
            f"± {sigma:.3f} deg, {sensor.pairs} orientations, {sensor.rejected} rejected"
        )
        if name in lenses:
            print(f"    lens {lens_line(lenses[name])} ({lenses[name].origin})")
        if sensor.widened > 1.0:
            print(f"    its sigmas widened {_because(sensor.widened)}")


def _because(widened: float) -> str:
    return f"{widened:.1f} times, because stretches of the recording disagree (is the delay constant?)"
