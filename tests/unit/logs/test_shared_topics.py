"""Topics that more than one sensor uses, and messages among others that do not belong to them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from mcap.writer import Writer

from vical_daemon.bus.messages import (
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    IMU_TYPE,
    decode_imu,
    encode_compressed_image,
    encode_image,
    encode_imu,
)
from vical_daemon.config.priors import Initial
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.channel import stamp_of, with_stamp
from vical_daemon.offline.calibration_job import make_job

TURNED = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # another mounting


def write(path, items):
    """Write (stamp, topic, type, payload); two types on one topic are two channels, as in any MCAP."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for stamp_ns, topic, kind, payload in sorted(items, key=lambda item: item[0]):
            if (topic, kind) not in channels:
                schema = writer.register_schema(kind, "ros2msg", b"")
                channels[topic, kind] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic, kind], stamp_ns, payload, stamp_ns)
        writer.finish()
    return path


def imu(motion, frame, *, later_ns=0, turned=None):
    t_ns, gyro, force = motion
    turned = np.eye(3) if turned is None else turned
    rows = zip((t_ns + later_ns).tolist(), (gyro @ turned).tolist(), (force @ turned).tolist(), strict=True)
    return [(t, "/imu/data", IMU_TYPE, encode_imu(t, frame, w, f)) for t, w, f in rows]


def pixels(i, size=(8, 6)):
    return np.full(size[::-1], i % 250, np.uint8)


def raw(motion, *, size=(8, 6), every=10, topic="/cam/image_raw"):
    stamps = motion[0][::every].tolist()
    return [
        (t, topic, IMAGE_TYPE, encode_image(t, "c", pixels(i, size), "mono8")) for i, t in enumerate(stamps)
    ]


def compressed(motion, *, every=10, topic="/cam/image_raw/compressed"):
    out = []
    for i, t in enumerate(motion[0][::every].tolist()):
        data = cv2.imencode(".png", pixels(i))[1].tobytes()
        out.append((t, topic, COMPRESSED_IMAGE_TYPE, encode_compressed_image(t, "c", "png", data)))
    return out


def test_two_imus_on_one_topic_are_told_apart_by_their_frame_ids(tmp_path, a_motion):
    motion = a_motion()
    both = imu(motion, "left") + imu(motion, "right", later_ns=2_000_000, turned=TURNED)
    recording = open_recording(write(tmp_path / "a.mcap", both + raw(motion)))
    assert list(recording.imus) == ["left", "right"]
    assert any("2 devices publish on it in turns" in text for text in recording.warnings)
    for name, turned, later_ns in (("left", np.eye(3), 0), ("right", TURNED, 2_000_000)):
        samples = recording.imu_arrays(name)
        assert samples.t_ns.tolist() == (motion[0] + later_ns).tolist()
        assert samples.gyro_rps.tolist() == (motion[1] @ turned).tolist()
        messages = [decode_imu(payload) for _, payload in recording.messages([recording.imus[name]])]
        assert [row.gyro_rps for row in messages] == [tuple(row) for row in samples.gyro_rps.tolist()]


@pytest.mark.parametrize("every", [1, 3])
def test_two_imus_that_cannot_be_told_apart_are_named(tmp_path, a_motion, every):
    motion = a_motion()
    other = imu(motion, "imu", later_ns=2_000_000, turned=TURNED)[::every]
    with pytest.raises(RecordingError, match=r"imu0: .* as if two IMUs shared one topic"):
        open_recording(write(tmp_path / "a.mcap", imu(motion, "imu") + other + raw(motion)))


def test_a_frame_id_that_changes_once_is_one_imu(tmp_path, a_motion):
    motion = a_motion()
    items = imu(motion, "before")[:900] + imu(motion, "after")[900:]
    recording = open_recording(write(tmp_path / "a.mcap", items + raw(motion)))
    assert [stream.count for stream in recording.imus.values()] == [len(motion[0])]


@pytest.mark.parametrize(("every", "kind"), [(10, "image"), (40, "compressed")])
def test_of_raw_and_compressed_images_one_kind_is_used_and_named(tmp_path, a_motion, every, kind):
    motion = a_motion()
    items = imu(motion, "imu") + raw(motion, every=every) + compressed(motion)
    recording = open_recording(write(tmp_path / "a.mcap", items))
    assert [(s.name, s.kind) for s in recording.cameras.values()] == [("cam", kind)]
    assert any(t.startswith("cam: ") and " is used (" in t and ", not " in t for t in recording.warnings)


def test_raw_and_compressed_images_on_the_same_topic_are_not_mixed(tmp_path, a_motion):
    motion = a_motion()
    images = [
        (a, b)[i % 2]
        for i, (a, b) in enumerate(
            zip(raw(motion, topic="/cam/image"), compressed(motion, topic="/cam/image"), strict=True)
        )
    ]
    recording = open_recording(write(tmp_path / "a.mcap", imu(motion, "imu") + images))
    assert recording.cameras["cam"].count == len(images) // 2
    assert any("/cam/image is used (120 images), not /cam/image (" in t for t in recording.warnings)
    assert len(list(recording.messages([recording.cameras["cam"]]))) == len(images) // 2


def test_the_size_of_most_images_counts(tmp_path, a_motion):
    motion = a_motion()
    images = raw(motion, size=(16, 12))[:3] + raw(motion)[3:]
    recording = open_recording(write(tmp_path / "a.mcap", imu(motion, "imu") + images))
    assert recording.cameras["cam"].resolution == (8, 6)
    assert any("cam: 3 images are not 8 x 6 as 237 are" in text for text in recording.warnings)


def test_a_damaged_first_image_does_not_hide_the_size(tmp_path, a_motion):
    motion = a_motion()
    images = compressed(motion)
    t, topic, kind, _ = images[0]
    images[0] = (t, topic, kind, encode_compressed_image(t, "c", "png", b"\x89PNG"))
    recording = open_recording(write(tmp_path / "a.mcap", imu(motion, "imu") + images))
    assert recording.cameras["cam"].resolution == (8, 6)


@pytest.mark.parametrize("wrong_ns", [0, 10**18])
def test_a_few_stamps_far_from_all_others_are_left_out_and_counted(tmp_path, a_motion, wrong_ns):
    motion = a_motion()
    items = imu(motion, "imu") + raw(motion)
    for sensor in (IMU_TYPE, IMAGE_TYPE):
        mine = [k for k, item in enumerate(items) if item[2] == sensor]
        for n, k in enumerate(mine[:4]):
            t, topic, kind, payload = items[k]
            items[k] = (t, topic, kind, with_stamp(payload, wrong_ns + n if wrong_ns else 0))
    recording = open_recording(write(tmp_path / "a.mcap", items))
    assert recording.imus["imu0"].count == len(motion[0]) - 4 == len(recording.imu_arrays("imu0").t_ns)
    assert recording.duration_s < 12.0 and not recording.stamp_sigma_s
    assert (
        len([text for text in recording.warnings if text.endswith("stamps far from all others, or 0")]) == 2
    )
    assert not any("missing" in text for text in recording.warnings)
    assert min(stamp_of(payload) or 0 for _, payload in recording.messages()) == recording.begin_ns


def test_a_clock_that_was_set_back_is_named(tmp_path, a_motion):
    """Sorted by their stamps, the readings before and after it would be mixed."""
    motion = a_motion()
    items = imu(motion, "imu") + raw(motion)
    late_ns = int(motion[0][1200])
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for stamp_ns, topic, kind, payload in sorted(items, key=lambda item: item[0]):
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            at_ns = stamp_ns - 5 * 10**9 * (stamp_ns > late_ns)
            writer.add_message(channels[topic], at_ns, with_stamp(payload, at_ns), at_ns)
        writer.finish()
    with pytest.raises(
        RecordingError, match=r"imu0: its stamps go back by (4\.9\d|5) s in .*: its clock was set"
    ):
        open_recording(tmp_path / "a.mcap")
    assert open_recording(tmp_path / "a.mcap", check=False).imus["imu0"].count == len(motion[0])


def test_a_table_whose_clock_was_set_back_is_named(tmp_path, a_motion, write_asl):
    t_ns, gyro, force = a_motion()
    t_ns = t_ns - 5 * 10**9 * (np.arange(len(t_ns)) > 1200)
    with pytest.raises(RecordingError, match=r"imu0: its stamps go back by (4\.9\d|5) s"):
        open_recording(write_asl(tmp_path / "a", imu=(t_ns, gyro, force)))


@pytest.mark.parametrize(("used", "late_s"), [((0.0, 2.0), 0.0), ((7.5, None), 1.5)])
def test_what_is_before_or_after_a_step_of_the_clock_can_be_used(a_motion, write_asl, tmp_path, used, late_s):
    """Between, each stamp comes twice; `--skip` and `--seconds` could not leave that out."""
    t_ns, gyro, force = a_motion()
    after = np.arange(len(t_ns)) > 1200
    folder = write_asl(tmp_path / "a", imu=(t_ns - 1_500_000_000 * after, gyro, force))
    with pytest.raises(RecordingError, match=r"two recordings, or use only a part .--seconds 4 or --skip 7."):
        open_recording(folder)
    skip_s, seconds = used
    with pytest.raises(RecordingError, match=r"go back by 1\.5 s"):
        open_recording(folder, skip_s=max(skip_s - 2.0, 0.0), seconds=None)
    job = make_job(
        open_recording(folder, skip_s=skip_s, seconds=seconds),
        Initial({"cam0": CameraPrior(resolution=(752, 752))}),
        target=None,
        skip_s=skip_s,
        seconds=seconds,
    )
    found = [decode_imu(payload) for key, payload in job.messages() if key == job.imu.key]
    begin_ns = t_ns[0] + round((skip_s + late_s) * 1e9)
    inside = (t_ns >= begin_ns) & (t_ns <= begin_ns + (seconds or 60.0) * 1e9)
    assert [m.stamp_ns for m in found] == (t_ns[inside] - round(late_s * 1e9)).tolist()
    assert [list(m.gyro_rps) for m in found] == gyro[inside].tolist()


@pytest.mark.parametrize("share", [0.4, 0.01])
def test_a_clock_that_was_set_forwards_by_years_is_named(tmp_path, a_motion, write_asl, share):
    """By NTP, on a computer without a battery-backed clock: `td-icp` asked for 1 TiB, images were refused."""
    t_ns, gyro, force = a_motion()
    before = np.arange(len(t_ns)) < share * len(t_ns)
    path = write_asl(tmp_path / "a", imu=(t_ns - 10**18 * before, gyro, force))
    if share < 0.05:  # what there was before is not missed
        assert open_recording(path).imus["imu0"].count == len(t_ns)
        return
    with pytest.raises(RecordingError, match=r"imu0: its stamps jump by 11574 days in .*: its clock was set"):
        open_recording(path)
