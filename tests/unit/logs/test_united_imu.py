"""Gyro and accelerometer as two topics, as drivers of RealSense, ZED and OAK cameras publish them."""

from __future__ import annotations

import numpy as np
import pytest
from vical_mocks.points import simulate

from vical_daemon.bus.messages import IMU_TYPE, decode_imu, encode_imu, encode_points
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.logs.united_imu import forces_at

GYRO, ACCEL = "camera/gyro/sample", "camera/accel/sample"
NOTHING = [0.0, 0.0, 0.0]


def write_two(path, gyro_run, accel_run, *, lost_s=(0.0, 0.0), also=()):
    """A log with one topic for each sensor; `lost_s`: where the accelerometer is silent."""
    epoch_ns = gyro_run.options.epoch_ns
    items = [
        (t, GYRO, encode_imu(t, "gyro_frame", w, NOTHING))
        for t, w in zip(gyro_run.t_imu_ns.tolist(), gyro_run.gyro_rps.tolist(), strict=True)
    ]
    items += [
        (t, topic, encode_imu(t, "accel_frame", NOTHING, f))
        for topic in (ACCEL, *also)
        for t, f in zip(accel_run.t_imu_ns.tolist(), accel_run.specific_force_mps2.tolist(), strict=True)
        if not lost_s[0] < (t - epoch_ns) * 1e-9 < lost_s[1]
    ]
    points = [
        (f.t_cam_ns, "vical/rig0/camera/cam0/points", encode_points(f.t_cam_ns, "cam0", f.ids, f.uv_px))
        for f in gyro_run.frames
    ]
    with LogWriter(path) as writer:
        for t, topic, payload in sorted([*items, *points], key=lambda item: item[0]):
            writer.write(topic, payload, t, IMU_TYPE if "sample" in topic else None)
    return path


@pytest.fixture(scope="module")
def runs():
    """The same rig with a gyro of 200 Hz and an accelerometer of 63 Hz."""
    return simulate(1, 8.0, imu_rate_hz=200.0), simulate(1, 8.0, imu_rate_hz=63.0)


def test_two_topics_are_one_imu(tmp_path, runs):
    gyro, accel = runs
    recording = open_recording(write_two(tmp_path / "a.mcap", gyro, accel))
    assert list(recording.imus) == ["gyro_sample"]
    assert any("has no accelerometer; that of accel_sample is used" in w for w in recording.warnings)
    samples = recording.imu_arrays("gyro_sample")
    within = (gyro.t_imu_ns >= accel.t_imu_ns[0]) & (gyro.t_imu_ns <= accel.t_imu_ns[-1])
    assert samples.t_ns.tolist() == gyro.t_imu_ns[within].tolist()
    assert samples.gyro_rps.tobytes() == gyro.gyro_rps[within].tobytes()
    # white noise of the accelerometer at 63 Hz, 6 mm/s^2, and what a cubic leaves of the motion
    off = samples.specific_force_mps2 - gyro.specific_force_mps2[within]
    noise = np.hypot(np.sqrt(63.0), np.sqrt(200.0)) * gyro.rig.densities.accel
    assert np.sqrt(np.mean(off**2)) < 1.2 * noise
    messages = [decode_imu(payload) for key, payload in recording.messages() if "/imu/" in key]
    assert [row.stamp_ns for row in messages] == samples.t_ns.tolist()
    forces = np.array([row.specific_force_mps2 for row in messages])
    assert forces.tobytes() == samples.specific_force_mps2.tobytes()


def test_where_the_accelerometer_is_silent_there_is_a_gap(tmp_path, runs):
    recording = open_recording(write_two(tmp_path / "a.mcap", *runs, lost_s=(3.0, 4.0)))
    assert any("in 1 holes, the longest 1.0" in warning for warning in recording.warnings)
    stamps = recording.imu_arrays("gyro_sample").t_ns
    assert np.diff(stamps).max() == pytest.approx(1.0e9, abs=5e7)


def test_two_accelerometers_leave_the_choice_to_the_user(tmp_path, runs):
    path = write_two(tmp_path / "a.mcap", *runs, also=("other/accel/sample",))
    with pytest.raises(RecordingError, match=r"the accelerometer never changes; is it in another topic"):
        open_recording(path)
    recording = open_recording(path, topics=[GYRO, ACCEL, "cam0"])
    assert list(recording.imus) == ["gyro_sample"]


def test_forces_are_as_smooth_as_a_cubic():
    """A motion of 3 Hz at 63 Hz: straight lines flatten it by 0.7 %, a cubic by less than a tenth of it."""
    t_ns, accel_ns = (np.round(np.arange(0.0, 4.0, 1.0 / hz) * 1e9).astype(np.int64) for hz in (200.0, 63.0))

    def motion(t):
        return np.sin(2 * np.pi * 3.0 * t[:, None] * 1e-9 + np.arange(3.0))

    found = forces_at(t_ns, accel_ns, motion(accel_ns))
    inner = slice(100, -100)
    size = (found * motion(t_ns))[inner].sum() / (motion(t_ns)[inner] ** 2).sum()
    assert abs(size - 1.0) < 7e-4
    assert np.isnan(found[t_ns > accel_ns[-1]]).all() and np.isfinite(found[t_ns <= accel_ns[-1]]).all()
    assert np.isnan(forces_at(t_ns, accel_ns[:3], motion(accel_ns)[:3])).all()
