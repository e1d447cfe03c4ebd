"""Scale, factor and alarm: silent on honest innovations, right on inflated, correlated and jumping ones."""

import numpy as np
import pytest
from scipy.optimize import brentq

from vical_daemon.estimation.noise import consistency
from vical_daemon.estimation.noise.consistency import Consistency, modes
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.status.change_watch import DriftWatch

UV = np.stack(np.meshgrid(np.linspace(100, 400, 8), np.linspace(80, 300, 6)), -1).reshape(-1, 2)
SIGMA = np.full(len(UV), 0.5)
LINEAR = np.zeros((2 * len(UV), 3))


def feed(c, rng, frames, size=1.0, common=None):
    for k in range(frames):
        e = 0.5 * size * rng.normal(size=UV.shape)
        if common is not None:
            e = e + (modes(UV) @ common[k]).reshape(-1, 2)
        c.learn(c.images / 20.0, UV, e, LINEAR, np.eye(LINEAR.shape[1]), SIGMA * np.sqrt(c.scale))


@pytest.mark.parametrize("seed", range(6))
def test_honest_innovations_change_nothing(seed):
    c = Consistency()
    feed(c, np.random.default_rng(seed), 1200)
    assert c.scale == 1.0
    assert c.factor == 1.0
    assert c.fits
    assert not c.alarmed


def test_larger_innovations_raise_the_scale_to_their_level():
    c = Consistency()
    feed(c, np.random.default_rng(0), 1500, size=2.0)
    assert c.scale == pytest.approx(4.0, rel=0.15)
    assert c.factor == 1.0


@pytest.mark.parametrize(("told", "level"), [(True, 4.0), (False, 4.0 * 5 / 8)])
def test_what_clipped_readings_hide_does_not_count_as_a_good_fit(told, level):
    """Three ways of the image have next to no innovation for what is predicted of them."""
    c, rng, ways = Consistency(), np.random.default_rng(0), modes(UV)[:, :3]
    hidden = 20.0 * np.eye(3)
    for _ in range(1500):
        innovation = rng.normal(size=UV.shape)
        sigma = SIGMA * np.sqrt(c.scale)
        c.learn(c.images / 20.0, UV, innovation, ways, hidden, sigma, hidden if told else None)
    assert c.scale == pytest.approx(level, rel=0.15)


def test_errors_that_last_raise_the_factor_to_their_long_run_variance():
    rng, rho, n = np.random.default_rng(1), 0.8, 3000
    a = np.zeros((n, 8))
    for k in range(1, n):
        a[k] = rho * a[k - 1] + np.sqrt(1 - rho**2) * rng.normal(size=8)
    c = Consistency()
    feed(c, rng, n, common=a)  # they are larger than what the scale can explain, too
    assert c.level > 5.0
    assert c.factor == pytest.approx(c.level * (1 + rho) / (1 - rho), rel=0.35)  # less what the window cuts
    assert not c.fits


@pytest.mark.parametrize("seed", range(6))
def test_larger_innovations_that_the_predicted_motion_dominates_raise_the_factor(seed):
    """At few images a second more weight for the motion than for corners: the scale explains nothing."""
    c, rng, ways = Consistency(), np.random.default_rng(seed), modes(UV)
    for _ in range(200):
        common = (ways @ rng.normal(size=8) * 2.0).reshape(-1, 2)
        c.learn(c.images / 5.0, UV, common, ways, np.eye(8), SIGMA * np.sqrt(c.scale))
    assert 2.0 < c.factor < 6.0
    assert c.fits is False


def test_a_model_fits_only_where_errors_that_last_are_ruled_out():
    """0.8 sigma in one direction: in 90 images too little to widen sigmas, too much to say that all fits."""
    fits, factors = [], []
    for seed in range(20):
        c = Consistency()
        feed(c, np.random.default_rng(seed), 90, common=np.tile(0.04 * np.eye(8)[0], (90, 1)))
        fits.append(c.fits)
        factors.append(c.factor)
    assert factors.count(1.0) >= 15
    assert fits.count(True) <= 5


def test_whether_the_model_fits_is_not_known_from_a_few_images():
    c = Consistency()
    feed(c, np.random.default_rng(0), 30)
    assert c.fits is None


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 60.0])
def test_the_factor_does_not_depend_on_the_rate_of_the_images(rate_hz):
    """Errors that last for half a second count as many images as that is."""
    rng, n = np.random.default_rng(4), int(200 * rate_hz)
    rho = np.exp(-2.0 / rate_hz)
    a = np.zeros((n, 8))
    for k in range(1, n):
        a[k] = rho * a[k - 1] + np.sqrt(1 - rho**2) * rng.normal(size=8)
    c = Consistency(memory=n)
    for k in range(n):
        c.learn(
            k / rate_hz,
            UV,
            np.median(SIGMA) / np.sqrt(len(UV)) * (modes(UV) @ a[k]).reshape(-1, 2),
            LINEAR,
            np.eye(3),
            SIGMA,
        )
    assert c.factor == pytest.approx((1 + rho) / (1 - rho), rel=0.35)


def lasting(seed, lasts_s, seconds, rate_hz=20.0):
    """Innovations of which half the variance lasts for so long; the factor after 4 s and at the end."""
    rng, n = np.random.default_rng(seed), int(seconds * rate_hz)
    rho = np.exp(-1.0 / (lasts_s * rate_hz))
    a, factors, c = rng.normal(size=8), [], Consistency(memory=n)
    for k in range(n):
        a = rho * a + np.sqrt(1.0 - rho**2) * rng.normal(size=8)
        own = np.median(SIGMA) / np.sqrt(len(UV)) * np.sqrt(0.5) * (a + rng.normal(size=8))
        c.learn(k / rate_hz, UV, (modes(UV) @ own).reshape(-1, 2), LINEAR, np.eye(3), SIGMA)
        factors.append(c.factor)
    return factors[int(4.0 * rate_hz)], factors[-1]


def test_the_factor_of_the_first_seconds_is_that_of_many():
    """Errors that last for seconds look shorter in sums over under a second; they might last even longer."""
    early, late = np.transpose([lasting(seed, lasts_s=2.0, seconds=40.0) for seed in range(20)])
    assert late.mean() == pytest.approx(1.0 + 0.5 * 59 * 0.65, rel=0.2)  # 0.65: mean correlation within 3 s
    assert 0.9 < early.mean() / late.mean() < 1.5
    assert early.min() > 0.4 * late.mean()


def test_larger_errors_that_do_not_last_are_not_extrapolated():
    """White innovations of five times their variance, for 4 s."""
    factors = []
    for seed in range(20):
        c, ways, rng = Consistency(), modes(UV), np.random.default_rng(seed)
        for k in range(90):
            common = (ways @ rng.normal(size=8) * 2.0).reshape(-1, 2)
            c.learn(k / 20.0, UV, common, ways, np.eye(8), SIGMA * np.sqrt(c.scale))
        factors.append(c.factor / c.level)
    assert 0.7 < np.median(factors) < 1.5


def test_honest_innovations_seldom_widen_the_sigmas_of_the_first_seconds():
    """In 100 rigs, 4 s to 10 s: three standard deviations."""
    wide = 0
    for seed in range(100):
        c, rng = Consistency(), np.random.default_rng(seed)
        feed(c, rng, 70)
        for _ in range(12):
            feed(c, rng, 10)
            wide += c.factor > 1.0
    assert wide <= 0.01 * 100 * 12


def test_a_jump_is_an_alarm_within_half_a_second():
    c = Consistency()
    feed(c, np.random.default_rng(2), 400)
    for k in range(10):
        feed(c, np.random.default_rng(k), 1, common=np.full((1, 8), 0.5))
        if c.alarmed:
            return
    pytest.fail("no alarm")


def test_the_larger_the_misfit_the_more_it_takes_to_alarm():
    """Half a board at the edge of a badly fitting lens is no bump; a jump of two sigmas still is one."""
    c, rng = Consistency(), np.random.default_rng(0)
    feed(c, rng, 1500, size=2.0)
    c.alarm = 1.9 * consistency._CUSUM_LIMIT
    assert c.scale == pytest.approx(4.0, rel=0.15)
    assert not c.alarmed
    alarms = []
    for _ in range(10):
        feed(c, rng, 1, size=2.0, common=np.full((1, 8), 1.0))
        alarms.append(c.alarmed)
    assert any(alarms)


def test_most_small_changes_are_an_alarm_within_two_seconds():
    """Innovations of twice their variance; what is not noticed soon is taken for noise, by the scale."""
    delays = []
    for seed in range(20):
        c, rng = Consistency(), np.random.default_rng(seed)
        feed(c, rng, 400)
        while not c.alarmed and c.images < 600:
            feed(c, rng, 1, size=np.sqrt(2.0))
        delays.append(c.images - 390)
    assert np.median(delays) <= 40


def test_errors_to_one_side_are_suspicious_within_three_seconds_however_small():
    """A tenth of the noise of the corners, which no single image shows."""
    c, rng = Consistency(), np.random.default_rng(5)
    for _ in range(60):
        feed(c, rng, 10)
        assert not c.suspicious
    noticed = []
    for _ in range(60):
        feed(c, rng, 1, common=np.full((1, 8), 0.1 * 0.5))
        noticed.append(c.suspicious)
    assert any(noticed)
    assert c.suspicion < 2.0


def test_chance_is_no_alarm():
    """Chernoff: exp(-h limit) with E exp(h (ratio - drift)) = 1, ratio of eight degrees of freedom."""
    h = brentq(lambda h: -4.0 * np.log(1.0 - h / 4.0) - h * consistency._CUSUM_DRIFT, 0.1, 3.99)
    assert np.exp(-h * consistency._CUSUM_LIMIT) < 1e-10


def test_corner_noise_is_learnt_and_outliers_cannot_blow_it_up():
    rng, noise = np.random.default_rng(3), CornerNoise(0.5)
    for _ in range(300):
        noise.learn(float((0.2 / noise.sigma_px) ** 2 * rng.chisquare(60)), 60)
    assert noise.sigma_px == pytest.approx(0.2, rel=0.05)
    noise.learn(1e9, 60)
    assert noise.sigma_px < 0.25


def test_corner_noise_keeps_the_detectors_relative_weights():
    noise = CornerNoise(0.4)
    s = noise.sigmas(np.array([0.1, 0.1, 0.2]), 3)
    assert s[2] == pytest.approx(2 * s[0])
    assert np.sqrt(np.mean(s**2)) == pytest.approx(0.4)


def kalman_constant(rng, steps, slope=0.0):
    """A filter that takes a parameter as constant, and the parameter it tracks."""
    x, P = 0.0, 1e-6
    for t in range(steps):
        z = slope * t + 1e-3 * rng.normal()
        K = P / (P + 1e-6)
        x, P = x + K * (z - x), (1 - K) * P
        yield float(t), x, P


@pytest.mark.parametrize("seed", range(20))
def test_no_drift_is_seen_where_there_is_none(seed):
    watch = DriftWatch(1e-9)
    assert not any(
        watch.drifts(t, x, P, 1.0) for t, x, P in kalman_constant(np.random.default_rng(seed), 600)
    )


def test_a_slow_drift_is_seen():
    watch = DriftWatch(1e-9)
    assert any(watch.drifts(t, x, P, 1.0) for t, x, P in kalman_constant(np.random.default_rng(0), 200, 2e-4))
