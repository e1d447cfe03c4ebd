"""Tests for jumps use what the images did to the filter: they follow them again only if a jump is likely."""

import numpy as np
import pytest

from tests.unit.estimation.some_filter import NAME, some_filter
from vical_daemon.estimation.filter.jump_scores import JumpSizes
from vical_daemon.estimation.filter.passed import Corrected
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.status import what_jumped as module
from vical_daemon.estimation.status.recent_past import Taken
from vical_daemon.estimation.status.what_jumped import Part, _After, what_jumped


def images(f, innovation):
    """Three images in which the camera turns, each of them with an innovation over its noise."""
    frame = PointsFrame(NAME, 0, np.arange(8), np.zeros((8, 2)))
    moves = 2.0 * f.S[f.layout.cameras[NAME].rotation]
    done = [Corrected(f.S, f.S, f.S, np.eye(3), innovation, moves)]
    return [Taken((0.1 * k, frame), True, 0.0, f.state, done) for k in range(3)]


def test_images_without_a_jump_are_not_followed_again():
    f = some_filter()[0]

    def step(*_):
        raise AssertionError

    assert what_jumped(f, images(f, np.full(3, 0.1)), NAME, step) is None


def test_images_that_a_jump_explains_are_followed_again():
    f, followed = some_filter()[0], []

    def step(*image):
        followed.append(image)

    what_jumped(f, images(f, np.full(3, 1e3)), NAME, step)
    assert followed


def test_without_refused_images_each_likely_part_is_tried_at_one_instant(monkeypatch):
    f, tried = some_filter()[0], []
    monkeypatch.setattr(module, "_follow_after", lambda _, parts, of, *__: tried.append((*parts, len(of))))
    taken = images(f, np.full(3, 1e3))
    what_jumped(f, taken, NAME, lambda *_: None)
    parts = [part for part, _ in tried]
    assert len(parts) == len(set(parts))
    assert Part.MOUNTING in parts
    assert Part.DRIFT not in parts  # the images hardly show it, so it cannot explain them
    tried.clear()
    what_jumped(f, [taken[0]._replace(used=False), *taken[1:]], NAME, lambda *_: None)
    assert {part for part, _ in tried} > set(parts)  # the scores do not include that image
    assert len({at for part, at in tried if part is Part.MOUNTING}) > 1


@pytest.mark.parametrize("refuses", [False, True])
def test_a_jump_that_refuses_images_rules_out_no_other(monkeypatch, refuses):
    """Refused images are not in the likelihood: a jump of the lens that refused a third of them was ahead."""
    f, least = some_filter()[0], []

    def follow(before, parts, images, camera, step, limit):
        least.append(limit[-1])
        used = [not refuses, *[True] * (len(images) - 1)]
        return _After(before, [1e5 + k for k in range(len(images))], used, JumpSizes.of(np.ones((1, 1))))

    monkeypatch.setattr(module, "_follow_after", lambda *x: follow(*x) if len(x) > 5 else None)
    with pytest.raises(AssertionError):  # the last one, with all possible parts, follows nothing here
        what_jumped(f, images(f, np.full(3, 1e3)), NAME, lambda *_: None)
    assert len(least) > 1
    assert (max(least[1:]) < 0.0) == refuses
