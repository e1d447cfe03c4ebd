"""A simulated recording as an ASL folder, with its target file and what is known of lens and imu."""

from __future__ import annotations

from pathlib import Path

from vical_mocks.points import SimulatedRun

TARGET = """\
target_type: checkerboard
targetCols: 8
targetRows: 6
rowSpacingMeters: 0.05
colSpacingMeters: 0.05
"""


def write_asl(folder: Path, run: SimulatedRun, later_s: float = 0.0) -> Path:
    """Write imu readings, corners, `target.yaml` (board of `board_points`) and `initial.yaml`.

    Args:
        folder: Is created.
        run: Of the board of `board_points`.
        later_s: Added to all stamps, s.
    """
    later_ns = round(later_s * 1e9)
    for part in ("imu0", "cam0"):
        (folder / "mav0" / part).mkdir(parents=True)
    lines = ["#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z"]
    for t_ns, gyro, force in zip(
        run.t_imu_ns.tolist(), run.gyro_rps.tolist(), run.specific_force_mps2.tolist(), strict=True
    ):
        lines.append(f"{t_ns + later_ns}," + ",".join(f"{v!r}" for v in (*gyro, *force)))
    (folder / "mav0/imu0/data.csv").write_text("\n".join(lines) + "\n")
    rows = ["#timestamp [ns],point_id,u [px],v [px]"]
    for frame in run.frames:
        for point, (u, v) in zip(frame.ids.tolist(), frame.uv_px.tolist(), strict=True):
            rows.append(f"{frame.t_cam_ns + later_ns},{point},{u!r},{v!r}")
    (folder / "mav0/cam0/corners.csv").write_text("\n".join(rows) + "\n")
    (folder / "target.yaml").write_text(TARGET)
    lens, noise = run.rig.lens, run.rig.densities
    (folder / "initial.yaml").write_text(
        f"cam0:\n  resolution: {list(lens.resolution)}\n  camera_model: pinhole\n"
        f"  distortion_model: {lens.model}\n  intrinsics: {list(lens.intrinsics)}\n"
        f"  distortion_coeffs: {list(lens.distortion)}\n"
        f"imu0:\n  rate_hz: {run.options.imu_rate_hz}\n"
        f"  gyroscope_noise_density: {noise.gyro}\n  gyroscope_random_walk: {noise.gyro_walk}\n"
        f"  accelerometer_noise_density: {noise.accel}\n  accelerometer_random_walk: {noise.accel_walk}\n"
    )
    return folder
