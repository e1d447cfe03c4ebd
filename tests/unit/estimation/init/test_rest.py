"""rest.py, initializer.py: a rig at rest is noticed, and no start is tried from it."""

import numpy as np
import pytest
from vical_mocks.points import board_points

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init.attempts import RestDetector, rest_in_words
from vical_daemon.estimation.init.initializer import Initializer
from vical_daemon.estimation.init.rig_model import RigModel
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame

F_PX = 500.0
RATE_HZ = 20.0
IDS = np.arange(48)
AT_REST_PX = 320.0 + 300.0 * board_points()[:, :2]


def image(t_s, shift_px, rng, sigma_px=0.5):
    uv = AT_REST_PX + np.array([shift_px, 0.0]) + rng.normal(0.0, sigma_px, AT_REST_PX.shape)
    return PointsFrame("cam0", round(t_s * 1e9), IDS, uv)


def readings(rate_dps, seconds=2.0):
    """Those of a rig that swings at a rate with this peak."""
    rng, buffer = np.random.default_rng(7), ImuBuffer(0)
    for t_s in np.arange(0.0, seconds, 0.01):
        swing = np.array([0.01, 0.0, np.deg2rad(rate_dps) * np.cos(6.0 * t_s)])
        buffer.append(t_s, swing + rng.normal(0.0, 0.002, 3), [0.0, 0.0, 9.8])
    return buffer


@pytest.mark.parametrize(("rate_dps", "turns"), [(0.0, False), (5.0, False), (60.0, True)])
def test_images_at_rest_while_the_gyro_turns_are_no_rig_at_rest(rate_dps, turns):
    """The camera looks at something fixed to the rig, or its driver repeats an image."""
    said = rest_in_words(readings(rate_dps), "turn it")
    assert said.startswith("the IMU turns but the camera does not") is turns
    assert (said == "the rig is at rest: turn it") is not turns


@pytest.mark.parametrize(("rate_dps", "rests"), [(0.0, True), (0.05, True), (0.5, False), (30.0, False)])
def test_slower_than_any_useful_rotation_is_rest(rate_dps, rests):
    rng, detector = np.random.default_rng(1), RestDetector()
    for t_s in np.arange(0.0, 2.0, 1.0 / RATE_HZ):
        detector.take(t_s, image(t_s, F_PX * np.deg2rad(rate_dps) * t_s, rng))
    assert detector.rests is rests


def test_turning_about_the_optical_axis_is_no_rest():
    detector, middle = RestDetector(), AT_REST_PX.mean(axis=0)
    for t_s in np.arange(0.0, 2.0, 1.0 / RATE_HZ):
        c, s = np.cos(0.1 * t_s), np.sin(0.1 * t_s)
        uv = middle + (AT_REST_PX - middle) @ np.array([[c, s], [-s, c]])
        detector.take(t_s, PointsFrame("cam0", round(t_s * 1e9), IDS, uv))
    assert not detector.rests


def test_images_that_share_no_corners_show_no_rest():
    detector = RestDetector()
    for k in range(100):
        detector.take(k / RATE_HZ, PointsFrame("cam0", k, IDS[:8] + 10 * k, AT_REST_PX[:8]))
    assert not detector.rests


def test_no_start_is_tried_from_a_minute_at_rest_and_soon_from_what_follows():
    options = CalibrationOptions()
    rig = RigModel(options, {"cam0": CameraPrior((752, 480))}, board_points())
    starting = Initializer(options, rig, None)
    rng, why = np.random.default_rng(2), None
    at_rest = readings(0.0)
    for t_s in np.arange(0.0, 60.0, 1.0 / RATE_HZ):
        starting.take([(t_s, image(t_s, 0.0, rng))])
        if starting.due(t_s):
            why = starting.attempt(at_rest, may_be_partial=True)
    assert "at rest" in why.reason
    assert why.motion_missing
    assert starting.oldest_s > 59.9
    tried_s = None
    for t_s in np.arange(60.0, 66.0, 1.0 / RATE_HZ):
        starting.take([(t_s, image(t_s, 50.0 * (t_s - 60.0), rng))])
        if starting.due(t_s):
            why = starting.attempt(at_rest, may_be_partial=True)
            if not why.reason.startswith(("the rig is at rest", "collecting")):
                tried_s = t_s
                break
    assert 63.0 <= tried_s < 63.6
    for t_s in np.arange(66.0, 90.0, 1.0 / RATE_HZ):  # it comes to rest again: what it had to show was tried
        starting.take([(t_s, image(t_s, 300.0, rng))])
        assert t_s < 67.1 or not starting.due(t_s)
