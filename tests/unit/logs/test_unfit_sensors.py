"""A recording holds more than what is calibrated: sensors that cannot be used do not spoil those that can."""

from __future__ import annotations

import numpy as np
import pytest
from mcap.writer import Writer

from vical_daemon.bus.messages import IMAGE_TYPE, IMU_TYPE, encode_image, encode_imu
from vical_daemon.cli import main
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.mcap import LogWriter

PIXELS = np.zeros((24, 32), np.uint8)


@pytest.fixture
def write(tmp_path, a_motion):
    def write_log(imus: dict[str, float], cameras: dict[str, tuple[int, int]]):
        """Imus: factors on their accelerometers; cameras: which images, how far their clock is off."""
        t_ns, gyro, force = a_motion()
        items = [
            (t, f"/{name}/imu", IMU_TYPE, encode_imu(t, name, w, f))
            for name, factor in imus.items()
            for t, w, f in zip(t_ns.tolist(), gyro.tolist(), (factor * force).tolist(), strict=True)
        ] + [
            (t, f"/{name}/image_raw", IMAGE_TYPE, encode_image(t + off, name, PIXELS, "mono8"))
            for name, (every, off) in cameras.items()
            for t in t_ns[::every].tolist()
        ]
        with (tmp_path / "a.mcap").open("wb") as file:
            writer, channels = Writer(file), {}
            writer.start()
            for t, topic, kind, payload in sorted(items, key=lambda item: item[0]):
                if topic not in channels:
                    schema = writer.register_schema(kind, "ros2msg", b"")
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                writer.add_message(channels[topic], t, payload, t)
            writer.finish()
        return tmp_path / "a.mcap"

    return write_log


IN_G = {"livox": 1 / 9.80665, "alphasense": 1.0}


def test_a_laser_scanners_imu_in_g_is_left_out(write, capsys):
    path = write(IN_G, {"cam0": (10, 0)})
    recording = open_recording(path)
    assert list(recording.imus) == ["alphasense"]
    (warning,) = recording.warnings
    assert warning.startswith("left out, another is used: livox: the accelerometer reads 1 in the middle")
    assert main(["info", str(path)]) == 0
    assert f"warning: {warning}" in capsys.readouterr().out


def test_what_is_meant_is_used_or_refused(write):
    path = write(IN_G, {"cam0": (10, 0), "slow": (800, 0), "off": (10, 10**15)})
    for name in ("alphasense", "/alphasense/imu"):
        recording = open_recording(path, imus=[name], cameras=["cam0"])
        assert [stream.name for stream in recording.streams] == ["alphasense", "cam0"]
        assert recording.warnings == [] and recording.duration_s == pytest.approx(12.0, abs=0.1)
    with pytest.raises(RecordingError, match=r"livox: .* it looks like g"):
        open_recording(path, imus=["livox"])
    for name, says in (("slow", "0.25 frames a second"), ("off", "do not overlap")):
        with pytest.raises(RecordingError, match=f"{name}: .*{says}"):
            open_recording(path, cameras=[name])


def test_unfit_cameras_are_left_out_and_named(write):
    recording = open_recording(write({"imu": 1.0}, {"cam0": (10, 0), "slow": (800, 0), "off": (10, 10**15)}))
    assert list(recording.cameras) == ["cam0"]
    assert recording.duration_s == pytest.approx(12.0, abs=0.1)
    assert [text.split(":")[1].strip() for text in recording.warnings] == ["off", "slow"]


def test_where_none_is_fit_the_first_is_named(write):
    with pytest.raises(RecordingError, match=r"livox: .* it looks like g"):
        open_recording(write({"livox": 0.1, "ouster": 0.1}, {"cam0": (10, 0)}))
    with pytest.raises(RecordingError, match=r"slow: 0\.25 frames a second"):
        open_recording(write({"imu": 1.0}, {"slow": (800, 0)}))


def test_readings_that_are_all_0_are_no_readings(tmp_path, a_motion, write_asl):
    """A bus that does not answer; and an imu of orientations alone is none."""
    t_ns, gyro, force = a_motion()
    nothing = (0.0, 0.0, 0.0)
    gyro[::50], force[::50] = 0.0, 0.0
    left = len(t_ns) - len(t_ns[::50])
    recording = open_recording(write_asl(tmp_path / "asl", imu=(t_ns, gyro, force)))
    assert recording.imus["imu0"].count == left
    assert any("48 samples that are not finite, or all 0, left out" in w for w in recording.warnings)
    log = tmp_path / "b.mcap"
    with LogWriter(log) as writer:
        for t, w, f in zip(t_ns.tolist(), gyro.tolist(), force.tolist(), strict=True):
            writer.write("vical/rig0/imu/imu0", encode_imu(t, "imu0", w, f), t)
            writer.write("vical/rig0/imu/poses", encode_imu(t, "poses", nothing, nothing), t)
        for t in t_ns[::10].tolist():
            writer.write("vical/rig0/camera/cam0/image", encode_image(t, "cam0", PIXELS, "mono8"), t)
    recording = open_recording(log)
    assert list(recording.imus) == ["imu0"] and recording.imus["imu0"].count == left
    assert sum("unreadable messages left out (all readings are 0)" in w for w in recording.warnings) == 2
    keys = [key for key, _ in recording.messages(recording.imus.values())]
    assert len(keys) == left == len(recording.imu_arrays("imu0").t_ns)
