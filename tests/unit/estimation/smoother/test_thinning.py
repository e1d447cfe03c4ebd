"""Which images of a fast camera are used."""

import numpy as np
import pytest

from vical_daemon.estimation.smoother.waiting_tracks import Thinning


def stamps(rate_hz: float, jitter_s: float = 0.0, seconds: float = 60.0):
    true = np.arange(0.0, seconds, 1.0 / rate_hz)
    return true, true + np.random.default_rng(3).normal(0.0, jitter_s, len(true))


@pytest.mark.parametrize(
    ("rate_hz", "share"), [(10.0, 1), (20.0, 1), (23.0, 1), (25.0, 2), (30.0, 2), (60.0, 3), (200.0, 9)]
)
def test_no_more_images_than_wanted_are_taken(rate_hz, share):
    true, _ = stamps(rate_hz)
    thinning = Thinning(23.0)
    taken = [t for t in true if thinning.takes(t)]
    assert len(taken) == pytest.approx(len(true) / share, abs=8)
    assert np.allclose(np.diff(taken[10:]), share / rate_hz)


@pytest.mark.parametrize("rate_hz", [20.0, 40.0, 60.0])
def test_images_are_not_chosen_by_the_error_of_their_stamps(rate_hz):
    """Taken by the interval to the last one, those that stay would be stamped 0.1 ms late on average."""
    true, seen = stamps(rate_hz, 1e-3, 600.0)
    thinning = Thinning(21.0)
    late = np.array([s - t for t, s in zip(true, seen, strict=True) if thinning.takes(s)])
    assert abs(late.mean()) < 4.0 * 1e-3 / np.sqrt(len(late))


def test_a_camera_that_changes_its_rate_is_followed():
    thinning = Thinning(23.0)
    slow, fast = np.arange(0.0, 10.0, 0.1), np.arange(10.0, 20.0, 0.01)
    assert [thinning.takes(t) for t in slow] == [True] * len(slow)
    assert sum(thinning.takes(t) for t in fast) == pytest.approx(200, abs=20)
