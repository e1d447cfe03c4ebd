"""An accelerometer behind a slow filter: its readings are moved by whole intervals; the rest is small."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, lfilter
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import simulate

from vical_daemon.bus.messages import decode_imu, encode_imu
from vical_daemon.config.priors import read_initial
from vical_daemon.logs import open_recording
from vical_daemon.offline.accel_shift import AccelShift
from vical_daemon.offline.calibrate import document, run_job
from vical_daemon.offline.calibration_job import make_job

STEP_NS = 10_000_000


def readings(count: int, first: int = 0) -> list[bytes]:
    """Rate and force say which reading it is."""
    return [encode_imu(k * STEP_NS, "imu0", [k, 0, 0], [0, k, 0]) for k in range(first, first + count)]


def pairs(shift: AccelShift, payloads: list[bytes]) -> list[tuple[int, int, int]]:
    """Number of the stamp, of the rate and of the force of what comes out."""
    found = [decode_imu(p) for p in map(shift.take, payloads) if p is not None]
    return [(m.stamp_ns // STEP_NS, int(m.gyro_rps[0]), int(m.specific_force_mps2[1])) for m in found]


@pytest.mark.parametrize("late", [2, -2, 0])
def test_each_rate_gets_the_force_of_another_reading(late: int) -> None:
    wanted = [(k, k, k + late) for k in range(8) if 0 <= k + late < 8]
    assert pairs(AccelShift(late), readings(8)) == wanted


@pytest.mark.parametrize("late", [2, -2])
def test_a_gap_is_not_bridged(late: int) -> None:
    found = pairs(AccelShift(late), [*readings(5), *readings(5, first=100)])
    assert all(force == k + late for k, _, force in found)
    assert len(found) == 6


def test_what_holds_no_reading_passes() -> None:
    assert AccelShift(3).take(b"nonsense") == b"nonsense"


def test_an_accelerometer_behind_a_filter_of_10_hz(tmp_path: Path) -> None:
    run = simulate(700, 24.0, corner_sigma_px=0.3)
    force, rate_hz = run.specific_force_mps2, 1e9 / float(np.median(np.diff(run.t_imu_ns)))
    slow = force[0] + lfilter(*butter(2, 10.0 / (rate_hz / 2)), force - force[0], axis=0)
    folder = write_asl(tmp_path / "late", replace(run, specific_force_mps2=slow))
    initial = read_initial(folder / "initial.yaml")
    job = make_job(open_recording(folder), initial, target=str(folder / "target.yaml"))
    result = document(job, run_job(job, lambda *_: None))
    assert job.accel_late == round(0.0225 * rate_hz)  # sqrt(2) / (2 pi 10 Hz)
    assert "the accelerometer is behind the gyro: its readings were moved by 20 ms" in result["warnings"][-1]
    lags = [event["value"] for event in result["events"] if event["kind"] == "accel_lag"]
    assert lags == [pytest.approx(0.0225, abs=1.5e-3)]
    assert not {"bumped", "target_size", "imu_noise"} & {event["kind"] for event in result["events"]}
    truth, found = run.truth()["cameras"]["cam0"], result["cameras"]["cam0"]
    assert np.abs(np.subtract(found["T_imu_cam"]["p_m"], truth["T_imu_cam"]["p_m"])).max() < 2e-3
    assert found["timeshift_cam_imu_s"] == pytest.approx(truth["timeshift_cam_imu_s"], abs=1e-4)
