"""`vical td-icp` on small real recordings from ../shared, against what is known about each (README there)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.td_icp_streams import study_real
from vical_daemon.cli import main
from vical_daemon.estimation.geometry.so3 import log, matrix_from_quat

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"


def _folder(name: str) -> Path:
    if not (REAL / name).is_dir():
        pytest.skip(f"no {REAL / name}")
    return REAL / name


def test_a_camera_with_a_real_lens_before_a_board(capsys):
    """A lens adjusted to the views at the edge of the image put a window off by 1.3 ms, 3.6 sigma."""
    folder = REAL.parent / "euroc_imu_april"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    study_real(folder)
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.endswith("| ok |")]
    delay_us, sigma_us = np.array([[float(row[3]), float(row[4])] for row in rows]).T
    assert len(rows) == 17
    assert np.abs(delay_us / sigma_us).max() < 3.0
    assert np.abs(delay_us).max() < 300.0  # a hardware trigger
    assert sigma_us[-1] < 40.0


def _one(folder: Path, pattern: str) -> str:
    return str(next(iter(folder.glob(pattern))))


def _td_icp(capsys: Any, *args: object) -> dict[str, Any]:
    code = main(["td-icp", *map(str, args), "--json"])
    out, err = capsys.readouterr()
    assert code == 0, err
    result: dict[str, Any] = json.loads(out)
    return result


def _turned_deg(q: list[float], known: list[float]) -> np.ndarray:
    known_R = matrix_from_quat(np.array(known) / np.linalg.norm(known))
    return np.rad2deg(log(known_R.T @ matrix_from_quat(np.array(q))))


def test_the_hand_of_a_robot_arm_and_its_camera(capsys):
    folder = _folder("robot_arm")
    result = _td_icp(capsys, _one(folder, "*base_link*"), "--sensors", _one(folder, "*target_ir.csv"))
    (sensor,) = result["sensors"].values()
    assert abs(sensor["timeshift_s"] + 0.0195) < 3 * sensor["timeshift_sigma_s"] < 6e-3
    error = _turned_deg(sensor["R_ref_sensor_q_wxyz"], [0.6001, -0.6058, 0.3722, -0.3664])
    assert np.linalg.norm(error) < 1.0


def test_a_camera_before_a_board_with_noisy_orientations(capsys):
    folder = _folder("prime_sense")
    result = _td_icp(capsys, _one(folder, "*vicon*"), "--sensors", _one(folder, "*raw.csv"))
    (sensor,) = result["sensors"].values()
    assert abs(sensor["timeshift_s"] - 0.015) < 3 * sensor["timeshift_sigma_s"] + 0.005
    assert sensor["timeshift_sigma_s"] < 5e-3
    assert sensor["widened"] > 1.0  # its delay wanders by more than the noise explains


def test_two_gyros_that_mostly_rest(capsys):
    folder = _folder("two_gyros")
    result = _td_icp(capsys, folder, "--sensors", f"imu0,{folder / 'mcu.tum'}")
    sensor = result["sensors"]["mcu.tum"]
    # published: 947848.638 s, of which 947848.0 s are applied
    assert abs(sensor["timeshift_s"] - 0.638) < 3 * sensor["timeshift_sigma_s"] + 0.5e-3
