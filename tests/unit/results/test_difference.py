"""Differences of calibrations, the verdict on them, and what they mean in pixels; errors drawn by numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from vical_daemon.results.compare import FALSE_ALARM, judge
from vical_daemon.results.difference import NotComparableError, difference
from vical_daemon.results.export import Rig
from vical_daemon.results.known import KnownCamera, known_cameras
from vical_daemon.results.pixel_map import lens_displacement_px, pixel_map

LENS = np.array([458.0, 457.0, 367.0, 248.0, -0.28, 0.07, 2e-4, 2e-5])
SIGMA = np.array([1e-3] * 3 + [5e-4] * 3 + [5e-5] + [0.5] * 4 + [3e-3, 5e-3, 1e-4, 1e-4])


@pytest.fixture
def covariance(rng):
    """Correlated as pose and lens are: cx with a turn about y, fx with the distance."""
    mixed = np.eye(15) + 0.4 * rng.standard_normal((15, 15))
    P = mixed @ mixed.T
    scale = SIGMA / np.sqrt(np.diag(P))
    return P * np.outer(scale, scale)


@pytest.fixture
def known(covariance):
    R = Rotation.from_euler("zyx", [89.0, 1.5, 0.3], degrees=True).as_matrix()
    p = np.array([-0.02, -0.06, 0.01])
    return KnownCamera("cam0", "a.json", R, p, -5e-3, LENS.copy(), "radtan", (752, 480), covariance)


def moved(known, e):
    """The same calibration with errors applied (scipy's rotations)."""
    R = known.R_imu_cam @ Rotation.from_rotvec(e[3:6]).as_matrix()
    return replace(
        known,
        source="b.json",
        R_imu_cam=R,
        p_imu_cam=known.p_imu_cam + e[:3],
        timeshift_s=known.timeshift_s + e[6],
        lens=known.lens + e[7:],
    )


def test_difference_of_two_estimates_is_chi_square(known, covariance, rng):
    """Each test statistic is one draw of a chi-square with 15 degrees of freedom, z has unit variance."""
    squares, z = [], []
    for ea, eb in rng.multivariate_normal(np.zeros(15), covariance, (300, 2)):
        d = difference(moved(known, ea), moved(known, eb))
        squares.append(judge(d).chi_square)
        z.append(d.d / d.sigma)
    assert np.mean(squares) == pytest.approx(15.0, abs=4.0 * np.sqrt(30.0 / 300))
    assert np.var(z, axis=0) == pytest.approx(np.ones(15), abs=4.0 * np.sqrt(2.0 / 300))
    assert np.mean(np.array(squares) > chi2.isf(0.1, 15)) == pytest.approx(0.1, abs=0.07)


@pytest.mark.parametrize(
    ("at", "size", "name"),
    [(4, 0.02, "rotation"), (1, 0.03, "position"), (6, 2e-3, "time shift"), (7, 30.0, "lens")],
)
def test_the_block_that_has_moved_is_named(known, at, size, name):
    e = np.zeros(15)
    e[at] = size
    verdict = judge(difference(known, moved(known, e)))
    assert verdict.changed
    assert verdict.blocks == (name,)


def test_data_that_both_used_count_once(known, covariance):
    """Half of the data, and all of it: the difference varies by P_half - P_all = P_all, not by 3 P_all."""
    hashes = tuple(range(64))
    whole = replace(known, duration_s=60.0, reading_hashes=hashes)
    wider = replace(known, covariance=2.0 * covariance, duration_s=30.0)
    half = replace(wider, reading_hashes=hashes[::2] + tuple(range(64, 96)))
    d = difference(half, whole)
    assert d.common_s == pytest.approx(30.0)
    assert d.covariance == pytest.approx(covariance, rel=1e-6)
    later = replace(wider, reading_hashes=tuple(range(100, 164)))
    for other in (later, wider):
        assert difference(other, whole).covariance == pytest.approx(3.0 * covariance)


def test_a_lens_with_one_more_power_is_compared_by_what_it_projects(known, covariance):
    """radtan against itself as plumb_bob: no difference; with k3 the rest is what radtan cannot follow."""
    P = np.zeros((16, 16))
    P[:15, :15], P[15, 15] = covariance, 1e-6
    five = replace(known, model="plumb_bob", lens=np.append(LENS, 0.0), covariance=P)
    for a, b in ((known, five), (five, known)):
        d = difference(a, b)
        assert d.model == "radtan"
        assert np.abs(d.d / d.sigma).max() < 1e-6
        assert d.unlike_px < 1e-6
    other = replace(five, lens=np.append(LENS, 0.05))
    assert difference(known, other).unlike_px > 0.01
    assert difference(known, other).d == pytest.approx(-difference(other, known).d)


def test_what_cannot_be_compared_is_refused(known):
    with pytest.raises(NotComparableError, match="752 x 480 and of 640 x 480"):
        difference(known, replace(known, resolution=(640, 480)))
    with pytest.raises(NotComparableError, match="not the same camera: serial numbers A and B"):
        difference(replace(known, serials=("", "A")), replace(known, serials=("7", "B")))


def test_lenses_alone_are_compared_in_pixels(known, covariance):
    """cx 3 px off moves every point by 3 px; its sigma is that of cx, to first order."""
    off = np.zeros(8)
    off[2] = 3.0
    px, sigma = lens_displacement_px(known, off, covariance[7:, 7:])
    assert px == pytest.approx(3.0, rel=1e-6)
    assert 0.1 * SIGMA[9] < sigma < 3.0 * SIGMA[9]


def test_pixel_map_of_a_turn_is_its_angle_times_the_focal_length(known):
    e = np.zeros(15)
    e[3] = 0.01  # about x: points move by f * 0.01 up or down in the middle
    m = pixel_map(difference(known, moved(known, e)), 1e4)
    assert m is not None
    assert m.apart_px[3, 4] == pytest.approx(0.01 * 457.0, rel=0.02)
    assert 0.0 < m.least_px[3, 4] < m.apart_px[3, 4]


def test_least_pixels_are_none_where_the_verdict_is_same(known):
    d = difference(known, moved(known, 0.5 * SIGMA * np.where(np.arange(15) == 2, 1.0, 0.0)))
    assert judge(d).probability > FALSE_ALARM
    m = pixel_map(d, 1.0)
    assert m is not None
    assert m.apart_px.max() > 0.0
    assert m.least_px.max() == 0.0


def test_values_without_sigmas_get_assumed_ones_and_a_note(pinhole_camera):
    bare = replace(pinhole_camera, covariance=None, timeshift_sigma_s=None)
    known = known_cameras(Rig({"cam0": bare}), "chain.yaml")["cam0"]
    assert known.sigma[:7] == pytest.approx([1e-3] * 3 + [np.deg2rad(0.05)] * 3 + [1e-4])
    assert known.notes == (
        "chain.yaml: no sigma given, assumed: position 1 mm, rotation 0.05 deg, time shift 0.1 ms, "
        "lens 0.1 % of the focal length",
    )


def test_unknown_correlations_are_bounded(pinhole_camera, rng):
    """Any covariance with the blocks that older results give lies below the bound."""
    size = 15
    mixed = rng.standard_normal((size, size))
    P = mixed @ mixed.T * np.outer(SIGMA, SIGMA)
    blocks = replace(
        pinhole_camera,
        covariance=P[:6, :6],
        timeshift_sigma_s=float(np.sqrt(P[6, 6])),
        lens_sigma=tuple(np.sqrt(np.diag(P))[7:].tolist()),
    )
    known = known_cameras(Rig({"cam0": blocks}), "old.json")["cam0"]
    assert np.linalg.eigvalsh((known.covariance - P) / np.outer(SIGMA, SIGMA)).min() > -1e-9
    assert known.sigma == pytest.approx(np.sqrt(np.diag(P)))
