"""Units of an IMU by gravity: right ones are accepted however the rig moves, wrong ones are named."""

from __future__ import annotations

import numpy as np
import pytest
from vical_mocks import trajectory

from vical_daemon.estimation.inertial.units import ImuArrays, unit_mistake

G = np.array([0.0, 0.0, 9.80665])
WINDOWS = [(0.0, 10.0), (10.0, 20.0), (0.0, 20.0)]


def readings(motion):
    """Rates and forces of 20 s at 50 Hz, with noise and biases."""
    rng, t_s = np.random.default_rng(0), np.arange(0.0, 20.0, 0.02)
    R, a = motion.R_world_imu(t_s), motion.a_world_imu(t_s)
    force = np.einsum("nji,nj->ni", R, a + G) + 0.02 * rng.standard_normal((len(t_s), 3))
    gyro = motion.omega_imu_rps(t_s) + 0.002 * rng.standard_normal((len(t_s), 3)) + 0.02
    return t_s, gyro, force


def said(t_s, gyro, force):
    texts = []
    for begin_s, end_s in WINDOWS:
        m = (t_s >= begin_s) & (t_s < end_s)
        texts.append(unit_mistake(ImuArrays((1e9 * t_s[m]).astype(np.int64), gyro[m], force[m])))
    return texts


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("dps", [2.0, 40.0, 200.0, 250.0])
def test_hand_motion_is_accepted(seed, dps):
    """At 200 deg/s the accelerometer reads 17 m/s^2 in the middle: gravity was called removed."""
    assert said(*readings(trajectory.hand_motion(seed, dps))) == ["", "", ""]


@pytest.mark.parametrize("make", ["still", "constant_rate", "pure_translation", "planar", "fronto_parallel"])
@pytest.mark.parametrize("seed", range(5))
def test_special_motion_is_accepted(make, seed):
    """By chance, noise of a gyro at rest looked like 46 times what gravity shows."""
    if make in ("still", "constant_rate"):
        motion = getattr(trajectory, make)()
    else:
        motion = getattr(trajectory, make)(seed)
    assert said(*readings(motion)) == ["", "", ""]


@pytest.mark.parametrize("dps", [4.0, 10.0, 40.0, 100.0])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda w, f: (np.rad2deg(w), f), "looks like deg/s"),
        (lambda w, f: (w, f / 9.80665), "looks like g"),
        (lambda w, f: (np.rad2deg(w), f / 9.80665), "looks like g"),
        (lambda w, f: (f, w), "seem to be swapped"),
        (lambda w, f: (w, f * 101.97), "looks like mg"),
    ],
    ids=["deg/s", "g", "deg/s and g", "swapped", "mg"],
)
def test_a_wrong_unit_is_named(dps, change, says):
    t_s, gyro, force = readings(trajectory.hand_motion(1, dps))
    assert says in said(t_s, *change(gyro, force))[-1]


@pytest.mark.parametrize("seed", range(5))
def test_g_in_violent_motion_is_not_called_removed_gravity_alone(seed):
    """At 200 deg/s 1.7 g and no gravity at all turn alike: both are named."""
    t_s, gyro, force = readings(trajectory.hand_motion(seed, 200.0))
    assert all("looks like g" in text for text in said(t_s, gyro, force / 9.80665))
    t_s, gyro, force = readings(trajectory.hand_motion(seed, 100.0))
    assert all("looks like g" in text for text in said(t_s, gyro, force / 9.80665))
