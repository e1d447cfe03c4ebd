"""Events, guidance and weak directions as text: every kind has one line, figures have the right unit."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from vical_daemon.estimation.events import Cause, Event, EventKind, EventLog
from vical_daemon.estimation.guidance import AXES, Block, Guidance, Lack, Verb, WeakDirection, of_camera
from vical_daemon.estimation.wording import (
    cause_text,
    digits_that_show,
    direction_line,
    direction_sigma,
    event_document,
    event_text,
    guidance_caption,
    guidance_document,
    guidance_text,
)

PAGE = (Path(__file__).parents[3] / "docs/reference/events.md").read_text(encoding="utf-8")
ROWS = {row[0]: row[1:] for row in re.findall(r"^\| `(\w+)` \| (.*) \| (\S+) \| (.*) \|$", PAGE, re.M)}


def test_the_page_lists_these_kinds_and_no_others():
    assert sorted(ROWS) == sorted(EventKind)


@pytest.mark.parametrize("kind", EventKind)
def test_every_kind_is_explained_and_has_one_line(kind):
    meaning, unit, when = ROWS[kind]
    assert meaning.endswith(".") and when.endswith(".")
    has_unit = unit != "none"
    for value, sigma in ((None, None), (1e-3, None), (-1e-3, 2e-4)):
        event = Event(kind, "cam0", value, sigma, said="text")
        line = event_text(event)
        assert "cam0: " in line and "\n" not in line
        assert (value is None or sigma is None or not has_unit) or "± " in line
        assert ("nan" in line) <= (has_unit and value is None), line
        assert json.loads(json.dumps(event_document(event)))["text"] == line


@pytest.mark.parametrize("cause", Cause)
def test_every_cause_has_a_text(cause):
    assert bool(cause_text(cause, 2.0)) == bool(cause)


@pytest.mark.parametrize(
    ("event", "text"),
    [
        (
            Event(EventKind.BUMPED, "cam0", cause=Cause.IMAGES_DISAGREE),
            "bumped: cam0: images and motion disagree by more than before: the camera or the target moved, "
            "or the lens changed",
        ),
        (
            Event(EventKind.TIMESHIFT_STEPPED, "cam0", 0.0201),
            "cam0: the time shift stepped by +20.1 ms; the rest is kept",
        ),
        (
            Event(EventKind.BIASES_STEPPED, value=0.0148),
            "the biases of the IMU stepped, the gyro's by 0.85 deg/s: they are estimated again, the rest "
            "is kept; causes: a shock, warming up, or a gyro that is zeroed at rest",
        ),
        (
            Event(EventKind.CLOCK_DRIFT, "cam0", -5e-5, 1e-6),
            "cam0: the time shift drifts: the clocks of camera and IMU run at different rates, "
            "by -50.0 ± 1.0 us per second; it is now estimated too",
        ),
        (
            Event(EventKind.CLOCK_DRIFT, "cam0", -2.41e-6, 3e-8),  # not "± 0.0"
            "cam0: the time shift drifts: the clocks of camera and IMU run at different rates, "
            "by -2.41 ± 0.03 us per second; it is now estimated too",
        ),
        (
            Event(EventKind.TARGET_SIZE, value=-0.03),
            "the target is about 3 % smaller than stated: measure it; its size is estimated from now on",
        ),
        (
            Event(EventKind.WENT_ON, "cam0", cause=Cause.NO_IMAGES, cause_value=2.04),
            "cam0: continued after: no usable images for 2.0 s",
        ),
        (Event(EventKind.OTHER, said="whatever"), "whatever"),
    ],
)
def test_events_read_as_they_did(event, text):
    assert event_text(event) == text


def test_guidance_and_the_caption_of_the_picture_name_the_same_axes():
    weak = Guidance(Verb.TURN, ("x", "y"))
    assert guidance_text(weak) == "rotate about the image's x axis (nod) and about the image's y axis (shake)"
    assert guidance_caption(weak) == "turn about x and y"
    assert guidance_text(Guidance()) == guidance_caption(Guidance()) == ""
    assert (
        guidance_caption(Guidance(Verb.TURN_AND_MOVE, AXES))
        == "turn about x, y and z and move back and forth"
    )
    show = Guidance(Verb.SHOW, lack=Lack.EDGES, camera="cam0", edges=("left", "top"))
    assert "near the left and top edges of cam0's picture" in guidance_text(show)
    assert guidance_caption(show) == "show the target near the left and top edges of the image"


def test_of_several_cameras_the_one_whose_axes_are_meant_is_named():
    weak = WeakDirection(Block.LEVER_ARM, (0.0, 0.0, 1.0), 0.02, 0.001, Guidance(Verb.TURN, ("x",)))
    named = of_camera(weak, "left")
    assert direction_sigma(weak) == "lever arm along the optical axis: ±20.0 mm"
    assert direction_sigma(named) == "lever arm along the optical axis of left: ±20.0 mm"
    assert guidance_text(named.guidance) == "rotate about the image's x axis (nod) of left"
    assert guidance_caption(named.guidance) == "turn about x of left"
    only = Guidance(Verb.TURN, ("y",), Lack.ONE_AXIS, (0.0, 0.0, 1.0), camera="left")
    assert "about the optical axis of left only" in guidance_text(only)


@pytest.mark.parametrize("lack", [lack for lack in Lack if lack])
@pytest.mark.parametrize("verb", [verb for verb in Verb if verb])
def test_every_guidance_has_a_text_without_numbers_that_are_not_known(verb, lack):
    guidance = Guidance(verb, ("x",), lack, camera="cam0", edges=("left",))
    for text in (guidance_text(guidance), guidance_caption(guidance)):
        assert text and "nan" not in text and "None" not in text
    json.dumps(guidance_document(guidance), allow_nan=False)


@pytest.mark.parametrize(
    ("block", "sigma", "said"),
    [
        (Block.LEVER_ARM, 0.0123, "lever arm along the optical axis: ±12.3 mm"),
        (Block.ROTATION, math.radians(0.5), "rotation about the optical axis: ±0.50 deg"),
        (Block.TIMESHIFT, 1.5e-3, "time shift: ±1.50 ms"),
    ],
)
def test_a_weak_direction_is_named_with_its_figure_and_its_cure(block, sigma, said):
    axis = (0.0, 0.0, 0.0) if block is Block.TIMESHIFT else (0.0, 0.1, -0.99)
    weak = WeakDirection(block, axis, sigma, 1e-3, Guidance(Verb.TURN, ("x",)))
    assert direction_sigma(weak) == said
    assert direction_line(weak).endswith(": rotate about the image's x axis (nod)")


def test_events_are_stamped_once_and_taken_once():
    log = EventLog()
    log.now_s = 3.0
    log.add(Event(EventKind.POSE_LOST))
    log.add(Event(EventKind.IMU_NOISE, value=2.0), once="noise")
    log.now_s = 4.0
    log.add(Event(EventKind.IMU_NOISE, value=3.0), once="noise")
    log.add(Event(EventKind.POSE_LOST))
    assert [(e.kind, e.t_s) for e in log.take()] == [
        (EventKind.POSE_LOST, 3.0),
        (EventKind.IMU_NOISE, 3.0),
        (EventKind.POSE_LOST, 4.0),
    ]
    assert log.take() == []


@pytest.mark.parametrize(("sigma", "digits"), [(0.0, 2), (0.3, 2), (0.006, 2), (0.004, 3), (2e-6, 6)])
def test_a_sigma_is_not_shown_as_zero(sigma, digits):
    assert digits_that_show(sigma, 2) == digits
    assert (float(f"{sigma:.{digits}f}") > 0.0) == (sigma > 0.0)
