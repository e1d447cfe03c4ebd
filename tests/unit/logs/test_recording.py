"""Recordings of every kind give the same messages in the same order; bad ones say what is wrong."""

from __future__ import annotations

import gzip
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from vical_daemon.bus import messages as m
from vical_daemon.estimation.inertial.units import ImuArrays, gyro_scale
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.channel import stamp_of, with_stamp
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.logs.model import Stamped, in_stamp_order
from vical_daemon.logs.summary import summarise_recording

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"
G = 9.80665


def to_mcap(recording, path: Path) -> Path:
    with LogWriter(path) as writer:
        for key, payload in recording.messages():
            writer.write(key, payload, stamp_of(payload))
    return path


def test_asl_folder_is_read_bit_for_bit(asl_folder, a_motion):
    recording = open_recording(asl_folder)
    t_ns, gyro, force = a_motion()
    samples = recording.imu_arrays("imu0")
    assert samples.t_ns.tolist() == t_ns.tolist()
    assert samples.gyro_rps.tobytes() == gyro.tobytes()
    assert samples.specific_force_mps2.tobytes() == force.tobytes()
    frames = list(recording.points_frames("cam0"))
    assert len(frames) == 200
    assert frames[0].uv_px.tobytes() == np.random.default_rng(5).uniform(0, 700, (20, 2)).tobytes()
    assert recording.imu_samples == len(t_ns)
    assert recording.cameras["cam0"].kind == "points"
    assert recording.cameras["cam0"].rate_hz == pytest.approx(20)
    assert recording.duration_s == pytest.approx(11.995)
    assert not recording.warnings


def test_messages_come_in_order_of_their_stamps(asl_folder):
    recording = open_recording(asl_folder)
    messages = list(recording.messages())
    stamps = [stamp_of(payload) for _, payload in messages]
    assert stamps == sorted(stamps)
    assert len(messages) == recording.imu_samples + 200
    assert [key for key, _ in messages[:2]] == ["vical/rig0/imu/imu0", "vical/rig0/camera/cam0/points"]


def test_folder_and_its_mcap_are_the_same(asl_folder, tmp_path):
    folder = open_recording(asl_folder)
    log = open_recording(to_mcap(folder, tmp_path / "a.mcap"))
    assert list(log.messages()) == list(folder.messages())
    for name in ("t_ns", "gyro_rps", "specific_force_mps2"):
        ours, theirs = getattr(folder.imu_arrays("imu0"), name), getattr(log.imu_arrays("imu0"), name)
        assert ours.tobytes() == theirs.tobytes()
    assert [(s.key, s.count, s.rate_hz) for s in log.streams] == [
        (s.key, s.count, s.rate_hz) for s in folder.streams
    ]


@pytest.mark.parametrize("name", ["euroc_imu_april"])
def test_shared_data_and_its_mcap_are_the_same(name, tmp_path):
    if not (SHARED / name).is_dir():
        pytest.skip(f"no {SHARED / name}")
    begin = time.monotonic()
    folder = open_recording(SHARED / name)
    messages = list(folder.messages())
    assert time.monotonic() - begin < 5  # 0.4 s on an idle machine
    assert list(open_recording(to_mcap(folder, tmp_path / "a.mcap")).messages()) == messages


def test_mcap_segments_in_a_folder_are_one_recording(asl_folder, tmp_path):
    folder = open_recording(asl_folder)
    messages = list(folder.messages())
    for i, part in enumerate((messages[:1000], messages[1000:])):
        with LogWriter(tmp_path / f"s_{i}.mcap") as writer:
            for key, payload in part:
                writer.write(key, payload, stamp_of(payload))
    assert list(open_recording(tmp_path).messages()) == messages


def test_cut_mcap_gives_what_is_there_and_warns(asl_folder, tmp_path):
    path = to_mcap(open_recording(asl_folder), tmp_path / "a.mcap")
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) * 2 // 3])
    recording = open_recording(path)
    assert 500 < recording.imu_samples < 2400
    assert any("end is missing" in warning for warning in recording.warnings)


def test_late_messages_are_sorted_in():
    items = [
        Stamped(s, s + late, "k", False, b"") for s, late in ((10, 0), (30, 0), (20, 15), (40, 0), (35, 10))
    ]
    assert len(list(in_stamp_order(items))) == 5
    shuffled = [
        Stamped(int(s), int(s), "k", s % 2 == 0, str(s).encode())
        for s in np.random.default_rng(1).permutation(999)
    ]
    assert [int(item.payload) for item in in_stamp_order(shuffled)] == list(range(999))


def chunk_wise(messages, chunk_s):
    """The messages of each chunk stream by stream; log times as the stamps, or as they are written."""
    begin_ns = min(stamp_of(payload) for _, payload in messages)

    def place(message):
        key, payload = message
        stamp_ns = stamp_of(payload)
        return int((stamp_ns - begin_ns) * 1e-9 / chunk_s), "camera" in key, stamp_ns

    return sorted(messages, key=place)


@pytest.mark.parametrize("chunk_s", [5.0, 1e9], ids=["5 s", "all imu first"])
@pytest.mark.parametrize("as_written", [False, True])
def test_a_log_written_chunk_wise_gives_the_same_order(asl_folder, tmp_path, chunk_s, as_written):
    messages = list(open_recording(asl_folder).messages())
    with LogWriter(tmp_path / "log.mcap") as writer:
        for n, (key, payload) in enumerate(chunk_wise(messages, chunk_s)):
            writer.write(key, payload, 10**18 + 10_000_000 * n if as_written else stamp_of(payload))
    assert list(open_recording(tmp_path / "log.mcap").messages()) == messages


def test_memory_stays_bounded_when_a_stream_is_far_behind():
    """A camera whose clock is a day behind does not make the imu wait for ever."""

    def items():
        for i in range(5000):
            yield Stamped(10**17 + i * 10**7, i * 10**7, "imu", True, b"")
            yield Stamped(i * 10**7, i * 10**7, "cam", False, b"")

    seen = 0
    order = in_stamp_order(items())
    for item in order:
        seen += item.key == "cam"
        if seen > 1000:
            break
    assert seen > 1000


def imu_ros(store, stamp_ns, gyro, force):
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    extra = {"seq": 0} if "seq" in t["std_msgs/msg/Header"].__dataclass_fields__ else {}
    vector, z = t["geometry_msgs/msg/Vector3"], np.zeros(9)
    return t["sensor_msgs/msg/Imu"](
        header=t["std_msgs/msg/Header"](stamp=stamp, frame_id="imu4", **extra),
        orientation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=z, angular_velocity=vector(*gyro), angular_velocity_covariance=z,
        linear_acceleration=vector(*force), linear_acceleration_covariance=z,
    )  # fmt: skip


def image_ros(store, stamp_ns, pixels):
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    extra = {"seq": 0} if "seq" in t["std_msgs/msg/Header"].__dataclass_fields__ else {}
    header = t["std_msgs/msg/Header"](stamp=stamp, frame_id="cam", **extra)
    return t["sensor_msgs/msg/Image"](
        header=header, height=pixels.shape[0], width=pixels.shape[1], encoding="mono8", is_bigendian=0,
        step=pixels.shape[1], data=pixels.ravel(),
    )  # fmt: skip


def write_bag(path: Path, kind: str, a_motion) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    writer = Bag1Writer(path) if kind == "ros1" else Bag2Writer(path, version=9)
    serialise = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    t_ns, gyro, force = a_motion()
    with writer:
        imu = writer.add_connection("/imu/data", "sensor_msgs/msg/Imu", typestore=store)
        camera = writer.add_connection("/left/image_raw", "sensor_msgs/msg/Image", typestore=store)
        other = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        writer.write(
            other,
            int(t_ns[0]),
            serialise(store.types["std_msgs/msg/String"](data="hi"), "std_msgs/msg/String"),
        )
        for i, t in enumerate(t_ns.tolist()):
            message = imu_ros(store, t, gyro[i].tolist(), force[i].tolist())
            writer.write(imu, t + 1000, serialise(message, "sensor_msgs/msg/Imu"))
            if i % 20 == 0:
                pixels = np.full((6, 8), i % 250, np.uint8)
                writer.write(
                    camera, t + 9000, serialise(image_ros(store, t, pixels), "sensor_msgs/msg/Image")
                )
    return path


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_bags_of_ros_are_read(tmp_path, kind, a_motion):
    recording = open_recording(write_bag(tmp_path / ("a.bag" if kind == "ros1" else "bag"), kind, a_motion))
    t_ns, gyro, force = a_motion()
    assert list(recording.imus) == ["imu0"]
    assert list(recording.cameras) == ["left"]
    assert recording.cameras["left"].kind == "image"
    assert recording.cameras["left"].resolution == (8, 6)
    samples = recording.imu_arrays("imu0")
    assert samples.t_ns.tolist() == t_ns.tolist()
    assert samples.gyro_rps.tobytes() == gyro.tobytes()
    assert samples.specific_force_mps2.tobytes() == force.tobytes()
    images = [payload for key, payload in recording.messages() if key == "vical/rig0/camera/left/image"]
    assert m.decode_image(images[3]).pixels().tolist() == np.full((6, 8), 60).tolist()
    topics = {topic.topic: topic for topic in summarise_recording(recording).topics}
    assert topics["/imu/data"].latency_ms == pytest.approx((1e-3, 1e-3))
    assert topics["/left/image_raw"].latency_ms == pytest.approx((9e-3, 9e-3))
    assert topics["/left/image_raw"].count == len(images) and set(topics) == {"/imu/data", "/left/image_raw"}


def test_topics_can_be_chosen(tmp_path, a_motion):
    path = write_bag(tmp_path / "bag", "ros2", a_motion)
    assert [s.kind for s in open_recording(path, topics={"/imu/data"}).streams] == ["imu"]
    assert [s.kind for s in open_recording(path, topics={"imu0", "left"}).streams] == ["imu", "image"]
    with pytest.raises(RecordingError, match="none of the topics"):
        open_recording(path, topics={"/nothing"})
    with pytest.raises(RecordingError, match="no IMU data"):
        open_recording(path, topics={"left"})


def test_images_of_an_asl_folder(tmp_path, a_motion, write_asl):
    folder = write_asl(tmp_path / "a", corners=False)
    camera = folder / "mav0/cam0"
    (camera / "data").mkdir()
    t0 = int(a_motion()[0][0])
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (8).to_bytes(4, "big") + (6).to_bytes(4, "big") + b"rest"
    lines = ["#timestamp [ns],filename"]
    for i in range(100):
        stamp = t0 + i * 10**8
        (camera / "data" / f"{stamp}.png").write_bytes(png + bytes([i]))
        lines.append(f"{stamp},{stamp}.png")
    (camera / "data.csv").write_text("\n".join(lines))
    recording = open_recording(folder)
    assert recording.cameras["cam0"].kind == "compressed"
    assert recording.cameras["cam0"].resolution == (8, 6)
    images = [p for k, p in recording.messages() if k.endswith("compressed")]
    decoded = m.decode_compressed_image(images[7])
    assert (decoded.format, bytes(decoded.data)) == ("png", png + bytes([7]))
    (camera / "data.csv").write_text(f"{t0},../../../../etc/passwd\n")
    with pytest.raises(RecordingError, match="line 1"):
        open_recording(folder)


def test_gzip_and_plain_tables_are_the_same(asl_folder, tmp_path):
    folder = tmp_path / "z"
    shutil.copytree(asl_folder, folder)
    plain = folder / "mav0/cam0/corners.csv"
    (folder / "mav0/cam0/corners.csv.gz").write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()
    assert list(open_recording(folder).messages()) == list(open_recording(asl_folder).messages())
    (folder / "mav0/cam0/corners.csv.gz").write_bytes(b"no gzip")
    with pytest.raises(RecordingError, match="gzip"):
        open_recording(folder)


def one_line(error: pytest.ExceptionInfo) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def bad_imu(tmp_path, change, a_motion, write_asl):
    t_ns, gyro, force = a_motion()
    return write_asl(tmp_path / "bad", imu=change(t_ns, gyro, force))


@pytest.mark.parametrize(("change", "says"), [
    (lambda t, w, f: (t, w, f / G), "looks like g: multiply by 9.80665"),
    (lambda t, w, f: (t, w, f / G * 1000), "looks like mg"),
    (lambda t, w, f: (t, w, f * 0.01), "gravity seems to be removed"),
    (lambda t, w, f: (t, w, f * 5), "check its unit"),
    (lambda t, w, f: (t, np.rad2deg(w), f), "looks like deg/s"),
    (lambda t, w, f: (t, np.deg2rad(w), f), "check its unit"),
    (lambda t, w, f: (t[0] + (t - t[0]) * 40, w, f), "10 Hz and more"),
    (lambda t, w, f: (t[:10], w[:10], f[:10]), "only 10 samples"),
])  # fmt: skip
def test_imu_in_wrong_units_is_refused(tmp_path, change, says, a_motion, write_asl):
    with pytest.raises(RecordingError) as error:
        open_recording(bad_imu(tmp_path, change, a_motion, write_asl))
    assert says in one_line(error)
    assert "imu0" in one_line(error)


@pytest.mark.parametrize(("scale", "says"), [
    (30.0, "1 to 2000 are expected"), (1e-6, "are the stamps nanoseconds"),
])  # fmt: skip
def test_camera_at_a_wrong_rate_is_refused(tmp_path, scale, says, write_asl):
    folder = write_asl(tmp_path / "bad", camera_scale=scale)
    with pytest.raises(RecordingError) as error:
        open_recording(folder)
    assert says in one_line(error)
    assert open_recording(folder, check=False).cameras


def test_of_an_imu_that_stopped_early_what_there_is_is_used(tmp_path, a_motion, write_asl):
    t_ns, gyro, force = a_motion()
    recording = open_recording(write_asl(tmp_path / "a", imu=(t_ns[:800], gyro[:800], force[:800])))
    text = "6.0 s of frames were recorded without IMU samples and are skipped (stamps of the camera span"
    assert any(text in warning for warning in recording.warnings)


def test_camera_of_another_clock_is_refused(tmp_path, write_asl):
    folder = write_asl(tmp_path / "bad")
    table = folder / "mav0/cam0/corners.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()[1:]]
    table.write_text("\n".join(",".join([str(int(r[0]) - 10**15), *r[1:]]) for r in rows))
    with pytest.raises(RecordingError, match="do not overlap"):
        open_recording(folder)


@pytest.mark.parametrize("name", ["euroc_imu_april", "openvins_sim_tum"])
def test_units_of_real_recordings_are_told_apart(name):
    if not (SHARED / name).is_dir():
        pytest.skip(f"no {SHARED / name}")
    recording = open_recording(SHARED / name)
    samples, rate_hz = recording.imu_arrays("imu0"), recording.imus["imu0"].rate_hz
    scale, correlation = gyro_scale(samples, rate_hz)
    assert 0.4 < scale < 1.2
    assert correlation > 0.3
    degrees = ImuArrays(samples.t_ns, np.rad2deg(samples.gyro_rps), samples.specific_force_mps2)
    scale, correlation = gyro_scale(degrees, rate_hz)
    assert 0.4 * np.pi / 180 < scale < 1.2 * np.pi / 180


def test_resting_imu_is_not_accused():
    rng = np.random.default_rng(3)
    t_ns = np.arange(4000, dtype=np.int64) * 5_000_000
    force = np.array([0.0, 0.0, 9.81]) + 0.02 * rng.standard_normal((4000, 3))
    _, correlation = gyro_scale(ImuArrays(t_ns, 0.01 * rng.standard_normal((4000, 3)), force), 200.0)
    assert abs(correlation) < 0.2


@pytest.mark.parametrize(("name", "content", "says"), [
    ("a.mcap", None, "does not exist"),
    ("a.mcap", b"this is text", "is no MCAP file"),
    ("a.mcap", b"", "is empty"),
    ("a.bag", b"this is text", "cannot be read as a bag"),
    ("a.txt", b"this is text", "is no recording"),
])  # fmt: skip
def test_bad_files_say_what_is_wrong(tmp_path, name, content, says):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError) as error:
        open_recording(path)
    assert says in one_line(error)


def test_mcap_without_sensors_says_what_it_holds(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as writer:
        writer.write("vical/rig0/command/record", m.encode_string("stop"), 1)
    with pytest.raises(RecordingError, match=r"found /vical/rig0/command/record \(std_msgs/msg/String\)"):
        open_recording(tmp_path / "a.mcap")


@pytest.mark.parametrize(("row", "says"), [
    ("abc,1,2,3,4,5,6", "expected timestamp"), ("1,2", "expected timestamp"),
    ("1.5e18,1,2,3,4,5,6", "expected timestamp"),
    ("99999999999999999999,1,2,3,4,5,6", "expected timestamp"),
])  # fmt: skip
def test_broken_tables_say_where(tmp_path, row, says, write_asl):
    folder = write_asl(tmp_path / "bad")
    table = folder / "mav0/imu0/data.csv"
    table.write_text(table.read_text() + row + "\n")
    with pytest.raises(RecordingError) as error:
        open_recording(folder)
    assert says in one_line(error)
    assert "data.csv" in one_line(error)


def test_untidy_tables_are_used_with_a_warning(tmp_path, write_asl):
    folder = write_asl(tmp_path / "bad")
    table = folder / "mav0/imu0/data.csv"
    lines = table.read_text().splitlines()
    lines[5], lines[6] = lines[6], lines[5]
    lines.insert(9, lines[9])
    lines.insert(12, lines[12].rsplit(",", 1)[0] + ",nan")
    lines[0] = "timestamp,wx,wy,wz,ax,ay,az"
    del lines[300:310]
    table.write_text("\n".join(lines))
    corners = folder / "mav0/cam0/corners.csv"
    rows = corners.read_text().splitlines()
    corners.write_text("\n".join([*rows, rows[-1]]))
    said = " | ".join(open_recording(folder).warnings)
    for part in ("not in order", "repeated stamp", "not finite", "missing in 1 holes", "seen twice"):
        assert part in said


def test_empty_folder_says_what_is_expected(tmp_path):
    with pytest.raises(RecordingError, match="is no ASL folder"):
        open_recording(tmp_path)


def test_junk_on_the_imu_topic_of_a_log_is_left_out(asl_folder, tmp_path):
    folder = open_recording(asl_folder)
    with LogWriter(tmp_path / "a.mcap") as writer:
        for i, (key, payload) in enumerate(folder.messages()):
            writer.write(key, payload, stamp_of(payload))
            if i % 100 == 0 and "/imu/" in key:
                writer.write(key, b"junk", stamp_of(payload))
                writer.write(key, payload[:12] + bytes(400), stamp_of(payload))
    recording = open_recording(tmp_path / "a.mcap")
    assert recording.imu_samples == folder.imu_samples
    assert any("unreadable messages left out" in warning for warning in recording.warnings)


def test_images_in_a_format_that_cannot_be_read_are_named(tmp_path, a_motion):
    t_ns, gyro, force = a_motion(seconds=5.0)
    image = m.encode_image(0, "cam0", np.zeros((6, 8), np.uint8), "mono8")
    with LogWriter(tmp_path / "a.mcap") as writer:
        for t, w, f in zip(t_ns.tolist(), gyro.tolist(), force.tolist(), strict=True):
            writer.write("vical/rig0/imu/imu0", m.encode_imu(t, "imu0", w, f), t)
        for t in t_ns[::5].tolist():
            writer.write("vical/rig0/camera/cam0/image", with_stamp(image, t).replace(b"mono8", b"hsv99"), t)
    recording = open_recording(tmp_path / "a.mcap", check=False)
    assert not recording.cameras
    assert any("(pixel format 'hsv99' is not supported" in warning for warning in recording.warnings)
