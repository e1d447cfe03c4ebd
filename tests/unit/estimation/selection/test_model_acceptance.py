"""beyond_doubt.py: what is announced, and what becomes of the filter."""

import numpy as np
import pytest

from tests.unit.estimation.some_filter import NAME, imu_entries, off, some_filter
from vical_daemon.estimation.model.priors import KNOWN_OFF_SIGMA, KNOWN_SIZE_SIGMA
from vical_daemon.estimation.model.state import ATTITUDE, GRAVITY, POSITION
from vical_daemon.estimation.selection.model_acceptance import ModelAcceptance
from vical_daemon.estimation.selection.model_selection import IMU, LAG, SIZE, TARGET
from vical_daemon.estimation.wording import event_text


def straight(f, P):
    """Covariance of the errors that mean the same after a step: neither turned nor moved by a turn."""
    turned = np.r_[ATTITUDE, POSITION, GRAVITY, f.layout.cameras[NAME].rotation]
    keep = np.setdiff1d(np.arange(len(P)), turned)
    return P[np.ix_(keep, keep)]


def surest(values, P, where):
    z = np.abs(values[where]) / np.sqrt(np.diag(P)[where])
    k = where[np.argmax(z)]
    return abs(values[k]), np.sqrt(P[k, k])


def test_an_imu_announced_gives_the_answer_of_a_wide_prior():
    f, _, _, dense = some_filter(3.0)
    beyond = ModelAcceptance()
    events = beyond.look(f)
    assert list(events) == [IMU]
    assert off(f, IMU) == pytest.approx(1.0, abs=1e-12)
    assert off(f, TARGET) < 0.05
    f.state.t_s += 2.0
    assert beyond.look(f) == {}
    wide, entries = dense.prior.copy(), dense.where[IMU]
    wide[entries] = KNOWN_OFF_SIGMA
    x, P = dense.posterior(wide)
    np.testing.assert_allclose(straight(f, f.S @ f.S.T), straight(f, P), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(imu_entries(f.state), x[entries], atol=1e-8)
    value, sigma = surest(x, P, entries)
    assert f"scale or alignment of the IMU is off, by {1e2 * value:.2f} ± {1e2 * sigma:.2f} %" in event_text(
        events[IMU]
    )


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_a_target_announced_is_left_as_it_was_found(factor):
    f, x, P, dense = some_filter(0.0, 4.0, factor=factor)
    agreement = f.agreement[NAME]
    events = ModelAcceptance().look(f)
    assert list(events) == [TARGET]
    assert off(f, TARGET) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(f.S @ f.S.T, P, rtol=1e-9, atol=1e-15)
    value, sigma = surest(x, P, dense.where[TARGET])
    assert f"by {1e3 * value:.2f} ± {1e3 * np.sqrt(factor) * sigma:.2f} mm at its edges" in event_text(
        events[TARGET]
    )
    # what stretches had said of the lens was said with the target as in its file
    assert f.agreement[NAME] is not agreement


def test_it_is_asked_once_a_second():
    f, *_ = some_filter(0.0)
    beyond = ModelAcceptance()
    assert beyond.look(f) == {}
    f.state.gyro_matrix = f.state.gyro_matrix + 0.01
    f.state.t_s += 0.5
    assert beyond.look(f) == {}
    f.state.t_s += 0.6
    assert list(beyond.look(f)) == [IMU]


@pytest.mark.parametrize(("lag", "word"), [(6.0, "behind"), (-6.0, "ahead of")])
def test_a_lag_is_announced_once_it_is_measured_how_well_images_fit(lag, word):
    f, x, P, dense = some_filter(0.0, lag=lag)
    assert ModelAcceptance().look(f) == {}
    f.consistency[NAME].images = 400
    events = ModelAcceptance().look(f)
    assert list(events) == [LAG]
    value, sigma = surest(x, P, dense.where[LAG])
    assert f"is {1e3 * value:.2f} ± {1e3 * sigma:.2f} ms {word} the gyro" in event_text(events[LAG])
    np.testing.assert_allclose(f.S @ f.S.T, P, rtol=1e-9, atol=1e-15)
    assert off(f, LAG) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("size", "word"), [(6.0, "larger"), (-6.0, "smaller")])
def test_a_size_announced_gives_the_answer_of_a_wide_prior(size, word):
    f, _, _, dense = some_filter(0.0, size=size)
    events = ModelAcceptance().look(f)
    assert list(events) == [SIZE]
    assert off(f, SIZE) == pytest.approx(1.0, abs=1e-12)
    wide, where = dense.prior.copy(), dense.where[SIZE]
    wide[where] = KNOWN_SIZE_SIGMA
    x, P = dense.posterior(wide)
    np.testing.assert_allclose(straight(f, f.S @ f.S.T), straight(f, P), rtol=1e-6, atol=1e-12)
    assert f.state.target_scale - 1.0 == pytest.approx(x[where][0], abs=1e-8)
    value, sigma = surest(x, P, where)
    assert f"the target is {1e2 * value:.2f} ± {1e2 * sigma:.2f} % {word} than stated" in event_text(
        events[SIZE]
    )
