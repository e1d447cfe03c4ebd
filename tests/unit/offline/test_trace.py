"""The trace of a calibration: what each estimate said, once."""

import numpy as np

from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    ImuEstimate,
    PoseEstimate,
    Status,
)
from vical_daemon.offline import trace as module
from vical_daemon.offline.trace import Trace


def estimate(t_s, *cameras, imu=True):
    pose = PoseEstimate([t_s, 0.2, 0.3], [1.0, 0.0, 0.0, 0.0], np.diag([1e-4] * 3 + [4e-6] * 3).tolist())
    each = CameraEstimate(
        pose, 0.01, 1e-4, [5.0, 5.0, 4.0, 3.0], [0.0] * 4, "radtan", [0.0] * 4, [0.0] * 4, 0.2
    )
    biases = ImuEstimate([0.1] * 3, [0.01] * 3, [0.2] * 3, [0.02] * 3) if imu else None
    known = dict.fromkeys(cameras, each)
    return CalibrationEstimate(1, Status.CONVERGING, "", 0.5, "", t_s, 2, 3, known, biases, [], 1.1, 0.0)


def test_each_camera_has_what_was_known_of_it():
    trace = Trace(["left", "right"])
    trace.take(estimate(1.0))
    trace.take(estimate(2.0, "left", imu=False))
    trace.take(estimate(3.0, "left", "right"))
    trace.take(estimate(3.0, "left", "right"))  # at the end, without newer data
    assert [point["t_s"] for point in trace.points["left"]] == [2.0, 3.0]
    assert [point["t_s"] for point in trace.points["right"]] == [3.0]
    first, last = trace.points["left"]
    assert first["gyro_bias_rps"] == [] and last["gyro_bias_rps"] == [0.1] * 3
    np.testing.assert_allclose(last["p_m"], [3.0, 0.2, 0.3])
    np.testing.assert_allclose(last["p_sigma_m"] + last["r_sigma_rad"], [1e-2] * 3 + [2e-3] * 3)
    assert (last["timeshift_s"], last["timeshift_sigma_s"]) == (0.01, 1e-4)
    assert (last["status"], last["nis_per_dof"]) == ("converging", 1.1)


def test_a_long_one_is_thinned_in_its_older_half(monkeypatch):
    monkeypatch.setattr(module, "_MOST", 8)
    trace = Trace(["left"])
    for t_s in range(1, 10):
        trace.take(estimate(float(t_s), "left"))
    assert [point["t_s"] for point in trace.points["left"]] == [1.0, 3.0, 5.0, 6.0, 7.0, 8.0, 9.0]
