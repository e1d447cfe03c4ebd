"""The calibration store: always the old or the new, found by serial numbers, checked when read."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    ImuEstimate,
    PoseEstimate,
    Status,
)
from vical_daemon.results.store import CalibrationStore, StoreError, read_stored


def estimate(x_m: float = 0.1, **changes) -> CalibrationEstimate:
    values = {
        "T_imu_cam": PoseEstimate([x_m, 0.0, 0.2], [0.5, -0.5, 0.5, -0.5], (np.eye(6) * 1e-6).tolist()),
        "timeshift_cam_imu_s": 0.001, "timeshift_sigma_s": 1e-5,
        "intrinsics": [450.0, 451.0, 320.0, 240.0], "intrinsics_sigma": [0.1] * 4,
        "distortion_model": "radtan", "distortion": [-0.3, 0.1, 0.0, 0.0], "distortion_sigma": [0.0] * 4,
        "reprojection_rms_px": 0.2,
    } | changes  # fmt: skip
    imu = ImuEstimate([0.01] * 3, [0.1] * 3)
    return CalibrationEstimate(
        5, Status.CONVERGED, "", 1.0, "", 70.0, 1400, 14000, {"cam0": CameraEstimate(**values)}, imu,
        [0.0, 0.0, -9.8], 1.0, 0.0,
    )  # fmt: skip


@pytest.fixture
def store(tmp_path):
    return CalibrationStore(tmp_path / "store")


def test_what_is_saved_is_loaded(store):
    assert store.load("6223.42", "usb-1234") is None
    store.save("6223.42", "usb-1234", "cam0", estimate(), 77)
    stored = store.load("6223.42", "usb-1234")
    assert stored.estimate == estimate()
    assert (stored.saved_ns, stored.camera) == (77, "cam0")
    assert store.load("6223.43", "usb-1234") is None
    store.save("6223.42", "usb-1234", "cam0", estimate(0.3), 78)
    assert store.load("6223.42", "usb-1234").known.T_imu_cam.p_m[0] == 0.3
    assert len(list(store.folder.iterdir())) == 1
    store.save("6223.42", "other", "cam0", estimate(), 99)
    assert [s.saved_ns for s in store.all()] == [99, 78]


def test_a_file_of_version_0_1_0_with_events_as_text_is_loaded(store):
    path = store.save("a", "b", "cam0", estimate(), 1)
    document = json.loads(path.read_text())
    del document["estimate"]["next_motion"], document["estimate"]["cameras"]["cam0"]["withheld"]
    document["estimate"]["events"] = ["bumped: images no longer fit the motion"]
    path.write_text(json.dumps(document))
    assert store.load("a", "b").estimate == estimate()


def test_prior_of_a_stored_calibration(store):
    store.save("a", "b", "cam0", estimate(), 1)
    prior = store.load("a", "b").prior((640, 480))
    R, p = prior.T_imu_cam
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert p.tolist() == [0.1, 0.0, 0.2]
    assert prior.intrinsics == (450.0, 451.0, 320.0, 240.0)


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_a_lens_of_any_model_is_stored(store, model):
    coefficients = np.linspace(-0.3, 0.1, len(COEFFICIENTS[model])).tolist()
    lens = {"distortion_model": model, "distortion": coefficients}
    store.save("a", "b", "cam0", estimate(**lens), 1)
    prior = store.load("a", "b").prior((640, 480))
    assert (prior.distortion_model, list(prior.distortion)) == (model, coefficients)


@pytest.mark.parametrize(
    "serial", ["../../etc/passwd", "a/b", "", "x" * 500, "usb-0000:00:14.0-1", "..", "\n", "ü"]
)
def test_serial_numbers_cannot_leave_the_folder(store, serial):
    path = store.save(serial, serial, "cam0", estimate(), 1)
    assert path.parent == store.folder
    assert store.load(serial, serial) is not None
    assert store.path("a/b", "c") != store.path("a-b", "c")


@pytest.mark.parametrize("change", [
    {"intrinsics": [1.0]}, {"distortion": [0.1] * 5}, {"distortion_model": "fov"},
    {"timeshift_cam_imu_s": float("nan")}, {"timeshift_cam_imu_s": 100.0},
    {"intrinsics": [-1.0, 1.0, 1.0, 1.0]},
    {"T_imu_cam": PoseEstimate([0.0] * 3, [1.0, 1.0, 0.0, 0.0], np.eye(6).tolist())},
    {"T_imu_cam": PoseEstimate([99.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], np.eye(6).tolist())},
    {"T_imu_cam": PoseEstimate([0.0] * 3, [1.0, 0.0, 0.0, 0.0], [[1.0]])},
])  # fmt: skip
def test_nonsense_is_neither_saved_nor_loaded(store, change):
    path = store.save("a", "b", "cam0", estimate(), 1)
    with pytest.raises(StoreError, match="is not stored"):
        store.save("a", "b", "cam0", estimate(**change), 2)
    assert store.load("a", "b").saved_ns == 1
    text = json.loads(path.read_text())
    text["estimate"]["cameras"]["cam0"] = estimate(**change).to_json()["cameras"]["cam0"]
    path.write_text(json.dumps(text))
    assert store.load("a", "b") is None


def test_damaged_files_are_not_used_and_never_raise(store):
    path = store.save("a", "b", "cam0", estimate(), 1)
    good = path.read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(120):
        raw = bytearray(good[: int(rng.integers(0, len(good) + 1))])
        for _ in range(3):
            if raw:
                raw[int(rng.integers(0, len(raw)))] = int(rng.integers(0, 256))
        path.write_bytes(raw)
        read_stored(path)
    path.write_bytes(b"[" * 100_000)
    assert store.load("a", "b") is None
    path.write_bytes(good)
    other = store.path("c", "d")
    path.rename(other)
    assert store.load("c", "d") is None  # belongs to a and b


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_a_failure_at_any_step_leaves_the_old_one(store, monkeypatch, step):
    from pathlib import Path

    store.save("a", "b", "cam0", estimate(), 1)

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        if step == "replace":
            patch.setattr(Path, "replace", fail)
        else:
            patch.setattr(os, "open" if step == "write" else "fsync", fail)
        with pytest.raises(StoreError, match="No space left"):
            store.save("a", "b", "cam0", estimate(0.5), 2)
    assert store.load("a", "b").saved_ns == 1
    assert len(list(store.folder.iterdir())) == 1


def test_left_over_temporary_files_do_no_harm(store):
    path = store.save("a", "b", "cam0", estimate(), 1)
    (store.folder / f".{path.name}.1234.new").write_bytes(b"half of")
    assert store.load("a", "b").saved_ns == 1
    assert len(store.all()) == 1


def test_a_number_of_an_array_library_is_a_number(store):
    store.save("imu", "cam", "cam0", estimate(timeshift_cam_imu_s=np.float64(0.0125)), 1)
    assert store.load("imu", "cam").estimate.cameras["cam0"].timeshift_cam_imu_s == 0.0125


def test_the_newest_is_the_one_saved_last_whatever_the_date_was(store):
    """A computer without a battery-backed clock is in 1970 again after a start without a network."""
    store.save("a", "old", "cam0", estimate(), 1_790_000_000 * 10**9)
    store.save("a", "new", "cam0", estimate(), 30 * 10**9)
    assert [s.camera_serial for s in store.all()] == ["new", "old"]
    store.save("a", "new", "cam0", estimate(), 31 * 10**9)
    assert [s.order for s in store.all()] == [1, 0]
    store.save("a", "old", "cam0", estimate(), 32 * 10**9)
    assert [s.camera_serial for s in store.all()] == ["old", "new"]


@pytest.mark.parametrize("text", ['{"format": 2, "of": "a later version"}', "", "{"])
def test_a_file_that_this_version_cannot_read_is_kept(store, caplog, text):
    """Back to the older version and forth again: the calibration of the later one was overwritten."""
    path = store.save("a", "b", "cam0", estimate(), 1)
    path.write_text(text)
    assert store.load("a", "b") is None
    store.save("a", "b", "cam0", estimate(0.3), 2)
    assert store.load("a", "b").known.T_imu_cam.p_m[0] == 0.3
    kept = path.with_name(f"{path.name}.unused")
    assert kept.read_text() == text and str(kept) in caplog.messages[-1]
    store.save("a", "b", "cam0", estimate(0.4), 3)
    assert kept.read_text() == text and len(store.all()) == 1
