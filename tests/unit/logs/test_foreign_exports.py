"""Exports of other programs, with their own names of columns: PX4, ArduPilot, Xsens, phones, ROS 2, dates."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime

import numpy as np
import pytest

from vical_daemon.logs import RecordingError, open_recording


def readings(asl_folder):
    """Rows of stamp (int, ns), rates and forces, as text."""
    lines = (asl_folder / "mav0/imu0/data.csv").read_text().splitlines()[1:]
    rows = [line.split(",") for line in lines]
    return [(int(row[0]), ",".join(row[1:4]), ",".join(row[4:7])) for row in rows]


def folder_with(asl_folder, path, name, lines):
    """The camera of a folder next to another table, of the same clock."""
    folder = shutil.copytree(asl_folder, path / "asl") / "mav0"
    shutil.rmtree(folder / "imu0")
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder


def px4(rows):
    """`ulog2csv` of sensor_combined, us."""
    yield (
        "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt,accelerometer_timestamp_relative,"
        "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2],accelerometer_integral_dt"
    )
    for t_ns, w, f in rows:
        yield f"{t_ns // 1000},{w},5000,0,{f},5000"


def ardupilot(rows):
    """`mavlogdump.py --format csv --types IMU`, s."""
    yield "timestamp,TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    for k, (t_ns, w, f) in enumerate(rows):
        yield f"{t_ns / 1e9:.6f},{k * 5000},0,{w},{f},0,0,35.2,1,1,200,200"


def ros2_echo(rows):
    """`ros2 topic echo --csv` of a sensor_msgs/Imu."""
    nine = ",".join(["0.0"] * 9)
    for t_ns, w, f in rows:
        yield f"{t_ns // 10**9},{t_ns % 10**9},imu_link,0.0,0.0,0.0,1.0,{nine},{w},{nine},{f},{nine}"


def xsens(rows, step_ns):
    """Export of MT Manager (steps of 0.1 ms), or of a DOT (us)."""
    yield from ("// Start Time: Unknown", "// Update Rate: 100.0Hz", "// Firmware Version: 4.0.2")
    names = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,FreeAcc_X,FreeAcc_Y,FreeAcc_Z,Gyr_X,Gyr_Y,Gyr_Z"
    yield names.replace(",", "\t")
    for k, (t_ns, w, f) in enumerate(rows):
        yield f"{k:05d},{round(t_ns / step_ns)},{f},0.1,0.1,0.1,{w}".replace(",", "\t")


TABLES = {
    "PX4": ("imu0.csv", px4, 1e-6),
    "ArduPilot": ("imu0.csv", ardupilot, 1e-6),
    "ros2 topic echo": ("imu0.csv", ros2_echo, 0.0),
    "Xsens MT": ("imu0.txt", lambda rows: xsens(rows, 100_000), 1e-4),
    "Xsens DOT": ("imu0.txt", lambda rows: xsens(rows, 1000), 1e-6),
}


@pytest.mark.parametrize("program", TABLES)
def test_columns_are_found_by_the_names_that_programs_give_them(asl_folder, tmp_path, program):
    expected = open_recording(asl_folder, as_recorded=True).imu_arrays("imu0")
    name, write, step_s = TABLES[program]
    folder = folder_with(asl_folder, tmp_path, name, write(readings(asl_folder)))
    found = open_recording(folder, as_recorded=True).imu_arrays("imu0")
    np.testing.assert_allclose(found.t_ns, expected.t_ns, atol=1e9 * step_s, rtol=0.0)
    np.testing.assert_array_equal(found.gyro_rps, expected.gyro_rps)
    np.testing.assert_array_equal(found.specific_force_mps2, expected.specific_force_mps2)


@pytest.mark.parametrize("epoch_days", [25_569, 719_529])  # 1970 in Excel's and in MATLAB's days
def test_stamps_may_be_days(asl_folder, tmp_path, epoch_days):
    expected = open_recording(asl_folder, as_recorded=True).imu_arrays("imu0")
    rows, day_ns = readings(asl_folder), 86_400 * 10**9
    written = [(f"{t // day_ns + epoch_days}.{t % day_ns * 10**12 // day_ns:012d}", w, f) for t, w, f in rows]
    lines = [",".join(row) for row in written]
    folder = folder_with(asl_folder, tmp_path, "imu0.csv", ["time,gx,gy,gz,ax,ay,az", *lines])
    found = open_recording(folder)
    assert np.abs(found.imu_arrays("imu0").t_ns - expected.t_ns).max() <= 100
    assert any("by their spacing the stamps are days" in text for text in found.warnings)
    few = [",".join((t[:-6], w, f)) for t, w, f in written]  # as a spreadsheet shows them
    (folder / "imu0.csv").write_text("\n".join(["time,gx,gy,gz,ax,ay,az", *few]) + "\n")
    with pytest.raises(RecordingError, match=r"written like \d+\.\d{6}: digits are lost"):
        open_recording(folder)


@pytest.mark.parametrize("step_ns", [100_000, 1000])  # an MTi, a DOT
def test_counters_of_xsens_go_on_where_they_begin_anew(asl_folder, tmp_path, step_ns):
    rows = readings(asl_folder)
    since_ns = np.array([row[0] - rows[0][0] for row in rows])
    late = [
        (t + (2**32 - 5000) * step_ns, w, f) for t, (_, w, f) in zip(since_ns.tolist(), rows, strict=True)
    ]
    lines = [line.split("\t") for line in xsens(late, step_ns)]
    for line in lines[4:]:
        line[1] = str(int(line[1]) % 2**32)
    (tmp_path / "imu0.txt").write_text("\n".join("\t".join(line) for line in lines))
    t_ns = open_recording(tmp_path, as_recorded=True).imu_arrays("imu0").t_ns
    np.testing.assert_allclose(t_ns - t_ns[0], since_ns, atol=step_ns)


def test_rows_that_are_only_counted_need_a_rate(asl_folder, tmp_path):
    names = "PacketCounter,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
    rows = [f"{(65_000 + k) % 2**16:05d},{f},{w}" for k, (_, w, f) in enumerate(readings(asl_folder))]
    above = ["// Start Time: Unknown", "// Update Rate: 200.0Hz"]
    (tmp_path / "imu0.txt").write_text("\n".join([*above, names, *rows]).replace(",", "\t"))
    recording = open_recording(tmp_path, as_recorded=True)
    np.testing.assert_array_equal(recording.imu_arrays("imu0").t_ns, np.arange(len(rows)) * 5_000_000)
    assert any("the 200 Hz named date them" in text for text in recording.warnings)
    (tmp_path / "imu0.txt").write_text("\n".join([names, *rows]).replace(",", "\t"))
    with pytest.raises(RecordingError, match=r"a counter, but no time.* export the time, too"):
        open_recording(tmp_path)


def test_an_empty_column_of_stamps_is_named(asl_folder, tmp_path):
    lines = [line.split("\t") for line in xsens(readings(asl_folder), 1000)]
    for line in lines[4:]:
        line[1] = ""
    empty = ["\t".join(line) for line in lines]
    with pytest.raises(RecordingError, match="its column of stamps has no numbers"):
        open_recording(folder_with(asl_folder, tmp_path, "imu0.txt", empty))


def sensor_logger(rows):
    records = [{"sensor": "Metadata", "version": "3"}]
    for sensor, which in (("Accelerometer", None), ("Gyroscope", 1), ("TotalAcceleration", 2)):
        for row in rows:
            x, y, z = row[which].split(",") if which else ("0.1", "0.1", "0.1")
            times = {"time": str(row[0]), "seconds_elapsed": "0.1"}
            records.append({"sensor": sensor, **times, "z": z, "y": y, "x": x})
    yield json.dumps(records)


def gnss_logger(rows):
    yield "# Header Description:\n#\n# Raw,utcTimeMillis,TimeNanos\n#"
    units = {"Accel": "Mps2", "Gyro": "RadPerSec"}
    for sensor, unit in units.items():
        axes = ",".join(f"Uncal{sensor}{axis}{unit}" for axis in "XYZ")
        biases = ",".join(f"Bias{axis}{unit}" for axis in "XYZ")
        yield f"# Uncal{sensor},utcTimeMillis,elapsedRealtimeNanos,{axes},{biases}\n#"
    for t_ns, w, f in rows:
        yield f"UncalAccel,1690000000000,{t_ns},{f},0,0,0\nRaw,1,2\nUncalGyro,1690000000000,{t_ns},{w},0,0,0"


@pytest.mark.parametrize(
    ("name", "write"), [("Recording.json", sensor_logger), ("gnss_log_2026_01_31.txt", gnss_logger)]
)
def test_records_that_name_their_sensor_are_one_imu(asl_folder, tmp_path, name, write):
    expected = open_recording(asl_folder, as_recorded=True).imu_arrays("imu0")
    recording = open_recording(
        folder_with(asl_folder, tmp_path, name, write(readings(asl_folder))), as_recorded=True
    )
    found = recording.imu_arrays("imu0")
    assert found.t_ns.tolist() == expected.t_ns.tolist()
    np.testing.assert_allclose(found.gyro_rps, expected.gyro_rps, atol=1e-12)
    np.testing.assert_allclose(found.specific_force_mps2, expected.specific_force_mps2, atol=1e-9)


@pytest.mark.parametrize("name", ["Recording.json", "gnss_log.txt"])
def test_records_that_are_cut_off(asl_folder, tmp_path, name):
    write = sensor_logger if name.endswith("json") else gnss_logger
    text = "\n".join(write(readings(asl_folder)))
    folder = folder_with(asl_folder, tmp_path, name, [text[:-40]])
    if name.endswith("json"):
        with pytest.raises(RecordingError, match=r"Recording.json is no whole export of Sensor Logger"):
            open_recording(folder)
    else:
        assert open_recording(folder, as_recorded=True).imus["imu0"].count > 100


def test_a_table_of_realsense_with_three_clocks_is_refused_with_what_to_give(asl_folder, tmp_path):
    title = "Stream Type,F#,HW Timestamp (ms),Backend Timestamp(ms),Host Timestamp(ms),3DOF_x,3DOF_y,3DOF_z"
    lines = ["", "", title, *["Gyro,1,5.000,6.000,7.000,0.1,0.1,0.1"] * 30]
    with pytest.raises(RecordingError, match=r"rs-convert mixes three clocks in it; give the camera's .bag"):
        open_recording(folder_with(asl_folder, tmp_path, "rec_1200_imu_pose.csv", lines))


def dated(asl_folder, path, written, day):
    """A recording with dates of July 2026 in both tables."""
    folder = shutil.copytree(asl_folder, path)
    begin_ns = readings(asl_folder)[0][0]
    first = datetime(2026, 7, day, 12, tzinfo=UTC)
    for table in ("imu0/data.csv", "cam0/corners.csv"):
        title, *rows = (folder / "mav0" / table).read_text().splitlines()
        lines = [title]
        for row in rows:
            stamp, _, rest = row.partition(",")
            t_ns = int(first.timestamp()) * 10**9 + int(stamp) - begin_ns
            at = datetime.fromtimestamp(t_ns // 10**9, tz=UTC)
            lines.append(f"{at.strftime(written)} {at:%H:%M:%S}.{t_ns % 10**9:09d},{rest}")
        (folder / "mav0" / table).write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize(
    ("written", "day"),
    [("%d.%m.%Y", 8), ("%d.%m.%Y", 27), ("%d/%m/%Y", 27), ("%m/%d/%Y", 27), ("%Y/%m/%d", 8)],
)
def test_dates_of_other_countries(asl_folder, tmp_path, written, day):
    found = open_recording(dated(asl_folder, tmp_path / "a", written, day))
    expected = open_recording(dated(asl_folder, tmp_path / "b", "%Y-%m-%d", day))
    assert found.imu_arrays("imu0").t_ns.tolist() == expected.imu_arrays("imu0").t_ns.tolist()


def test_years_of_two_digits_are_shown_as_they_are(asl_folder, tmp_path):
    with pytest.raises(RecordingError, match=r"its stamp is no number: '27.07.26 12:00"):
        open_recording(dated(asl_folder, tmp_path / "a", "%d.%m.%y", 27))


@pytest.mark.parametrize("written", ["%d/%m/%Y", "%m/%d/%Y"])
def test_dates_that_may_mean_two_days_are_refused(asl_folder, tmp_path, written):
    with pytest.raises(RecordingError, match="day or month first\\? nothing shows it; write dates like"):
        open_recording(dated(asl_folder, tmp_path / "a", written, 8))


def test_stamps_after_2038_are_refused_with_what_to_do(asl_folder, tmp_path):
    """`'i' format requires -2147483648 <= number`, it had said, and first while it calibrated."""
    rows = (f"{t_ns + 10**18},{w},{f}" for t_ns, w, f in readings(asl_folder))
    with pytest.raises(
        RecordingError, match=r"imu0.csv: its stamps reach the year 20\d\d, and those of ROS 2 end"
    ):
        open_recording(folder_with(asl_folder, tmp_path, "imu0.csv", rows))
