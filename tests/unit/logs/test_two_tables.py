"""Recordings of phones and action cameras: gyro and accelerometer in two tables."""

from __future__ import annotations

import numpy as np
import pytest
from vical_mocks.points import simulate

from vical_daemon.logs import RecordingError, open_recording

GYRO = simulate(1, 8.0, imu_rate_hz=200.0)
ACCEL = simulate(1, 8.0, imu_rate_hz=100.0)
BEGIN_NS = GYRO.options.epoch_ns


def rows(t_ns, values, form):
    return "".join(form(t, *v) + "\n" for t, v in zip(t_ns.tolist(), values.tolist(), strict=True))


def xyzt(t, x, y, z):
    return f"{x!r},{y!r},{z!r},{t}"


def sensor_logger(t, x, y, z):
    return f"{t},{(t - BEGIN_NS) * 1e-9:.7f},{z!r},{y!r},{x!r}"


def seconds(t, x, y, z):
    return f"{t // 10**9}.{t % 10**9:09d},{x!r},{y!r},{z!r}"


def gopro(t, x, y, z):
    return f'{(t - BEGIN_NS) * 1e-6:.6f},"2026-01-01T00:00:00.000Z",{z!r},{x!r},{y!r}'


ROTATED = [2, 0, 1]  # z, x, y: another frame of the same IMU
GOPRO = '"cts","date","Gyroscope [rad/s]","1","2"\n'
LOGGER = "time,seconds_elapsed,z,y,x\n"
PROGRAMS = {
    "Sensor Logger": ("Gyroscope.csv", "TotalAcceleration.csv", LOGGER, sensor_logger),
    "OpenCamera Sensors": ("VID_20260101_gyro.csv", "VID_20260101_accel.csv", "", xyzt),
    "ADVIO": ("gyro.csv", "accelerometer.csv", "", seconds),
    "GoPro": ("GX01_HERO8 Black-GYRO.csv", "GX01_HERO8 Black-ACCL.csv", GOPRO, gopro),
}


def written(folder, gyro, accel, title, form):
    (folder / "cam0").mkdir(parents=True)
    (folder / gyro).write_text(title + rows(GYRO.t_imu_ns, GYRO.gyro_rps, form))
    (folder / accel).write_text(
        title.replace("Gyroscope", "Accelerometer") + rows(ACCEL.t_imu_ns, ACCEL.specific_force_mps2, form)
    )
    return folder


@pytest.mark.parametrize("program", PROGRAMS)
def test_two_tables_are_one_imu(tmp_path, program):
    folder = written(tmp_path / "a", *PROGRAMS[program])
    # of the same app: without gravity, and not calibrated
    for other in ("Accelerometer.csv", "GyroscopeUncalibrated.csv") if program == "Sensor Logger" else ():
        (folder / other).write_text("time,seconds_elapsed,z,y,x\n0,0,0,0,0\n")
    recording = open_recording(folder)
    assert list(recording.imus) == ["imu0"]
    assert any("interpolated to its stamps" in text for text in recording.warnings)
    samples = recording.imu_arrays("imu0")
    within = (GYRO.t_imu_ns >= ACCEL.t_imu_ns[0]) & (GYRO.t_imu_ns <= ACCEL.t_imu_ns[-1])
    axes = ROTATED if program == "GoPro" else [0, 1, 2]
    begin_ns = BEGIN_NS if program == "GoPro" else 0
    assert (samples.t_ns + begin_ns).tolist() == GYRO.t_imu_ns[within].tolist()
    np.testing.assert_array_equal(samples.gyro_rps, GYRO.gyro_rps[within][:, axes])
    off = samples.specific_force_mps2 - GYRO.specific_force_mps2[within][:, axes]
    noise = np.hypot(np.sqrt(100.0), np.sqrt(200.0)) * GYRO.rig.densities.accel
    assert np.sqrt(np.mean(off**2)) < 1.2 * noise


def test_one_table_under_another_name_is_found_by_its_title(tmp_path, write_asl):
    """`gyro_accel.csv` of the MARS logger."""
    folder = write_asl(tmp_path / "a")
    before = open_recording(folder).imu_arrays("imu0")
    _, data = (folder / "mav0/imu0/data.csv").read_text().split("\n", 1)
    (folder / "mav0/imu0/data.csv").unlink()
    title = "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]\n"
    (folder / "mav0/gyro_accel.csv").write_text(title + data)
    recording = open_recording(folder)
    assert "imu0: gyro_accel.csv is read, whose title names all six axes" in recording.warnings
    np.testing.assert_array_equal(recording.imu_arrays("imu0").gyro_rps, before.gyro_rps)


@pytest.mark.parametrize(
    ("title", "scale", "later_s", "says"),
    [
        ("t,x [deg/s],y [deg/s],z [deg/s]\n", 57.3, 0, r"gyro\.csv: its title gives the gyro in degrees"),
        ("", 57.3, 0, "it looks like deg/s: multiply by pi/180"),
        ("", 1.0, 100, r"accelerometer\.csv were not recorded at the same time"),
    ],
)
def test_two_tables_that_cannot_be_used_are_named(tmp_path, title, scale, later_s, says):
    folder = written(tmp_path / "a", *PROGRAMS["ADVIO"])
    t_ns = GYRO.t_imu_ns + later_s * 10**9
    (folder / "gyro.csv").write_text(title + rows(t_ns, scale * GYRO.gyro_rps, seconds))
    with pytest.raises(RecordingError, match=says):
        open_recording(folder)


def test_a_table_of_one_sensor_is_named_as_that(tmp_path):
    folder = written(tmp_path / "a", *PROGRAMS["ADVIO"])
    with pytest.raises(RecordingError, match="in two tables"):
        open_recording(folder / "gyro.csv")
