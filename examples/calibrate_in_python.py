"""The estimator without daemon, bus or files: samples in, calibration out.

The samples come from the simulated rig of vical_mocks, so that this runs anywhere and the truth is known.
"""

from __future__ import annotations

import os

# before numpy is imported: matrices are small, and threads of BLAS make a run several times slower
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from vical_mocks.points import simulate

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame


def main(seconds: float = 20.0) -> float:
    """Calibrate and print; returns the error of the lever arm in metres."""
    run = simulate(seed=3, duration_s=seconds, timeshift_cam_imu_s=-0.012)
    prior = CameraPrior(resolution=(640, 480), intrinsics=(510.0, 510.0, 320.0, 240.0))
    calibrator = Calibrator(CalibrationOptions(), {"cam0": prior}, run.points_m)

    frames = iter(run.frames)
    frame = next(frames, None)
    samples = zip(run.t_imu_ns.tolist(), run.gyro_rps, run.specific_force_mps2, strict=True)
    for t_ns, gyro, force in samples:
        calibrator.add_imu(t_ns, gyro, force)
        while frame is not None and frame.t_cam_ns <= t_ns:
            calibrator.add_points(PointsFrame("cam0", frame.t_cam_ns, frame.ids, frame.uv_px))
            calibrator.process()
            frame = next(frames, None)
    calibrator.finish()

    estimate = calibrator.estimate()
    print(f"{estimate.status}: {estimate.reason or estimate.guidance}")
    if "cam0" not in estimate.cameras:  # too short: there is no first solution yet
        return float("inf")
    camera = estimate.cameras["cam0"]
    sigma = np.sqrt(np.diag(camera.T_imu_cam.covariance))
    truth = run.truth()["cameras"]["cam0"]
    for i, axis in enumerate("xyz"):
        found, true = camera.T_imu_cam.p_m[i], truth["T_imu_cam"]["p_m"][i]
        print(f"lever arm {axis}: {1e3 * found:8.2f} ± {1e3 * sigma[i]:.2f} mm, truth {1e3 * true:8.2f}")
    shift, shift_sigma = 1e3 * camera.timeshift_cam_imu_s, 1e3 * camera.timeshift_sigma_s
    print(f"time shift: {shift:.3f} ± {shift_sigma:.3f} ms, truth {1e3 * truth['timeshift_cam_imu_s']:.3f}")
    return float(np.linalg.norm(np.subtract(camera.T_imu_cam.p_m, truth["T_imu_cam"]["p_m"])))


if __name__ == "__main__":
    main()
