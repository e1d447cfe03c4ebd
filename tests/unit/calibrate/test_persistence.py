"""A calibration survives a restart, belongs to its devices, and a changed mounting is announced once."""

from __future__ import annotations

import logging
import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import DiagnosticStatus, Level, decode_calibration, encode_diagnostics
from vical_daemon.calibrate.checkpoint import Checkpoint
from vical_daemon.calibrate.estimators import make_estimator
from vical_daemon.calibrate.in_use import NothingInUseError, calibration_in_use
from vical_daemon.calibrate.persistence import CalibrationPersistence
from vical_daemon.calibrate.role import _Supervisor
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import Config, LensConfig, VerifyConfig, loads
from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.estimation.status.mounting_changes import differences
from vical_daemon.estimation.wording import event_text
from vical_daemon.results.store import CalibrationStore, StoreError
from vical_daemon.service.wall_clock import private_clock


def _camera(p_m=(0.08, 0.02, -0.03), turn_deg=0.0, shift_s=0.01, sigma=1e-4) -> CameraEstimate:
    x, y, z, w = Rotation.from_euler("y", turn_deg, degrees=True).as_quat()
    covariance = (np.eye(6) * sigma**2).tolist()
    pose = PoseEstimate(list(p_m), [float(v) for v in (w, x, y, z)], covariance)
    lens = ([500.0, 500.0, 320.0, 240.0], [1.0] * 4, "radtan", [0.1, 0.0, 0.0, 0.0], [0.01] * 4)
    return CameraEstimate(pose, shift_s, 1e-5, *lens, 0.2)


def _estimate(camera: CameraEstimate, status: Status = Status.CONVERGED) -> CalibrationEstimate:
    return CalibrationEstimate(
        1, status, "", 1.0, "", 60.0, 600, 6000, {"cam0": camera}, None, [0.0, 0.0, -9.8], 1.0, 0.0
    )


def _announce(bus: LocalBus, camera_serial: str = "C1") -> None:
    for role, name, serial in (("imu", "imu/imu0", "I1"), ("camera", "camera/cam0", camera_serial)):
        payload = encode_diagnostics(1, role, [DiagnosticStatus(Level.OK, name, "", serial)])
        bus.publish(topics.STATUS.key("rig0", role), payload)


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return loads(
        "imus: {imu0: {port: /dev/x, rate_hz: 100}}\ncameras: {cam0: {uri: 'v4l2:/dev/video0'}}\n"
        f"target: t.yaml\nstore: {{directory: {tmp_path / 'store'}}}\n"
    )


def _remember(config: Config, camera: CameraEstimate, camera_serial: str = "C1") -> None:
    bus = LocalBus()
    persistence = CalibrationPersistence(config, bus, private_clock())
    _announce(bus, camera_serial)
    persistence.watch(_estimate(camera))
    persistence.close(None)


def _later(config: Config, camera_serial: str = "C1") -> CalibrationPersistence:
    bus = LocalBus()
    persistence = CalibrationPersistence(config, bus, private_clock())
    _announce(bus, camera_serial)
    return persistence


def test_nothing_known_gives_what_the_config_says(config: Config) -> None:
    prior = _later(config).priors()["cam0"]
    assert prior.T_imu_cam is None and prior.resolution == (640, 480)


def test_a_converged_calibration_is_the_prior_after_a_restart(config: Config) -> None:
    _remember(config, _camera())
    prior = _later(config).priors()["cam0"]
    assert prior.T_imu_cam is not None and prior.timeshift_cam_imu_s == 0.01
    np.testing.assert_array_equal(prior.T_imu_cam[1], [0.08, 0.02, -0.03])
    assert prior.intrinsics == (500, 500, 320, 240)


def test_a_disk_that_stalls_does_not_hold_up_the_estimator(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An SD card may take 20 s to sync a file, and one was synced every minute while all images waited."""
    answers, save = threading.Event(), CalibrationStore.save

    def stalled(*args: Any) -> Path:
        assert answers.wait(30.0)
        return save(*args)

    monkeypatch.setattr(CalibrationStore, "save", stalled)
    monkeypatch.setattr("vical_daemon.calibrate.persistence.SAVE_EVERY_S", 0.0)
    persistence = _later(config)
    for x_m in (0.08, 0.09):  # the second finds the first one waiting
        persistence.watch(_estimate(_camera(p_m=(x_m, 0.02, -0.03))))
    assert _later(config).priors()["cam0"].T_imu_cam is None
    answers.set()
    persistence.close(_estimate(_camera(p_m=(0.1, 0.02, -0.03))))
    prior = _later(config).priors()["cam0"]
    assert prior.T_imu_cam is not None and prior.T_imu_cam[1][0] == 0.1


def test_it_is_not_used_for_another_camera(config: Config) -> None:
    _remember(config, _camera())
    assert _later(config, camera_serial="C2").priors()["cam0"].T_imu_cam is None


def test_what_the_config_holds_fixed_wins(config: Config) -> None:
    _remember(config, _camera())
    lens = replace(config.cameras["cam0"].lens, intrinsics=(460.0, 460.0, 300.0, 200.0))
    fixed = replace(
        config,
        cameras={"cam0": replace(config.cameras["cam0"], lens=lens)},
        calibration=replace(config.calibration, fix=("intrinsics",)),
    )
    prior = _later(fixed).priors()["cam0"]
    assert prior.intrinsics == (460, 460, 300, 200) and prior.distortion is None
    assert prior.T_imu_cam is not None


def test_a_stored_lens_of_another_image_size_is_not_used(config: Config) -> None:
    _remember(config, replace(_camera(), resolution=[1280, 960]))
    persistence = _later(config)
    prior = persistence.priors()["cam0"]
    assert prior.intrinsics is None and prior.resolution == (640, 480)
    assert prior.T_imu_cam is not None
    with pytest.raises(NothingInUseError, match="of images of 1280 x 960 px, not 640 x 480"):
        calibration_in_use(config, persistence, 0)
    _remember(config, replace(_camera(), resolution=[640, 480]))
    persistence = _later(config)
    assert persistence.priors()["cam0"].intrinsics == (500, 500, 320, 240)
    assert set(calibration_in_use(config, persistence, 0).known) == {"cam0"}


def test_a_file_for_images_of_another_size_is_not_verified(config: Config, tmp_path: Path) -> None:
    rows = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    lens = "intrinsics: [920, 920, 640, 480], distortion_coeffs: [0, 0, 0, 0]"
    (tmp_path / "chain.yaml").write_text(f"cam0: {{T_cam_imu: {rows}, {lens}, resolution: [1280, 960]}}\n")
    config = replace(config, verify=VerifyConfig(str(tmp_path / "chain.yaml")), path=tmp_path / "vical.yaml")
    with pytest.raises(NothingInUseError, match=r"chain.yaml is for images of 1280 x 960 px, not 640 x 480"):
        calibration_in_use(config, _later(config), 0)


def test_a_store_that_cannot_be_written_stays_in_the_status_until_it_can(
    config: Config, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """`converged` with a full disk: after the next boot the calibration would be gone."""
    persistence, save, clock = _later(config), CalibrationStore.save, private_clock()

    def full(*_: object) -> None:
        raise StoreError("x.json cannot be written: No space left on device")

    free = replace(config, calibration=replace(config.calibration, mode="target_free"))
    role = EstimateRole(free, make_estimator(free, persistence.priors()))
    supervisor = _Supervisor(free, role, persistence, Checkpoint(None, free, clock))
    for store, level in ((full, Level.WARN), (full, Level.WARN), (save, Level.OK)):
        monkeypatch.setattr(CalibrationStore, "save", store)
        persistence.save(_estimate(_camera()))
        status = supervisor.statuses(0, 0.0)[0]
        assert status.level is level
        assert ("; not stored: x.json cannot be written" in status.message) is (level is Level.WARN)
    assert len(caplog.records) == 1


def test_nothing_is_stored_before_convergence(config: Config) -> None:
    bus = LocalBus()
    persistence = CalibrationPersistence(config, bus, private_clock())
    _announce(bus)
    persistence.watch(_estimate(_camera(), Status.CONVERGING))
    persistence.close(_estimate(_camera(), Status.DEGENERATE))
    assert _later(config).priors()["cam0"].T_imu_cam is None


def test_serials_may_come_late_but_not_never(config: Config) -> None:
    _remember(config, _camera())
    bus = LocalBus()
    persistence = CalibrationPersistence(config, bus, private_clock())
    threading.Timer(0.2, _announce, [bus]).start()
    assert persistence.priors()["cam0"].T_imu_cam is not None


def test_what_is_stored_for_a_device_that_is_opened_late_is_compared_and_kept(config: Config) -> None:
    """An IMU that takes long to open, or a camera plugged in later: the start does not wait for them."""
    _remember(config, _camera())
    bus = LocalBus()
    persistence = CalibrationPersistence(config, bus, private_clock())
    assert persistence.priors(wait_s=0.0)["cam0"].T_imu_cam is None
    assert persistence.look_up() == []
    _announce(bus)
    moved = persistence.watch(_estimate(_camera(p_m=(0.09, 0.02, -0.03))))
    assert [event.kind for event in moved.events] == [EventKind.CAMERA_MOVED]
    assert persistence.look_up() == []  # what this run stored is not what was stored before
    assert persistence.discard(moved) is not None
    prior = _later(config).priors()["cam0"]
    assert prior.T_imu_cam is not None
    np.testing.assert_array_equal(prior.T_imu_cam[1], [0.08, 0.02, -0.03])


@pytest.mark.parametrize(
    ("now", "said"),
    [
        ({"size": (320, 240)}, "the stored lens is for images of 640 x 480 px, not 320 x 240: not used"),
        (
            {"lens": LensConfig(distortion_model="equidistant")},
            "the stored calibration is radtan, the config says equidistant: not used",
        ),
    ],
)
def test_what_is_stored_and_not_used_is_named(
    config: Config, now: dict[str, Any], said: str, caplog: pytest.LogCaptureFixture
) -> None:
    _remember(config, replace(_camera(), resolution=[640, 480]))
    changed = replace(config, cameras={"cam0": replace(config.cameras["cam0"], **now)})
    _later(changed).priors()
    assert [record.getMessage() for record in caplog.records] == [f"cam0: {said}"]


def test_a_replaced_device_gets_neither_the_old_calibration_nor_its_name(config: Config) -> None:
    _remember(config, _camera(p_m=(0.5, 0.0, 0.0)), camera_serial="C2")  # known from another day
    bus = LocalBus()
    persistence = CalibrationPersistence(config, bus, private_clock())
    _announce(bus, "C1")
    assert persistence.priors()["cam0"].T_imu_cam is None
    persistence.watch(_estimate(_camera()))
    of_c1 = persistence.devices
    for times in range(3):  # another camera in the same place
        assert not persistence.replaced, times
        _announce(bus, "C2")
        assert persistence.devices == {}  # in doubt: no state is kept
        persistence.save(_estimate(_camera(p_m=(0.2, 0.2, 0.2))))
    assert persistence.replaced
    persistence.save(_estimate(_camera(p_m=(0.3, 0.3, 0.3))))  # of the old one: under no name
    prior = persistence.begin_again()["cam0"]
    assert prior.T_imu_cam is not None
    np.testing.assert_array_equal(prior.T_imu_cam[1], [0.5, 0.0, 0.0])
    assert persistence.stored == ["cam0"] and not persistence.replaced
    assert persistence.devices == {**of_c1, "camera/cam0": "C2"}
    events = persistence.watch(_estimate(_camera(p_m=(0.6, 0.0, 0.0)))).events
    assert (
        event_text(events[0])
        == "camera/cam0 is another device now (serial C2, not C1): the calibration starts over"
    )
    persistence.close(None)
    for serial, p_m in (("C1", [0.08, 0.02, -0.03]), ("C2", [0.6, 0.0, 0.0])):
        prior = _later(config, serial).priors()["cam0"]
        assert prior.T_imu_cam is not None
        np.testing.assert_array_equal(prior.T_imu_cam[1], p_m)


def test_one_damaged_status_replaces_no_device(config: Config) -> None:
    bus = LocalBus()
    persistence = CalibrationPersistence(config, bus, private_clock())
    for serial in ("C1", "C9", "C8", "C1", "C9", "C9", "C1", "C8"):
        _announce(bus, serial)
        assert not persistence.replaced
    _announce(bus, "C1")
    assert persistence.devices["camera/cam0"] == "C1"


def test_a_changed_mounting_is_announced_once(config: Config) -> None:
    _remember(config, _camera())
    persistence = _later(config)
    persistence.priors()
    first = persistence.watch(_estimate(_camera(p_m=(0.09, 0.02, -0.03), turn_deg=1.0)))
    assert [event_text(e) for e in first.events] == [
        "changed: cam0: moved by 10.0 ± 0.1 mm since the stored calibration",
        "changed: cam0: turned by 1.00 ± 0.01 deg since the stored calibration",
    ]
    assert persistence.watch(_estimate(_camera(p_m=(0.09, 0.02, -0.03)))).events == []


def _differences(before: CameraEstimate, now: CameraEstimate) -> list[tuple[EventKind, float]]:
    found = differences("cam0", before, now, 30.0, Cause.STORED_DIFFERS)
    assert all(e.camera == "cam0" and e.t_s == 30.0 and e.cause is Cause.STORED_DIFFERS for e in found)
    return [(e.kind, round(e.value or 0.0, 5)) for e in found]


def test_what_lies_within_the_sigmas_or_does_not_matter_is_no_change() -> None:
    assert _differences(_camera(), _camera()) == []
    assert _differences(_camera(), _camera(p_m=(0.081, 0.02, -0.03))) == []  # 7 sigma, but 1 mm
    far = _camera(p_m=(0.09, 0.02, -0.03), sigma=5e-3)
    assert _differences(_camera(sigma=5e-3), far) == []  # 1.4 sigma
    assert _differences(_camera(), _camera(shift_s=0.0105)) == [(EventKind.TIMESHIFT_CHANGED, 5e-4)]
    assert _differences(_camera(turn_deg=0.05), _camera()) == []
    turned = [(EventKind.CAMERA_TURNED, round(math.radians(0.5), 5))]
    assert _differences(_camera(turn_deg=0.5), _camera()) == turned


def test_the_journal_gets_an_event_as_fields_and_its_name_from_its_kind(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[tuple[str, dict[str, object]]] = []
    monkeypatch.setattr(
        "vical_daemon.service.notify.event", lambda name, text, **more: written.append((name, more))
    )
    persistence = _later(config)
    persistence.announce(Event(EventKind.BUMPED, cause=Cause.IMAGES_REFUSED))
    persistence.announce(Event(EventKind.OTHER, said="bumped: only a text"))
    persistence.announce(Event(EventKind.STAMP_JITTER, "cam0", 1e-3))
    persistence.watch(_estimate(_camera(), Status.CONVERGING))
    assert [name for name, _ in written] == ["bumped", "calibration", "calibration"]
    assert written[2][1]["kind"] == "stamp_jitter"
    assert (written[2][1]["camera"], written[2][1]["value"]) == ("cam0", 1e-3)


@pytest.mark.parametrize("under_systemd", [False, True])
def test_a_terminal_shows_what_goes_to_the_journal(
    config: Config, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, under_systemd: bool
) -> None:
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    if under_systemd:
        monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    persistence = _later(config)
    caplog.clear()
    caplog.set_level(logging.INFO)
    persistence.announce(Event(EventKind.BUMPED, cause=Cause.IMAGES_REFUSED))
    persistence.announce(Event(EventKind.ESTIMATOR_RESTARTED, said="logged where it happens"))
    persistence.announce(Event(EventKind.STORED_HOLDS, value=15.0))  # good news is no warning
    lines = [(r.levelname, "bumped" in r.message) for r in caplog.records]
    assert lines == ([] if under_systemd else [("WARNING", True), ("INFO", False)])


def _said(persistence: CalibrationPersistence, estimate: CalibrationEstimate) -> list[str]:
    return [event_text(event) for event in persistence.watch(estimate).events]


def test_accept_stores_what_has_not_converged_and_makes_it_the_one_to_compare_with(config: Config) -> None:
    _remember(config, _camera())
    persistence = _later(config)
    persistence.priors()
    moved = _estimate(_camera(p_m=(0.09, 0.02, -0.03)), Status.CONVERGING)
    assert persistence.accept(moved)
    assert _said(persistence, moved)[0].startswith("accepted")
    [(key, payload)] = persistence.stored_messages()
    assert key == topics.STORED.key("rig0", "cam0")
    assert decode_calibration(payload).estimate.cameras["cam0"].T_imu_cam.p_m[0] == 0.09
    assert _later(config).priors()["cam0"].T_imu_cam[1][0] == 0.09


@pytest.mark.parametrize(
    ("estimate", "why"),
    [
        (None, "no result yet"),
        (replace(_estimate(_camera()), cameras={}), "no result yet"),
        (
            replace(_estimate(_camera(), Status.INCONSISTENT), reason="stamps"),
            "contradict each other: stamps",
        ),
        (_estimate(replace(_camera(), unobservable=["lever arm along z"])), "did not show lever arm along z"),
    ],
)
def test_what_cannot_be_used_is_not_accepted(config: Config, estimate: CalibrationEstimate, why: str) -> None:
    persistence = _later(config)
    persistence.priors()
    assert not persistence.accept(estimate)
    said = _said(persistence, _estimate(_camera(), Status.WAITING))[0]
    assert said.startswith("not accepted") and why in said
    assert persistence.stored_messages() == []


def test_cameras_with_one_serial_number_keep_their_own_calibrations(tmp_path: Path) -> None:
    """Cheap cameras of one model have the same; the one stored last was the prior of both."""
    config = loads(
        "imus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
        "cameras: {left: {uri: 'v4l2:/dev/video0'}, right: {uri: 'v4l2:/dev/video2'}}\n"
        f"target: t.yaml\nstore: {{directory: {tmp_path / 'store'}}}\n"
    )

    def begin() -> CalibrationPersistence:
        bus = LocalBus()
        persistence = CalibrationPersistence(config, bus, private_clock())
        statuses = [DiagnosticStatus(Level.OK, f"camera/{name}", "", "SN0001") for name in config.cameras]
        statuses.append(DiagnosticStatus(Level.OK, "imu/imu0", "", "I1"))
        bus.publish(topics.STATUS.key("rig0", "camera"), encode_diagnostics(1, "camera", statuses))
        return persistence

    persistence = begin()
    cameras = {"left": _camera(), "right": _camera(p_m=(-0.08, 0.02, -0.03))}
    said = _said(persistence, replace(_estimate(_camera()), cameras=cameras))
    assert len(said) == 1 and said[0].startswith("left and right have the same serial number SN0001")
    assert _said(persistence, replace(_estimate(_camera()), cameras=cameras)) == []
    priors = begin().priors()
    assert [priors[name].T_imu_cam[1][0] for name in cameras] == [0.08, -0.08]


def test_discard_puts_back_what_was_stored_before(config: Config) -> None:
    _remember(config, _camera())
    persistence = _later(config)
    persistence.priors()
    persistence.watch(_estimate(_camera(p_m=(0.09, 0.02, -0.03))))  # converged: stored by itself
    assert _later(config).priors()["cam0"].T_imu_cam[1][0] == 0.09
    assert persistence.discard(_estimate(_camera()))["cam0"].T_imu_cam[1][0] == 0.08
    assert _later(config).priors()["cam0"].T_imu_cam[1][0] == 0.08


def test_discard_forgets_where_nothing_was_stored_before(config: Config) -> None:
    persistence = _later(config)
    persistence.priors()
    persistence.watch(_estimate(_camera()))
    assert persistence.discard(_estimate(_camera()))["cam0"].T_imu_cam is None
    assert _later(config).priors()["cam0"].T_imu_cam is None
    said = _said(persistence, _estimate(_camera(), Status.WAITING))
    assert said == ["discarded: starting over, nothing was stored before"]


@pytest.mark.parametrize("before", [True, False])
def test_without_a_result_nothing_is_discarded_and_it_is_said(config: Config, before: bool) -> None:
    if before:
        _remember(config, _camera())
    persistence = _later(config)
    persistence.priors()
    waiting = replace(_estimate(_camera(), Status.WAITING), cameras={})
    for estimate in (None, waiting):
        assert persistence.discard(estimate) is None
        assert _said(persistence, waiting) == ["not discarded: there is no result yet"]
    persistence.watch(_estimate(_camera(p_m=(0.09, 0.02, -0.03))))  # stored; then the estimator failed
    assert persistence.discard(None) is not None
    assert (_later(config).priors()["cam0"].T_imu_cam is not None) == before


def test_a_store_that_cannot_be_put_back_is_no_success(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    persistence = _later(config)
    persistence.priors()
    persistence.watch(_estimate(_camera()))

    def refuse(*_: object) -> None:
        raise StoreError("x.json cannot be removed: Read-only file system")

    monkeypatch.setattr(CalibrationStore, "remove", refuse)
    assert persistence.discard(_estimate(_camera())) is None
    said = _said(persistence, _estimate(_camera(), Status.WAITING))
    assert said == ["not discarded: x.json cannot be removed: Read-only file system"]
