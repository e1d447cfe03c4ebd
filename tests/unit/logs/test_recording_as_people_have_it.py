"""Recordings as people have them: broken files, missing images, cut lines, swapped columns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from vical_mocks.harness.asl import write_asl as write_run
from vical_mocks.points import simulate

from vical_daemon.bus.messages import POINTS_TYPE, encode_compressed_image, encode_image, encode_imu
from vical_daemon.bus.messages.schemas import DEFINITIONS
from vical_daemon.config.priors import Initial
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.channel import stamp_of, with_stamp
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.errors import InputError


def test_files_of_another_camera_are_not_looked_at(tmp_path, write_asl):
    folder = write_asl(tmp_path / "a")
    other = folder / "mav0/cam1"
    other.mkdir()
    (other / "corners.csv").write_text("junk\nmore junk\n")
    with pytest.raises(RecordingError, match="cam1"):
        open_recording(folder)
    recording = open_recording(folder, cameras=["cam0"])
    assert list(recording.cameras) == ["cam0"] and list(recording.imus) == ["imu0"]
    with pytest.raises(
        RecordingError, match="cam1"
    ):  # there is no cam7: all are read, so that they can be named
        open_recording(folder, cameras=["cam7"])


def test_a_missing_image_is_left_out_and_counted(tmp_path, a_motion, write_asl):
    folder = write_asl(tmp_path / "a", corners=False)
    camera = folder / "mav0/cam0"
    (camera / "data").mkdir()
    stamps = [int(a_motion()[0][0]) + i * 10**8 for i in range(50)]
    for stamp in stamps:
        (camera / "data" / f"{stamp}.png").write_bytes(b"image")
    (camera / "data.csv").write_text("\n".join(f"{stamp},{stamp}.png" for stamp in stamps))
    (camera / "data" / f"{stamps[7]}.png").unlink()
    recording = open_recording(folder)
    assert recording.cameras["cam0"].count == 49
    assert any(f"1 images listed but not there, first {stamps[7]}.png" in w for w in recording.warnings)
    for stamp in stamps:
        (camera / "data" / f"{stamp}.png").unlink(missing_ok=True)
    with pytest.raises(RecordingError, match="there is no image"):
        open_recording(folder)


@pytest.mark.parametrize("table", ["mav0/imu0/data.csv", "mav0/cam0/corners.csv"])
def test_a_last_line_that_was_cut_off_is_left_out_and_counted(tmp_path, write_asl, table):
    folder = write_asl(tmp_path / "a")
    whole = open_recording(folder)
    path = folder / table
    last = path.read_text().rstrip("\n").splitlines()[-1]
    path.write_text(path.read_text().rstrip("\n") + "\n" + last[: last.index(",") + 3])
    recording = open_recording(folder)
    assert any("cut off; 1 line left out" in w for w in recording.warnings)
    assert [s.count for s in recording.streams] == [s.count for s in whole.streams]
    path.write_text(path.read_text() + "\n" + last + "\n")  # the same line with more behind it is no end
    with pytest.raises(RecordingError, match="expected timestamp"):
        open_recording(folder)


_GYRO_LAST = [0, 4, 5, 6, 1, 2, 3]


@pytest.mark.parametrize(
    ("title", "order"),
    [
        ("#timestamp [ns],a_RS_S_x [m s^-2],a_y,a_z,w_RS_S_x [rad s^-1],w_y,w_z", _GYRO_LAST),
        ("timestamp,accel_x,accel_y,accel_z,gyro_x,gyro_y,gyro_z", _GYRO_LAST),
        ("t,ax,ay,az,wx,wy,wz", _GYRO_LAST),
        ("timestamp,ax,ay,az,gx,gy,gz", _GYRO_LAST),
        ("t,linear_acceleration.x,linear_acceleration.y,linear_acceleration.z,angular_velocity.x,"
         "angular_velocity.y,angular_velocity.z", _GYRO_LAST),
        ("#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z", range(7)),
        ("t,angular_velocity.x,angular_velocity.y,angular_velocity.z,linear_acceleration.x,"
         "linear_acceleration.y,linear_acceleration.z", range(7)),
        ("t,gyro_z,accel_z,gyro_y,accel_y,gyro_x,accel_x", [0, 3, 6, 2, 5, 1, 4]),
    ],
)  # fmt: skip
def test_a_title_that_names_the_axes_is_believed(tmp_path, write_asl, title, order):
    folder = write_asl(tmp_path / "a")
    before = open_recording(folder).imu_arrays("imu0")
    path = folder / "mav0/imu0/data.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    path.write_text("\n".join([title, *(",".join(row[i] for i in order) for row in rows)]) + "\n")
    recording = open_recording(folder)
    after = recording.imu_arrays("imu0")
    assert after.t_ns.tolist() == before.t_ns.tolist()
    assert after.gyro_rps.tolist() == before.gyro_rps.tolist()
    assert after.specific_force_mps2.tolist() == before.specific_force_mps2.tolist()
    assert any("read by their names" in text for text in recording.warnings) == (list(order) != [*range(7)])


@pytest.mark.parametrize(
    ("title", "row"),
    [
        ("id,timestamp,wx,wy,wz,ax,ay,az", "{i},{t},{six}"),
        ("%time,field.header.seq,field.header.stamp,field.header.frame_id,field.orientation.x,"
         "field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z,"
         "field.angular_velocity_covariance0,field.linear_acceleration.x,field.linear_acceleration.y,"
         "field.linear_acceleration.z", "{late},{i},{t},imu,0.5,{w},0,{a}"),
        ("Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id,angular_velocity.x,"
         "angular_velocity.y,angular_velocity.z,linear_acceleration.x,linear_acceleration.y,"
         "linear_acceleration.z", "{late},{i},{s},{ns},imu,{six}"),
    ],
    ids=["counter first", "rostopic echo -p", "bagpy"],
)  # fmt: skip
def test_other_columns_may_stand_between_if_the_title_names_all(tmp_path, write_asl, title, row):
    folder = write_asl(tmp_path / "a")
    before = open_recording(folder).imu_arrays("imu0")
    path = folder / "mav0/imu0/data.csv"
    lines = [title]
    for i, line in enumerate(path.read_text().splitlines()[1:]):
        t, *six = line.split(",")
        cells = {"w": ",".join(six[:3]), "a": ",".join(six[3:]), "six": ",".join(six), "i": i, "t": t}
        s, ns = divmod(int(t), 10**9)
        lines.append(row.format(**cells, late=int(t) + 7_000_000, s=s, ns=ns))
    path.write_text("\n".join(lines) + "\n" + lines[-1][:40])
    recording = open_recording(folder)
    after = recording.imu_arrays("imu0")
    assert after.t_ns.tolist() == before.t_ns.tolist()
    assert after.gyro_rps.tolist() == before.gyro_rps.tolist()
    assert after.specific_force_mps2.tolist() == before.specific_force_mps2.tolist()
    assert any("the last line of data.csv is cut off" in text for text in recording.warnings)


def test_a_gyro_in_degrees_by_its_title_is_refused(tmp_path, write_asl):
    folder = write_asl(tmp_path / "a")
    path = folder / "mav0/imu0/data.csv"
    path.write_text(path.read_text().replace("w_x,w_y,w_z", "w_x [deg s^-1],w_y,w_z"))
    with pytest.raises(RecordingError, match="title gives the gyro in degrees; rad/s are expected"):
        open_recording(folder)


@pytest.mark.parametrize(
    ("before", "says"),
    [
        ("{i},", "are these its columns"),
        ("{t},0.1,0.2,0.3,0.927,", "stands a quaternion: leave the orientations out"),
    ],
)
def test_columns_before_the_gyro_without_a_title_are_named(tmp_path, write_asl, before, says):
    folder = write_asl(tmp_path / "a")
    path = folder / "mav0/imu0/data.csv"
    lines = path.read_text().splitlines()[1:]
    lines = [
        before.format(i=i, t=line.split(",")[0]) + (line if "i" in before else line.split(",", 1)[1])
        for i, line in enumerate(lines)
    ]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError, match=says):
        open_recording(folder)


def test_our_points_in_a_bag_of_ros_1_are_read(tmp_path: Path):
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(DEFINITIONS[POINTS_TYPE], POINTS_TYPE))
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    uv = np.arange(6.0)
    with Bag1Writer(tmp_path / "a.bag") as bag:
        connection = bag.add_connection("/cam0/points", POINTS_TYPE, typestore=store)
        for i in range(5):
            message = store.types[POINTS_TYPE](
                header(seq=i, stamp=stamp(sec=1_700_000_000, nanosec=i * 10**8), frame_id="cam0"),
                640, 480, np.array([4, 5, 6], dtype=np.int64), uv + i, np.zeros(0),
            )  # fmt: skip
            bag.write(connection, 10**18 + i, store.serialize_ros1(message, POINTS_TYPE))
    recording = open_recording(tmp_path / "a.bag", check=False)
    (camera,) = recording.cameras.values()
    assert camera.kind == "points" and camera.resolution == (640, 480)
    frames = list(recording.points_frames(camera.name))
    assert [f.t_cam_ns for f in frames] == [1_700_000_000 * 10**9 + i * 10**8 for i in range(5)]
    assert frames[2].uv_px.ravel().tolist() == (uv + 2).tolist() and frames[2].ids.tolist() == [4, 5, 6]


def _in_unit(path, factor, digits):
    lines = path.read_text().splitlines()
    for i, line in enumerate(lines):
        stamp, comma, rest = line.partition(",")
        if stamp.isdigit():
            whole, part = divmod(int(stamp), factor)
            text = f"{whole}.{part:0{len(str(factor)) - 1}d}"[: len(str(whole)) + 1 + digits].rstrip(".")
            lines[i] = text + comma + rest
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("write", "sigma_s"),
    [
        (str, 0.0),
        (lambda t: str(t // 10**3), 1e-6 / 12**0.5),
        (lambda t: str(t // 10**6), 1e-3 / 12**0.5),
        (lambda t: f"{t * 1e-9:.3f}", 1e-3 / 12**0.5),
        (lambda t: f"{t // 10**9}.{t % 10**9:09d}", 0.0),
        (lambda t: f"{t:.15e}", 1e3 * 1e-9 / 12**0.5),
    ],
)
def test_coarse_stamps_leave_the_time_shift_uncertain(tmp_path, write_asl, write, sigma_s):
    """Steps of a millisecond may move all readings alike: no image can show that."""
    folder = write_asl(tmp_path / "a")
    path = folder / "mav0/imu0/data.csv"
    lines = path.read_text().splitlines()
    for i, line in enumerate(lines):
        stamp, comma, rest = line.partition(",")
        if stamp.isdigit():
            lines[i] = write(int(stamp)) + comma + rest
    path.write_text("\n".join(lines) + "\n")
    recording = open_recording(folder)
    assert recording.stamp_sigma_s.get("imu0", 0.0) == pytest.approx(sigma_s)
    assert any("in steps of 1 ms" in w for w in recording.warnings) == (sigma_s > 1e-4)


@pytest.mark.parametrize(
    ("unit", "factor", "digits"),
    [("seconds", 10**9, 9), ("milliseconds", 10**6, 3), ("microseconds", 10**3, 0)],
)
def test_stamps_in_another_unit_are_recognised_and_reported(tmp_path, write_asl, unit, factor, digits):
    folder = write_asl(tmp_path / "a")
    before = open_recording(folder)
    for table in ("mav0/imu0/data.csv", "mav0/cam0/corners.csv"):
        _in_unit(folder / table, factor, digits)
    after = open_recording(folder)
    for name in ("imu0", "cam0"):
        assert any(w.startswith(f"{name}: by their spacing the stamps are {unit}") for w in after.warnings)
    truth, found = (r.imu_arrays("imu0").t_ns for r in (before, after))
    assert np.abs(found - truth).max() < max(factor // 10**digits, 1)
    assert after.cameras["cam0"].count == before.cameras["cam0"].count
    assert abs(after.cameras["cam0"].rate_hz / before.cameras["cam0"].rate_hz - 1.0) < 1e-3


def test_stamps_of_images_in_seconds_are_recognised(tmp_path, write_asl):
    folder = write_asl(tmp_path / "a", corners=False)
    camera = folder / "mav0/cam0"
    (camera / "data").mkdir()
    names = [f"1600000000.{i:02d}" for i in range(0, 100, 5)]
    for name in names:
        (camera / "data" / f"{name}.png").write_bytes(b"image")
    (camera / "data.csv").write_text("#timestamp [s],filename\n" + "\n".join(f"{n},{n}.png" for n in names))
    recording = open_recording(folder)
    assert recording.cameras["cam0"].rate_hz == pytest.approx(20.0)
    assert any("stamps are seconds" in w for w in recording.warnings)


def test_a_stamp_that_is_no_number_is_named(tmp_path, write_asl):
    folder = write_asl(tmp_path / "a")
    path = folder / "mav0/imu0/data.csv"
    _in_unit(path, 10**9, 9)
    lines = path.read_text().splitlines()
    lines[7] = "soon" + lines[7][lines[7].index(",") :]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError, match="its stamp is no number"):
        open_recording(folder)


def test_dates_of_another_form_are_shown_with_what_to_write(tmp_path, write_asl):
    folder = write_asl(tmp_path / "a")
    path = folder / "mav0/imu0/data.csv"
    title, *rows = path.read_text().splitlines()
    dated = [f"27 Nov 2026 09:00:{k / 100:09.6f}{row[row.index(',') :]}" for k, row in enumerate(rows)]
    path.write_text("\n".join([title, *dated]) + "\n")
    shown = r"row 1 .* no number: '27 Nov 2026 09:00:00.000000'; write dates like 2026-01-31T12:00:00.123"
    with pytest.raises(RecordingError, match=shown):
        open_recording(folder)


def _rewritten(folder, change, table="mav0/imu0/data.csv"):
    """Change the lines of a table; returns the folder."""
    path = folder / table
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    return folder


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:1], "no data below its title"),
        (
            lambda lines: [line.replace(",", " ").replace(".", ",") for line in lines],
            "separated by spaces; write points in the numbers",
        ),
        (lambda lines: [*lines[:40], "hello,world", *lines[40:]], "line 41 is not 7 numbers: 'hello,world'"),
        (lambda lines: [line.rsplit(",", 3)[0] for line in lines], "line 2 is not 7 numbers"),
    ],
)  # fmt: skip
def test_the_line_that_is_wrong_is_named(tmp_path, write_asl, change, message, recwarn):
    folder = _rewritten(write_asl(tmp_path / "a"), change)
    with pytest.raises(RecordingError, match=message):
        open_recording(folder)
    assert not recwarn.list


def test_a_table_that_is_no_plain_text_is_named_as_that(tmp_path, write_asl):
    folder = write_asl(tmp_path / "a")
    path = folder / "mav0/imu0/data.csv"
    path.write_text(path.read_text(), encoding="utf-16-be")  # without the mark that says so
    with pytest.raises(RecordingError, match="not plain text"):
        open_recording(folder)


def test_stamps_that_have_lost_their_digits_are_refused(tmp_path, write_asl):
    def rounded(lines):
        cells = [line.partition(",") for line in lines[1:]]
        return [lines[0], *(f"{float(stamp):.6e},{rest}" for stamp, _, rest in cells)]

    with pytest.raises(RecordingError, match=r"written like 1\.6\d+e\+18: digits are lost"):
        open_recording(_rewritten(write_asl(tmp_path / "a"), rounded))


def test_ids_may_be_written_as_fractions(tmp_path, write_asl):
    def as_floats(lines):
        cells = [line.split(",") for line in lines[1:]]
        return [lines[0], *(f"{t},{float(i)},{u},{v}" for t, i, u, v in cells)]

    table = "mav0/cam0/corners.csv"
    before = list(open_recording(write_asl(tmp_path / "a")).points_frames("cam0"))
    folder = _rewritten(write_asl(tmp_path / "b"), as_floats, table)
    after = list(open_recording(folder).points_frames("cam0"))
    assert [f.ids.tolist() for f in after] == [f.ids.tolist() for f in before]
    _rewritten(folder, lambda lines: [*lines[:-1], lines[-1].replace(".0,", ".5,", 1)], table)
    with pytest.raises(RecordingError, match="a fraction where integers are needed"):
        open_recording(folder)


def test_swapped_columns_without_a_title_are_recognised(tmp_path, write_asl, a_motion):
    t_ns, gyro, force = a_motion()
    folder = write_asl(tmp_path / "a", imu=(t_ns, force, gyro))
    with pytest.raises(RecordingError, match="columns seem to be swapped"):
        open_recording(folder)


def test_gravity_removed_is_not_taken_for_g(tmp_path, write_asl, a_motion):
    t_ns, gyro, force = a_motion()
    rng = np.random.default_rng(11)
    folder = write_asl(tmp_path / "a", imu=(t_ns, gyro, rng.normal(0.0, 0.8, force.shape)))
    with pytest.raises(RecordingError, match="gravity seems to be removed"):
        open_recording(folder)


@pytest.mark.parametrize("seed", [1, 3])
def test_gravity_removed_from_motion_that_never_stops_is_not_taken_for_g(tmp_path, seed):
    """The readings of a rig that is always accelerated may well have the size of 1 g in g."""
    run = simulate(seed, 10.0)
    t_s = (run.t_imu_ns - run.options.epoch_ns) * 1e-9
    moved = run.rig.trajectory
    without = np.einsum("nji,nj->ni", moved.R_world_imu(t_s), moved.a_world_imu(t_s))
    in_g = run.specific_force_mps2 / 9.80665
    for name, force, says in (("a", without, "gravity seems to be removed"), ("b", in_g, "looks like g")):
        folder = write_run(tmp_path / name, replace(run, specific_force_mps2=force))
        with pytest.raises(RecordingError, match=says):
            open_recording(folder)


@pytest.mark.parametrize("kind", ["folder", "log"])
@pytest.mark.parametrize("hz", [200.0, 400.0])
def test_stamps_rounded_to_a_millisecond_leave_the_time_shift_uncertain(tmp_path, hz, kind):
    """A program may write rounded stamps as ns. Evenly spaced ones are as good as the clock behind them."""
    run = simulate(1, 10.0, imu_rate_hz=hz, epoch_ns=10**18)
    ms = 10**6
    rounded = replace(run, t_imu_ns=(run.t_imu_ns + ms // 2) // ms * ms)
    path = write_run(tmp_path / "a", rounded)
    if kind == "log":
        with LogWriter(tmp_path / "a.mcap") as writer:
            for key, payload in open_recording(path, as_recorded=True).messages():
                writer.write(key, payload, stamp_of(payload))
        path = tmp_path / "a.mcap"
    recording = open_recording(path)
    uncertain = hz == 400.0  # 2.5 ms become 2 and 3 ms
    assert any("imu0: stamps are written in steps of 1 ms" in w for w in recording.warnings) == uncertain
    assert recording.stamp_sigma_s.get("imu0", 0.0) == pytest.approx(1e-3 / 12**0.5 if uncertain else 0.0)


def test_an_axis_that_is_not_read_is_named(tmp_path, write_asl, a_motion):
    t_ns, gyro, force = a_motion()
    recording = open_recording(write_asl(tmp_path / "a", imu=(t_ns, gyro * [1.0, 1.0, 0.0], force)))
    assert any("not even noise changes gyro z (always 0)" in warning for warning in recording.warnings)
    with pytest.raises(RecordingError, match=r"the accelerometer never changes.*unite_imu_method"):
        open_recording(write_asl(tmp_path / "b", imu=(t_ns, gyro, 0.0 * force)))


def test_messages_in_another_encoding_are_named(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("foo.Imu", "jsonschema", b"{}")
        channel = writer.register_channel("/imu", "json", schema)
        writer.add_message(channel, 10**18, b"{}", 10**18)
        writer.finish()
    with pytest.raises(RecordingError, match=r"found /imu \(foo\.Imu in json, not CDR\)"):
        open_recording(path)


def test_an_empty_name_is_not_the_present_folder(write_asl, tmp_path, monkeypatch):
    monkeypatch.chdir(write_asl(tmp_path / "a"))
    with pytest.raises(RecordingError, match="the name of the recording is empty"):
        open_recording("")


@pytest.mark.parametrize("undated", [("imu",), ("camera",), ("imu", "camera")])
def test_messages_without_stamps_are_dated_by_the_log(tmp_path, write_asl, undated):
    folder = open_recording(write_asl(tmp_path / "a"))
    with LogWriter(tmp_path / "a.mcap") as writer:
        for key, payload in folder.messages():
            stamp_ns = stamp_of(payload)
            writer.write(key, with_stamp(payload, 0) if key.split("/")[2] in undated else payload, stamp_ns)
    recording = open_recording(tmp_path / "a.mcap")
    assert list(recording.messages()) == list(folder.messages())
    assert sum("have no stamps (header.stamp is 0)" in w for w in recording.warnings) == len(undated)
    assert recording.imu_arrays("imu0").t_ns.tolist() == folder.imu_arrays("imu0").t_ns.tolist()


def test_a_simulation_may_begin_at_zero(tmp_path, write_asl):
    folder = open_recording(write_asl(tmp_path / "a"))
    begin_ns = min(stream.begin_ns for stream in folder.streams)
    with LogWriter(tmp_path / "a.mcap") as writer:
        for key, payload in folder.messages():
            writer.write(key, with_stamp(payload, stamp_of(payload) - begin_ns), stamp_of(payload))
    recording = open_recording(tmp_path / "a.mcap")
    assert min(stream.begin_ns for stream in recording.streams) == 0
    assert not any("no stamps" in w for w in recording.warnings)


@pytest.mark.parametrize("seconds", [False, True])
def test_a_folder_of_kalibr_is_read(tmp_path, write_asl, a_motion, seconds):
    """As `kalibr_bagcreater` takes it: imu0.csv next to cam0/, images named by their stamps."""
    folder = write_asl(tmp_path / "a", corners=False)
    whole = open_recording(folder, check=False)
    (folder / "mav0/imu0/data.csv").rename(folder / "imu0.csv")
    (folder / "mav0/imu0").rmdir()
    images = folder / "cam0"
    images.mkdir()
    for t in a_motion()[0][::10].tolist():
        name = f"{t // 10**9}.{t % 10**9:09d}" if seconds else str(t)
        (images / f"{name}.png").write_bytes(b"image")
    for part in sorted((folder / "mav0").rglob("*"), reverse=True):
        part.rmdir()
    (folder / "mav0").rmdir()
    recording = open_recording(folder)
    assert list(recording.imus) == ["imu0"]
    assert recording.imu_arrays("imu0").gyro_rps.tobytes() == whole.imu_arrays("imu0").gyro_rps.tobytes()
    assert recording.cameras["cam0"].rate_hz == pytest.approx(20.0)


def test_images_that_are_only_numbered_are_named_as_that(tmp_path, write_asl):
    folder = write_asl(tmp_path / "a", corners=False)
    for number in range(5):
        (folder / f"mav0/cam0/{number:06d}.png").write_bytes(b"image")
    with pytest.raises(InputError, match=r"5 images have no stamps: .* names like 000000\.png"):
        make_job(open_recording(folder), Initial(), target=None)


def test_stamps_of_whole_seconds_are_named(tmp_path, write_asl):
    """A driver that fills header.stamp.sec only."""
    with LogWriter(tmp_path / "a.mcap") as writer:
        for key, payload in open_recording(write_asl(tmp_path / "a")).messages():
            stamp_ns = stamp_of(payload)
            writer.write(key, with_stamp(payload, stamp_ns // 10**9 * 10**9), stamp_ns)
    with pytest.raises(RecordingError, match=r"most stamps are equal to others \(12 different ones in 2400"):
        open_recording(tmp_path / "a.mcap")


@pytest.mark.parametrize("colour", [True, False])
def test_images_of_depth_are_known_by_their_holes(tmp_path, a_motion, colour):
    """Named after its sensor only; alone in a log it is taken as a camera."""
    t_ns, gyro, force = a_motion(seconds=3.0)
    gray, depth = np.zeros((60, 80), np.uint8), np.full((60, 80), 700, np.uint16)
    depth[:, :3] = 0
    with LogWriter(tmp_path / "a.mcap") as writer:
        for t, w, f in zip(t_ns.tolist(), gyro.tolist(), force.tolist(), strict=True):
            writer.write("vical/rig0/imu/imu0", encode_imu(t, "imu0", w, f), t)
        for t in t_ns[::10].tolist():
            writer.write("vical/rig0/camera/tof/image", encode_image(t, "tof", depth, "16UC1"), t)
            if colour:
                writer.write("vical/rig0/camera/left/image", encode_image(t, "left", gray, "mono8"), t)
    recording = open_recording(tmp_path / "a.mcap")
    assert list(recording.cameras) == ["left" if colour else "tof"]
    assert [w for w in recording.warnings if "depth" in w] == [
        "/vical/rig0/camera/tof/image: images of depth, left out"
    ] * colour


def test_images_of_depth_are_no_camera(tmp_path, a_motion):
    """A RealSense or a ZED: no board is ever seen in them."""
    t_ns, gyro, force = a_motion(seconds=3.0)
    gray, depth = np.zeros((6, 8), np.uint8), np.full((6, 8), 700, np.uint16)
    flat = encode_image(0, "depth", depth, "16UC1").replace(b"16UC1", b"32FC1")
    packed = encode_compressed_image(0, "depth", "16UC1; compressedDepth", bytes(12))
    with LogWriter(tmp_path / "a.mcap") as writer:
        for t, w, f in zip(t_ns.tolist(), gyro.tolist(), force.tolist(), strict=True):
            writer.write("vical/rig0/imu/imu0", encode_imu(t, "imu0", w, f), t)
        for t in t_ns[::10].tolist():
            writer.write("vical/rig0/camera/color/image", encode_image(t, "color", gray, "mono8"), t)
            writer.write("vical/rig0/camera/thermal/image", encode_image(t, "thermal", depth, "16UC1"), t)
            writer.write("vical/rig0/camera/depth/image", encode_image(t, "depth", depth, "16UC1"), t)
            writer.write("vical/rig0/camera/zed_depth/image", with_stamp(flat, t), t)
            viewer = encode_image(t, "depth", depth, "mono16")
            writer.write("vical/rig0/camera/rs_Depth_0/image", viewer, t)
            writer.write("vical/rig0/camera/packed/image/compressed", with_stamp(packed, t), t)
    recording = open_recording(tmp_path / "a.mcap")
    assert sorted(recording.cameras) == ["color", "thermal"]
    assert sum("images of depth, left out" in w for w in recording.warnings) == 4
