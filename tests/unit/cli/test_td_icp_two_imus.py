"""`vical td-icp --sensors imu0,imu1`: two gyros of one rig against each other."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from vical_mocks.rotations import exp_so3, log_so3
from vical_mocks.trajectory import hand_motion

from vical_daemon.cli import main
from vical_daemon.estimation.geometry.so3 import matrix_from_quat


def test_two_imus_are_registered_against_each_other(tmp_path: Path, capsys):
    rng, motion = np.random.default_rng(6), hand_motion(6, 50.0)
    R_first_second = exp_so3(np.array([0.3, -1.0, 0.5]))
    for name, R, late_s, bias in (("imu0", np.eye(3), 0.0, 0.004), ("imu1", R_first_second, 0.034, -0.008)):
        t = np.arange(2.0, 16.0, 0.005)
        gyro = motion.omega_imu_rps(t) @ R + bias + rng.normal(0, 7e-3, (len(t), 3))
        folder = tmp_path / "mav0" / name
        folder.mkdir(parents=True)
        rows = [
            f"{1_700_000_000_000_000_000 + round((a + late_s) * 1e9)},{w[0]},{w[1]},{w[2]},0,0,9.81"
            for a, w in zip(t, gyro, strict=True)
        ]
        (folder / "data.csv").write_text("\n".join(rows) + "\n")
    code = main(["td-icp", str(tmp_path), "--sensors", "imu0,imu1", "--json"])
    out, err = capsys.readouterr()
    assert code == 0, err
    sensor = json.loads(out)["sensors"]["imu1"]
    assert abs(sensor["timeshift_s"] + 0.034) < 4 * sensor["timeshift_sigma_s"] < 2e-3
    error = log_so3(R_first_second.T @ matrix_from_quat(np.array(sensor["R_ref_sensor_q_wxyz"])))
    assert np.all(np.abs(error) < 4 * np.array(sensor["rotation_sigma_rad"]))
