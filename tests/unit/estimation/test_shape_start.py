"""shape_start.py: each image kept is used once, whatever the order of stamps; memory is bounded."""

import numpy as np

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.shape_start import ShapeStart
from vical_daemon.estimation.starting import Attempt

FILTER = object()


class FakeStarting:
    """Starts from all it is given, or not at all."""

    def __init__(self, starts=True):
        self.starts, self.frames = starts, []

    def take(self, items):
        self.frames += items

    def attempt(self, buffer, priors, *, may_be_partial):
        assert not may_be_partial
        return Attempt(FILTER if self.starts else None, list(self.frames), "")


def frame(camera, t_s):
    return PointsFrame(camera, round(1e9 * t_s), np.arange(4), np.zeros((4, 2)))


def kept(seconds, step):
    """Two cameras whose stamps stand 80 ms apart, in the order in which a filter sees them."""
    start = ShapeStart(step)
    for k in range(round(20 * seconds)):
        start.take(0.05 * k + 0.08, frame("cam0", 0.05 * k + 0.08))
        start.take(0.05 * k + 0.02, frame("cam1", 0.05 * k + 0.02))
    return start


def test_each_image_is_filtered_once_and_in_order():
    used = []
    start = kept(10.0, lambda f, image, t_s: used.append((f, image.camera, t_s)))
    starting = FakeStarting()
    assert start.attempt(starting, None, {}) is FILTER
    assert 220 < len(starting.frames) < 250  # six seconds of them make the start
    both = (("cam0", 0.08), ("cam1", 0.02))
    assert [(camera, round(t_s, 3)) for _, camera, t_s in used] == [
        (camera, round(0.05 * k + late, 3)) for k in range(200) for camera, late in both
    ]
    assert all(f is FILTER for f, _, _ in used)


def test_no_start_uses_nothing():
    used = []
    start = kept(10.0, lambda *args: used.append(args))
    assert start.attempt(FakeStarting(starts=False), None, {}) is None
    assert used == []
    assert start.oldest_s == 0.08


def test_memory_is_bounded_and_given_back():
    start = kept(120.0, lambda *args: None)
    assert len(start._kept) <= 1200
    assert start.oldest_s > 60.0
    start.forget()
    assert start.oldest_s == np.inf
