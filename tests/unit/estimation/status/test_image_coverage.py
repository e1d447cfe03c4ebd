"""Edges of the picture without corners, and that they are asked for."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from vical_mocks.harness.feed import CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate

from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.estimation.status.status_evaluator import Cover, ImageCoverage


def spread(low, high, count=4000):
    return np.random.default_rng(1).uniform(low, high, (count, 2))


PARTLY_SEEN = np.full((8, 2), 300.0)  # a target that is partly in the picture


@pytest.mark.parametrize(
    ("low", "high", "edges"),
    [
        ((0, 0), (640, 480), ()),
        ((100, 0), (540, 480), ("left", "right")),
        ((0, 100), (640, 480), ("top",)),
        ((100, 100), (540, 380), ("left", "right", "top", "bottom")),
    ],
)
def test_edges_without_corners_are_named(low, high, edges):
    cover = ImageCoverage((640, 480))
    cover.add(spread(low, high))
    assert cover.unseen_edges() == ()  # whole targets only: their corners may never come so far out
    cover.add(PARTLY_SEEN)
    assert cover.unseen_edges() == edges


def test_a_few_strays_show_no_edge_and_corners_beyond_the_picture_do_no_harm():
    cover = ImageCoverage((640, 480))
    cover.add(spread((100, 100), (540, 380)))
    cover.add(np.array([[2.0, 240.0], [645.0, 240.0], [-3.0, -3.0]]))
    assert cover.unseen_edges() == ("left", "right", "top", "bottom")


@pytest.mark.parametrize(("model", "asked"), [("radtan", True), ("equidistant", False)])
def test_a_fisheye_is_not_asked_for_edges_that_it_may_not_have(model, asked):
    camera = SimpleNamespace(distortion_model=model, resolution=(640, 480))
    f = SimpleNamespace(
        state=SimpleNamespace(cameras={"cam0": camera}),
        layout=SimpleNamespace(lens_free=lambda _: True),
    )
    uv = spread((100, 100), (540, 380))
    cover = Cover()
    for seen in (uv, PARTLY_SEEN):
        cover.saw(SimpleNamespace(camera="cam0", uv_px=seen, accepted=np.ones(len(seen), dtype=bool)), f)
    assert bool(cover.advice()) == asked


@pytest.mark.parametrize("fixed", [True, False])
def test_only_who_estimates_the_lens_is_asked_to_show_more(fixed):
    whole = simulate(2, 14.0)
    inside = [replace(f, **middle(f)) for f in whole.frames]
    run = replace(whole, frames=[f for f in inside if len(f.ids) >= 8])
    options = CalibrationOptions(
        fix=frozenset({"intrinsics"}) if fixed else frozenset(), imu_noise=imu_noise(run)
    )
    prior = camera_prior(run, 2, StartErrors(), exact_lens=fixed)
    record = feed(run, CalibratorSubject(options, prior, run.points_m))
    assert record.statuses[-1][1] == "converged"
    asked = "no corners yet near the left and right edges of cam0's picture"
    assert record.guidance.startswith(asked) != fixed


def middle(frame):
    """What is left of a frame where the left and right of the picture are hidden."""
    keep = np.abs(frame.uv_px[:, 0] - 320.0) < 200.0
    return {"ids": frame.ids[keep], "uv_px": frame.uv_px[keep], "outlier": frame.outlier[keep]}
