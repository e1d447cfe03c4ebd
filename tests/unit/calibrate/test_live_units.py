"""An IMU in other units, or with swapped sensors: a live user is told as one with a file is."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import decode_calibration, encode_imu, encode_points
from vical_daemon.calibrate.estimators import input_keys, make_estimator
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import loads
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, Status

RATE_HZ = 100
CONFIG = (
    "rig: rover\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
    "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [16, 16], rate_hz: 10}}\n"
)
PRIOR = CameraPrior((16, 16), (5.0, 5.0, 8.0, 8.0))


def readings(seconds, rate_rps=0.5):
    """Rates and forces of a rig that is turned by hand."""
    t_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    axes = np.column_stack([np.sin(1.3 * t_s), np.sin(0.9 * t_s + 1.0), np.sin(1.7 * t_s + 2.0)])
    gyro = rate_rps * axes
    turned, force = Rotation.identity(), []
    for rate in gyro:
        force.append(turned.inv().apply([0.0, 0.0, 9.81]))
        turned *= Rotation.from_rotvec(rate / RATE_HZ)
    rng = np.random.default_rng(0)
    noise = 0.002 * rng.standard_normal((len(t_s), 6))
    return gyro + noise[:, :3], np.array(force) + 10.0 * noise[:, 3:]


def published(gyro, force, *, board=True) -> list[CalibrationEstimate]:
    """What the role says of cam0 while these come in real time."""
    config = loads(CONFIG + ("target: t.yaml\n" if board else "calibration: {mode: target_free}\n"))
    estimator = (
        Calibrator(CalibrationOptions(), {"cam0": PRIOR}, np.eye(4, 3)) if board else make_estimator(config)
    )
    role, found = EstimateRole(config, estimator), []
    key, images = topics.IMU.key("rover", "imu0"), input_keys(config)[-1]
    for k, (w, f) in enumerate(zip(gyro.tolist(), force.tolist(), strict=True)):
        t_ns = 10**18 + k * 10**9 // RATE_HZ
        role.take(Sample(key, encode_imu(t_ns, "imu0", w, f), 0))
        if k % 10 == 0:
            role.take(Sample(images, encode_points(t_ns, "cam0", [k], np.array([[1.0 + k % 7, 2.0]])), 0))
        for where, payload in role.step(100.0 + k / RATE_HZ):
            if where == topics.CALIBRATION.key("rover", "cam0"):
                found.append(decode_calibration(payload).estimate)
    return found


@pytest.mark.parametrize("board", [True, False], ids=["board", "no board"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda w, f: (np.rad2deg(w), f), "it looks like deg/s: multiply by pi/180"),
        (lambda w, f: (w, f / 9.80665), "it looks like g: multiply by 9.80665"),
        (lambda w, f: (np.rad2deg(w) / 3.0, f / 9.80665), "it looks like g: multiply by 9.80665"),
        (lambda w, f: (f, w), "their columns seem to be swapped"),
    ],
    ids=["deg/s", "g", "both", "swapped"],
)
def test_the_cause_is_in_status_and_events(change, says, board):
    estimates = published(*change(*readings(12.0)), board=board)
    assert estimates[-1].status is Status.INCONSISTENT
    assert says in estimates[-1].reason
    events = [event for estimate in estimates for event in estimate.events]
    assert [event.kind for event in events] == [EventKind.IMU_UNITS]  # once; the journal has it from here
    assert "seem to be swapped" not in events[0].said or "swapped" in says


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda w, f: (w, f * 1000.0 / 9.80665), r"its readings are refused: a force of .* is it in mg\?"),
        (lambda w, f: (w + 100.0, f), r"its readings are refused: a rate of .* is it in deg/s\?"),
    ],
    ids=["mg", "deg/s"],
)
def test_readings_that_are_refused_are_not_called_missing_alone(change, says):
    last = published(*change(*readings(12.0)))[-1]
    assert last.status is Status.WAITING
    assert re.search(f"nothing from imu0 yet, after .* s: {says}", last.reason)


@pytest.mark.parametrize("rate_rps", [1.5, 2.0, 3.0])
def test_readings_in_degrees_that_are_refused_in_part_are_named_and_not_called_gaps(rate_rps):
    """Above 70 of them a second; the others look like a gyro in rad/s with holes."""
    gyro, force = readings(14.0, rate_rps)
    estimates = published(np.rad2deg(gyro), force)
    assert re.search(r"its readings are refused|% of imu0's readings are refused", estimates[-1].reason)
    assert "is it in deg/s?" in estimates[-1].reason
    events = [event.kind for estimate in estimates for event in estimate.events]
    assert events == [EventKind.IMU_UNITS]


@pytest.mark.parametrize("at", [20, 700])
def test_one_damaged_reading_is_not_spoken_of(at):
    gyro, force = readings(12.0)
    gyro[at] = 1e6
    estimates = published(gyro, force)
    assert not [event for estimate in estimates for event in estimate.events]
    assert "refused" not in estimates[-1].reason


def test_the_right_units_are_not_spoken_of():
    for rate_rps in (0.0, 0.05, 0.5, 3.0):
        estimates = published(*readings(12.0, rate_rps))
        assert not [event for estimate in estimates for event in estimate.events]
        assert estimates[-1].status is not Status.INCONSISTENT


def test_a_clock_that_is_set_back_does_not_end_the_check():
    estimator = Calibrator(CalibrationOptions(), {"cam0": PRIOR}, np.eye(4, 3))
    gyro, force = readings(16.0)
    for k, (w, f) in enumerate(zip(gyro, force / 9.80665, strict=True)):
        back_ns = 3600 * 10**9 * (k >= 400)
        estimator.add_imu(10**18 - back_ns + k * 10**9 // RATE_HZ, w.tolist(), f.tolist())
    assert "it looks like g" in estimator.estimate().reason
