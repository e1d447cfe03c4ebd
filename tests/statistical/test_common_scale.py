"""A factor common to target, lever arm, gravity and accelerometer shows in no image: it must not drift."""

import numpy as np
from vical_mocks.harness.feed import events_in_order, points_frame
from vical_mocks.points import SimulatedFrame, simulate

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior


def test_many_images_do_not_move_the_scale_of_everything():
    run = simulate(3, 60.0, timeshift_cam_imu_s=-0.012, corner_sigma_px=0.0075, camera_rate_hz=25.0)
    prior = CameraPrior(resolution=(640, 480), intrinsics=(510.0, 510.0, 320.0, 240.0))
    options = CalibrationOptions()
    calibrator = Calibrator(options, {"cam0": prior}, run.points_m)
    for _, event in events_in_order(run):
        if isinstance(event, SimulatedFrame):
            calibrator.add_points(points_frame(event))
            calibrator.process()
        else:
            calibrator.add_imu(int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])
    state = calibrator.filter.state
    known = options.gravity_sigma_mps2 / options.gravity_mps2  # all that is known of the factor
    off = [np.linalg.norm(state.gravity) / options.gravity_mps2, state.target_scale, state.accel_matrix[0, 0]]
    # 1500 images moved it by a whole sigma, always the same way
    assert np.abs(np.array(off) - 1.0).max() < 0.35 * known
