"""`vical watch` over a bus in memory; the demo's comparison with the truth, recomputed with scipy."""

from __future__ import annotations

import io
import json
import math
import threading
import time
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import (
    CheckState,
    DiagnosticStatus,
    Level,
    VerifyResult,
    encode_calibration,
    encode_diagnostics,
    encode_verification,
)
from vical_daemon.cli import bus_access, demo_truth, live_table, main, watch
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.results.euler import euler_sigma_deg


def _estimate(status: Status = Status.CONVERGING) -> CalibrationEstimate:
    pose = PoseEstimate([0.08, 0.02, -0.03], [1.0, 0.0, 0.0, 0.0], (np.eye(6) * 1e-6).tolist())
    camera = CameraEstimate(pose, -0.0125, 1e-4, [520.0] * 4, [1.0] * 4, "radtan", [0.0] * 4, [0.0] * 4, 0.2)
    return CalibrationEstimate(
        5, status, "", 0.5, "turn about x", 12.0, 99, 999, {"cam0": camera}, None, [], 1.0, 0.0
    )


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> LocalBus:
    bus = LocalBus()
    monkeypatch.setattr(bus_access, "open_client", lambda config, endpoint: bus)
    return bus


def _publish(bus: LocalBus, rig: str, status: Status) -> None:
    bus.publish(topics.CALIBRATION.key(rig, "cam0"), encode_calibration(_estimate(status), "cam0"))


def test_a_late_joiner_gets_the_last_state_at_once(bus: LocalBus, capsys) -> None:
    _publish(bus, "rover", Status.CONVERGING)
    begin_s = time.monotonic()
    assert main(["watch", "--once", "--json"]) == 0
    assert time.monotonic() - begin_s < 2.0
    state = json.loads(capsys.readouterr().out)
    assert (state["rig"], state["camera"], state["status"]) == ("rover", "cam0", "converging")


def test_a_verification_is_shown_with_the_calibration_in_use(bus: LocalBus, capsys) -> None:
    result = VerifyResult(5, "cam0", CheckState.RESTING, "changed", 4, text="store no longer holds: lens")
    bus.publish(topics.VERIFY.key("rover", "cam0"), encode_verification(result))
    _publish(bus, "rover", Status.CONVERGED)
    assert main(["watch", "--once"]) == 0
    assert capsys.readouterr().out == "rover  cam0  store no longer holds: lens\n"
    assert main(["watch", "--once", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verify"]["verdict"] == "changed"


def _status(bus: LocalBus, level: Level, message: str) -> None:
    status = DiagnosticStatus(level, "imu/imu0", message)
    bus.publish(topics.STATUS.key("rover", "imu"), encode_diagnostics(1, "imu", [status]))


def test_once_names_what_does_not_work(bus: LocalBus, capsys) -> None:
    """With the IMU unplugged the last estimate is still `converged`."""
    _publish(bus, "rover", Status.CONVERGED)
    problem = "the port is gone; check the cable"
    _status(bus, Level.ERROR, problem)
    assert main(["watch", "--once"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert " converged " in first and second == f"rover  imu/imu0  error: {problem}"
    assert main(["watch", "--once", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["problems"] == [
        {
            "rig": "rover",
            "component": "imu/imu0",
            "level": "error",
            "message": "the port is gone; check the cable",
        }
    ]


def test_a_pipe_gets_a_line_when_a_component_fails_and_when_it_is_back(bus: LocalBus, capsys) -> None:
    view = watch.View("*", as_json=False)
    view.begin(bus)
    for level, text in (
        (Level.OK, "100 Hz"),
        (Level.ERROR, "no data for 2.1 s"),
        (Level.ERROR, "no data for 3.1 s"),
        (Level.OK, "100 Hz, 0 lost"),
    ):
        _status(bus, level, text)
        view.print_new()
    assert capsys.readouterr().out.splitlines() == [
        "rover  imu/imu0  error: no data for 2.1 s",
        "rover  imu/imu0  ok: 100 Hz, 0 lost",
    ]


def test_nothing_there_is_one_line(bus: LocalBus, capsys) -> None:
    assert main(["watch", "--once", "--timeout", "0.3"]) == 1
    assert "is `vical run` (vical.target) running?" in capsys.readouterr().err


def test_until_converged_waits_for_every_camera_of_the_rig(bus: LocalBus, capsys) -> None:
    _publish(bus, "rover", Status.CONVERGING)
    _publish(bus, "other", Status.CONVERGING)
    timer = threading.Timer(0.4, _publish, [bus, "rover", Status.CONVERGED])
    timer.start()
    assert main(["watch", "--rig", "rover", "--until-converged", "--timeout", "10"]) == 0
    timer.join()
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith("rover") for line in lines)
    assert "shift -12.50 ± 0.10 ms" in lines[0] and "turn about x" in lines[0]
    assert "converging" in lines[0] and " converged " in lines[-1]


def test_out_of_time_exits_1_and_says_where_it_stands(bus: LocalBus, capsys) -> None:
    _publish(bus, "rover", Status.CONVERGING)
    assert main(["watch", "--until-converged", "--timeout", "0.3"]) == 1
    assert "cam0 of rover is converging (50%)" in capsys.readouterr().err


def test_estimates_that_stop_are_stale_and_no_longer_count_as_converged(monkeypatch) -> None:
    from rich.console import Console

    bus, now_s = LocalBus(), [100.0]
    monkeypatch.setattr("vical_daemon.cli.watch.time.monotonic", lambda: now_s[0])
    view = watch.View("*", as_json=False)
    view.begin(bus)
    _publish(bus, "rover", Status.CONVERGED)
    assert view.all_converged() and not view.silent()
    now_s[0] += 12.0
    assert not view.all_converged()
    assert view.silent() == {("rover", "cam0"): 12.0}
    assert "said 12 s ago and silent since" in view.where()
    shown = io.StringIO()
    Console(file=shown, width=100).print(live_table.screen(view.estimates, view.health, view.silent()))
    assert "stale, 12 s old, was converged" in shown.getvalue()
    _publish(bus, "rover", Status.CONVERGED)
    assert view.all_converged()


def test_junk_on_the_bus_is_ignored(bus: LocalBus, capsys) -> None:
    bus.publish("vical/rover/calibration/cam0", b"junk")
    bus.publish("vical/rover/status/imu", b"junk")
    bus.publish(
        topics.STATUS.key("rover", "imu"),
        encode_diagnostics(1, "imu", [DiagnosticStatus(Level.OK, "imu/imu0")]),
    )
    assert main(["watch", "--timeout", "0.3"]) == 1
    assert capsys.readouterr().out == ""


def test_table_rows_carry_units() -> None:
    rows = live_table.rows(_estimate().cameras["cam0"])
    assert rows[0] == ("position x", "80.00", "1.00", "mm")
    assert rows[6] == ("time shift", "-12.500", "0.100", "ms")


def test_sigmas_of_roll_pitch_yaw_are_those_of_sampled_rotations() -> None:
    x, y, z, w = Rotation.from_euler("ZYX", [87.0, 40.0, -120.0], degrees=True).as_quat(canonical=True)
    root = np.diag([1e-3, 2e-3, 3e-3]) @ np.array([[1.0, 0, 0], [0.5, 0.8, 0], [-0.3, 0.2, 0.9]])
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = root @ root.T
    errors = np.random.default_rng(3).standard_normal((20_000, 3)) @ root.T
    sampled = Rotation.from_quat([x, y, z, w]) * Rotation.from_rotvec(errors)
    yaw, pitch, roll = sampled.as_euler("ZYX", degrees=True).std(axis=0)
    np.testing.assert_allclose(euler_sigma_deg([w, x, y, z], covariance), [roll, pitch, yaw], rtol=0.03)


def test_the_screen_shows_cameras_and_health() -> None:
    from rich.console import Console

    console = Console(record=True, width=100, force_terminal=True, file=io.StringIO())
    health = {("rover", "imu/imu0"): ("ok", "100.0 Hz, 0 lost"), ("rover", "detect/cam0"): ("warn", "few")}
    console.print(live_table.screen({("rover", "cam0"): _estimate()}, health))
    text = console.export_text(clear=False)
    assert "cam0 in the imu frame" in text and "turn about x" in text and "100.0 Hz, 0 lost" in text
    assert "turn about x" in [line.strip() for line in text.splitlines()]  # a line of its own, not cut off
    assert "<svg" in console.export_svg(title="vical watch")
    console.print(live_table.screen({}, {}))
    assert "is `vical run` (vical.target) running?" in console.export_text()


def _result(p_m: Any, rotation: Rotation, shift_s: float, sigma: float) -> dict[str, Any]:
    x, y, z, w = rotation.as_quat(canonical=True)
    pose = {"p_m": list(p_m), "q_wxyz": [w, x, y, z], "covariance": (np.eye(6) * sigma**2).tolist()}
    camera = {"T_imu_cam": pose, "timeshift_cam_imu_s": shift_s, "timeshift_sigma_s": sigma}
    return {"status": "converged", "reason": "", "guidance": "", "cameras": {"cam0": camera}}


def test_errors_are_those_that_scipy_finds() -> None:
    true = Rotation.from_euler("xyz", [-90, 2, -88], degrees=True)
    error_rad = np.array([1e-3, -2e-3, 3e-3])
    estimated = true * Rotation.from_rotvec(error_rad)
    table = demo_truth.compare(
        _result([0.081, 0.02, -0.03], estimated, 0.0101, 1e-3),
        _result([0.08, 0.02, -0.03], true, 0.01, 0),
        "cam0",
    )
    errors = demo_truth.as_json(table)
    np.testing.assert_allclose(errors["p_m"], [1e-3, 0, 0], atol=1e-12)
    np.testing.assert_allclose(errors["r_rad"], error_rad, atol=1e-12)
    assert errors["timeshift_s"] == pytest.approx(1e-4)
    assert errors["largest_sigmas"] == pytest.approx(3.0)
    assert demo_truth.verdict({"status": "converged"}, table) == ""


def test_more_than_four_sigma_or_no_convergence_is_a_failure() -> None:
    true = Rotation.identity()
    truth = _result([0.08, 0.02, -0.03], true, 0.01, 0)
    wrong = demo_truth.compare(_result([0.085, 0.02, -0.03], true, 0.01, 1e-3), truth, "cam0")
    assert (
        demo_truth.verdict({"status": "converged"}, wrong)
        == "position x is 5.0 of its own sigmas from the truth"
    )
    unsure = {"status": "degenerate", "reason": "no rotation", "guidance": ""}
    assert "degenerate: no rotation" in demo_truth.verdict(unsure, wrong)
    exact = demo_truth.compare(_result([0.085, 0.02, -0.03], true, 0.01, 0), truth, "cam0")
    assert math.isinf(exact[0].sigmas) and demo_truth.verdict({"status": "converged"}, exact)


def test_the_truth_of_the_stamps_contains_what_the_host_adds() -> None:
    simulated = {"cameras": {"cam0": {"timeshift_cam_imu_s": -0.0125}}}
    truth = demo_truth.truth_of_stamps(simulated, 2e-4, 1e-5, "cam0")
    assert truth["cameras"]["cam0"]["timeshift_cam_imu_s"] == pytest.approx(-0.0123)
    assert truth["simulated_timeshift_s"] == -0.0125 and truth["imu_stamp_error_s"] == 2e-4
