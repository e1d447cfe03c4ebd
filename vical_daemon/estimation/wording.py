"""The one place where events, guidance and weak directions become English text.

For terminal, page, report, journal, and the text fields of messages and JSON. Nothing reads these texts back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.guidance import AXES, Axis, Block, Guidance, Lack, Verb, WeakDirection

ALONG = 0.85
"""Cosine above which a direction is called by the name of an axis: within 32 deg."""
_AXIS_NAMES = dict(zip(AXES, ("the image's x axis", "the image's y axis", "the optical axis"), strict=True))
_TURNS = {"x": "the image's x axis (nod)", "y": "the image's y axis (shake)", "z": "the optical axis (roll)"}


# ---------------------------------------------------------------------------------------------- directions
def axis_name(axis_cam: Sequence[float]) -> str:
    """Name a direction given in the camera frame (x right, y down, z forward); any length but zero."""
    length = math.sqrt(sum(a * a for a in axis_cam))
    size = [abs(a) / length for a in axis_cam]
    order = sorted(range(3), key=lambda i: -size[i])
    if size[order[0]] > ALONG:
        return _AXIS_NAMES[AXES[order[0]]]
    if size[order[0]] ** 2 + size[order[1]] ** 2 > ALONG**2:
        first, second = (("x", "y", "optical")[i] for i in sorted(order[:2]))
        return f"an axis between the camera's {first} and {second} axes"
    return "an axis oblique to all camera axes"


def direction_name(weak: WeakDirection) -> str:
    """Say what is not known, e.g. "lever arm along the optical axis"."""
    if weak.block is Block.TIMESHIFT:
        return "time shift"
    if weak.block is Block.LEVER_ARM:
        return f"lever arm along {axis_name(weak.axis_cam)}"
    return f"rotation about {axis_name(weak.axis_cam)}"


def direction_sigma(weak: WeakDirection) -> str:
    """Name and figure (one sigma)."""
    figure = {
        Block.LEVER_ARM: f"{1e3 * weak.sigma:.1f} mm",
        Block.ROTATION: f"{math.degrees(weak.sigma):.2f} deg",
        Block.TIMESHIFT: f"{1e3 * weak.sigma:.2f} ms",
    }[weak.block]
    return f"{direction_name(weak)}{_whose(weak.guidance)}: ±{figure}"


def direction_warning(weak: WeakDirection) -> str:
    """Say which number is not to be used."""
    return f"do not use: {direction_name(weak)}"


def direction_line(weak: WeakDirection) -> str:
    """Name, and the motion that would reveal it."""
    return f"{direction_name(weak)}: {guidance_text(weak.guidance)}"


# ------------------------------------------------------------------------------------------------ guidance
def guidance_text(guidance: Guidance) -> str:
    """Say what to do next; empty where nothing is missing."""
    if not guidance:
        return ""
    said = _LACKS.get(guidance.lack)
    if said is not None:
        return said(guidance)
    if guidance.verb is Verb.TURN_AND_MOVE:
        return "turn the rig about all three axes while moving it back and forth"
    return "rotate " + " and ".join(f"about {_TURNS[axis]}" for axis in guidance.axes) + _whose(guidance)


def guidance_caption(guidance: Guidance) -> str:
    """Say what the picture of the axes shows, in a few words; empty where nothing is missing."""
    if guidance.verb is Verb.SHOW:
        return f"show the target near the {_edges(guidance)} of the image"
    axes = _listed(guidance.axes) + _whose(guidance)
    return {
        Verb.NONE: "",
        Verb.TURN: f"turn about {axes}",
        Verb.TURN_FASTER: f"turn faster, about {axes}",
        Verb.TURN_TO_AND_FRO: f"turn back and forth, about {axes}",
        Verb.TURN_AND_MOVE: f"turn about {axes} and move back and forth",
    }[guidance.verb]


_HEADLINES = {
    "waiting": "Waiting for data.",
    "initialising": "Initialising.",
    "converging": "The estimate is improving.",
    "converged": "Converged.",
    "degenerate": "The motion so far does not determine every direction.",
    "inconsistent": "The data contradict the model: do not use these numbers.",
}


def headline(status: str, guidance: Guidance) -> str:
    """Say in one short sentence where a calibration stands.

    Args:
        status: One of `result.Status`.
        guidance: What to do next: a lens that was not seen everywhere is not called converged everywhere.
    """
    if status == "converged" and guidance.verb is Verb.SHOW:
        return "Converged, except near the edges of the image."
    return _HEADLINES[status]


def fault_headline(component: str, age_s: float | None = None) -> str:
    """Say in one short sentence that a device or role does not work.

    Args:
        component: Its name.
        age_s: How long ago its last data came, s; None: not known, or there were none.
    """
    since = "" if age_s is None or age_s < 1.0 else f": no data for {age_s:.0f}\N{NO-BREAK SPACE}s"
    return f"{component} does not work{since}."


def silent_headline(component: str) -> str:
    """Say in one short sentence that nothing new comes from a device which reports no error."""
    return f"{component} sends no new data."


def at_rest(status: str) -> str:
    """Say in one short sentence where a calibration stands while nothing new comes from its devices."""
    return f"{status}, waiting for new data."


def silence(age_s: float) -> str:
    """Say in one short sentence that estimates have stopped.

    Args:
        age_s: How long ago the last one came, s.
    """
    return f"No estimate for {age_s:.0f} s: is the calibrate process running?"


def motion_caption(status: str, guidance: Guidance, advice: str) -> str:
    """Say what the picture of the axes shows, or why it shows nothing.

    Args:
        status: One of `result.Status`.
        guidance: What to do next.
        advice: The same as text; with messages of version 0.1.0 there is nothing else.
    """
    if guidance or advice:
        return guidance_caption(guidance)
    return "no more motion needed" if status == "converged" else "turn and move freely"


def _still(guidance: Guidance) -> str:
    if guidance.verb is Verb.TURN_TO_AND_FRO:
        return "without rotation the time shift is hardly observable; turn the rig back and forth"
    return "the rig hardly turns; turn it back and forth about two axes at 20 to 60 deg/s"


def _slow(guidance: Guidance) -> str:
    rate = "slowly" if guidance.rate_rps is None else f"at only {math.degrees(guidance.rate_rps):.0f} deg/s"
    return f"it turns {rate}; turn faster, 20 to 60 deg/s, about two axes"


def _one_axis(guidance: Guidance) -> str:
    faster = ", and faster" if guidance.verb is Verb.TURN_FASTER else ""
    about = axis_name(guidance.turned_about) + _whose(guidance) if guidance.turned_about else "one axis"
    return f"so far it turned about {about} only; rotate about another axis{faster}"


def _unseen_edges(guidance: Guidance) -> str:
    return (
        f"no corners yet near the {_edges(guidance)} of {guidance.camera}'s picture: "
        "show the target there, for the lens"
    )


def _whose(guidance: Guidance) -> str:
    return f" of {guidance.camera}" if guidance.camera else ""


def _edges(guidance: Guidance) -> str:
    return f"{_listed(guidance.edges)} {'edge' if len(guidance.edges) == 1 else 'edges'}"


_LACKS: dict[Lack, Callable[[Guidance], str]] = {
    Lack.STILL: _still,
    Lack.SLOW: _slow,
    Lack.ONE_AXIS: _one_axis,
    Lack.STEADY_RATE: lambda _: "the rotation rate hardly changes; turn back and forth, not in one direction",
    Lack.FAST_CHANGES: lambda _: "turn the rig back and forth faster, changing direction",
    Lack.EDGES: _unseen_edges,
}


# -------------------------------------------------------------------------------------------------- events
def event_text(event: Event) -> str:
    """Return the announcement as one line, with the name of the camera that it concerns."""
    named, said = f"{event.camera}: " if event.camera else "", _EVENTS[event.kind]
    text = said.format(_Figure(event)) if isinstance(said, str) else said(event)
    return f"{_LABELS.get(event.kind, '')}{named}{text}"


def event_document(event: Event) -> dict[str, Any]:
    """Return the event as any JSON of ours has it."""
    document: dict[str, Any] = {
        "kind": str(event.kind),
        "camera": event.camera,
        "t_s": event.t_s,
        "value": event.value,
        "sigma": event.sigma,
        "text": event_text(event),
    }
    if event.cause:
        document |= {"cause": str(event.cause), "cause_value": event.cause_value}
    return document


def guidance_document(guidance: Guidance) -> dict[str, Any]:
    """Return guidance as any JSON of ours has it."""
    return {
        "verb": str(guidance.verb),
        "axes": list(guidance.axes),
        "lack": str(guidance.lack),
        "turned_about": list(guidance.turned_about),
        "rate_rps": guidance.rate_rps,
        "camera": guidance.camera,
        "edges": list(guidance.edges),
        "text": guidance_text(guidance),
    }


def direction_document(weak: WeakDirection) -> dict[str, Any]:
    """Return a weak direction as any JSON of ours has it."""
    return {
        "block": str(weak.block),
        "axis_cam": list(weak.axis_cam),
        "sigma": weak.sigma,
        "limit": weak.limit,
        "guidance": guidance_document(weak.guidance),
        "text": direction_line(weak),
    }


def cause_text(cause: Cause, value: float | None = None) -> str:
    """Say why a calibration or a window was given up."""
    return _CAUSES[cause].format(math.nan if value is None else value)


_CAUSES = {
    Cause.NONE: "",
    Cause.STORED_DIFFERS: "since the stored calibration",
    Cause.BUMPED: "since before the bump",
    Cause.IMAGES_REFUSED: "images no longer fit the motion, even after the pose was re-initialised",
    Cause.IMAGES_DISAGREE: "images and motion disagree by more than before: the camera or the target moved, "
    "or the lens changed",
    Cause.ESTIMATE_IMPLAUSIBLE: "the estimate is not finite",
    Cause.CALIBRATION_CONTRADICTED: "the last seconds move the calibration by more than the sigmas allow",
    Cause.WINDOW_CONTRADICTED: "the last seconds do not fit the calibration; checking again",
    Cause.NO_IMAGES: "no usable images for {:.1f} s",
    Cause.CLOCK_SET: "the camera's clock was set",
    Cause.INERTIAL_GAP: "inertial data have a gap",
    Cause.TOO_FEW_FEATURES: "too few features can be followed",
    Cause.FEATURES_CONTRADICT: "the features of the last seconds contradict each other",
    Cause.FEATURES_MISS: "features are {:.1f} px from where they are expected",
    Cause.INERTIAL_MISFIT: "inertial data and images disagree ({:.1f} times their noise)",
    Cause.SCENE_MOVES: "{:.0%} of the features do not move with the scene",
    Cause.NO_PARALLAX: "the camera only turns, everything is far away, or features are lost before they "
    "show depth",
    Cause.SECOND_AXIS: "the rig now turns about a second axis: restarting, to estimate the whole lever arm",
    Cause.COLUMNS_READ: "the images show that the shutter reads columns: restarting with that",
}


_DEG = 180.0 / math.pi
_FACTORS = {"mm": 1e3, "ms": 1e3, "us": 1e6, "%": 100.0, "deg": _DEG, "deg/s": _DEG}
"""Figures in these units over those in SI units; others are as they are."""


def digits_that_show(sigma: float, digits: int) -> int:
    """Digits after the point, `digits` or more, with which a sigma is not 0.0: that would say it is exact."""
    while 0.0 < sigma < 0.5 * 10.0**-digits:
        digits += 1
    return digits


class _Figure:
    """Value of an event and, where known, its sigma, in a format such as ".1f ms"; `size`: without sign."""

    def __init__(self, event: Event, *, size: bool = False) -> None:
        value = math.nan if event.value is None else event.value
        self._value, self._sigma = abs(value) if size else value, event.sigma

    def __format__(self, spec: str) -> str:
        form, unit = spec.split(" ", 1)
        factor = _FACTORS.get(unit.split()[0], 1.0)
        if self._sigma is None:
            return f"{format(factor * self._value, form)} {unit}"
        digits = digits_that_show(factor * self._sigma, int(form.strip("+.f")))
        form = f"{form.partition('.')[0]}.{digits}f"
        return f"{factor * self._value:{form}} ± {factor * self._sigma:.{digits}f} {unit}"


def _target_size(event: Event) -> str:
    how = "larger" if (event.value or 0.0) > 0 else "smaller"
    size = _Figure(event, size=True)
    figure = f"about {size:.0f %}" if event.sigma is None else f"{size:.2f %}"
    return f"the target is {figure} {how} than stated: measure it; its size is estimated from now on"


def _target_ratio(event: Event) -> str:
    how = "further apart" if (event.value or 0.0) > 0 else "closer together"
    return (
        f"compared with its rows, the target's columns are {_Figure(event, size=True):.0f %} {how} than "
        "stated: measure both; allowed for from now on"
    )


def _accel_lag(event: Event) -> str:
    late = "behind" if (event.value or 0.0) > 0 else "ahead of"
    return f"the accelerometer is {_Figure(event, size=True):.2f ms} {late} the gyro: allowed for from now on"


def _imu_noise(event: Event) -> str:
    than = "worse" if (event.value or 0.0) > 1.0 else "better"
    also = "; errors of lens, target or IMU that last for a second look alike" if than == "worse" else ""
    return (
        f"the IMU predicts images {than} than its noise densities say ({_Figure(event):.1f times}): "
        f"measure them with `vical allan`{also}"
    )


def _rolling(event: Event) -> str:
    shutter = "rolling shutter"
    if event.kind is EventKind.ROLLING_COLUMNS:
        shutter += " that reads columns (as in a phone held upright)"
    if event.value is None:
        return f"{shutter}, detected from how motion bends the target: its readout is estimated, too"
    readout = f"readout {_Figure(event):.1f ms}, allowed for from now on"
    return f"{shutter}, detected from how features move: {readout}"


def _cause(event: Event) -> str:
    return cause_text(event.cause, event.cause_value)


def _difference(what: str) -> Callable[[Event], str]:
    return lambda e: f"{what.format(_Figure(e))} {cause_text(e.cause)}".rstrip()


# before the name of the camera
_LABELS = {
    EventKind.BUMPED: "bumped: ",
    EventKind.STARTED_OVER: "started over: ",
    EventKind.CAMERA_MOVED: "changed: ",
    EventKind.CAMERA_TURNED: "changed: ",
    EventKind.TIMESHIFT_CHANGED: "changed: ",
    EventKind.LENS_CHANGED: "changed: ",
}
_EVENTS: dict[EventKind, str | Callable[[Event], str]] = {
    EventKind.BUMPED: _cause,
    EventKind.STARTED_OVER: _cause,
    EventKind.STARTED_ANEW: "restarted after the change",
    EventKind.NOT_BUMPED: "the mounting has not changed: the target was moved, or images were wrong "
    "(a camera that moved by more than {:.1f mm} would show)",
    EventKind.WENT_ON: lambda e: f"continued after: {_cause(e)}",
    EventKind.RESUMED: "resumed from the state of {:.1f s} ago: the process was restarted",
    EventKind.CAMERA_MOVED: _difference("moved by {:.1f mm}"),
    EventKind.CAMERA_TURNED: _difference("turned by {:.2f deg}"),
    EventKind.TIMESHIFT_CHANGED: _difference("time shift by {:+.2f ms}"),
    EventKind.LENS_CHANGED: _difference("lens by {:.2f px}"),
    EventKind.STORED_HOLDS: "the stored calibration holds, by {:.0f s} of data",
    EventKind.TIMESHIFT_STEPPED: "the time shift stepped by {:+.1f ms}; the rest is kept",
    EventKind.LENS_STEPPED: "the lens changed, fx by {:+.1f px}: fix focus and zoom; "
    "a lens that is not fixed is estimated again, the rest is kept",
    EventKind.BIASES_STEPPED: "the biases of the IMU stepped, the gyro's by {:.2f deg/s}: they are "
    "estimated again, the rest is kept; causes: a shock, warming up, or a gyro that is zeroed at rest",
    EventKind.POSE_LOST: "the target was moved, or the pose was lost: it is estimated again, the "
    "calibration is kept",
    EventKind.CLOCK_DRIFT: "the time shift drifts: the clocks of camera and IMU run at different rates, by "
    "{:+.1f us per second}; it is now estimated too",
    EventKind.CLOCK_WANDER: "the time shift is not constant: it stepped, or the clocks of camera and IMU "
    "changed their rates, which now differ by {:+.1f us per second}; the drift is now estimated too",
    EventKind.STAMP_JITTER: "the stamps of the images jitter by {:.1f ms}; allowed for",
    EventKind.STAMPED_ON_ARRIVAL: "its stamps jitter by {:.1f ms} but it samples evenly: its images are put "
    "on an even grid from now on; the calibration starts over",
    EventKind.IMAGES_WANDER: "whole images move by {:.1f px} relative to the motion of the IMU: switch off "
    "image stabilisation; neither lens, camera nor board may move by itself",
    EventKind.TIMESHIFT_VARIES: "the time shift varies by {:.1f ms} within seconds: fix the exposure time, "
    "or stamp the middle of exposures; errors of a gyro that grow with its rate look alike",
    EventKind.STAMPS_STEPPED: "its stamps stepped by about {:+.1f s} relative to those of the IMU",
    EventKind.IMU_CLOCK_SET_BACK: "the IMU's stamps went back by {:.1f s}: its clock was set",
    EventKind.IMU_CLOCK_REMAPPED: "the IMU's stamps moved by {:+.1f ms}: its driver mapped the clock again; "
    "corrected for",
    EventKind.IMU_GAP: "{:.1f s} without inertial data",
    EventKind.IMU_REPEATED: "{:.1f s} in which the IMU repeated one reading",
    EventKind.IMU_CLIPPED: "{:.1f %} of the readings are at the limit of the IMU's range: "
    "move the rig more gently",
    EventKind.IMAGE_GAP: "{:.1f s} without images",
    EventKind.IMAGE_REPEATED: "{:.1f s} in which one image was repeated",
    EventKind.IMU_NOISE: _imu_noise,
    EventKind.IMU_INTRINSICS: "scale or alignment of the IMU is off, by {:.2f %}: allowed for from now on",
    EventKind.ACCEL_LAG: _accel_lag,
    EventKind.ACCEL_POSITIONS: lambda e: (
        "the axes of the accelerometer are not in one place (size effect), by "
        f"{_Figure(e, size=True):.1f mm}: allowed for from now on"
    ),
    EventKind.TARGET_SIZE: _target_size,
    EventKind.TARGET_RATIO: _target_ratio,
    EventKind.TARGET_SHAPE: "the target differs from its file by {:.2f mm} at its edges: "
    "its shape is estimated from now on",
    EventKind.FIXED_LENS: "the fixed lens is not this camera's: points appear {:.1f px} (RMS) from where "
    "it projects them; the sigmas allow for it; without `fix: [intrinsics]` the lens is estimated",
    EventKind.ROLLING_SHUTTER: _rolling,
    EventKind.ROLLING_COLUMNS: _rolling,
    EventKind.LENS_TERM_MISSING: "the lens needs one more term than radtan has: set "
    "distortion_model: plumb_bob",
    EventKind.IMU_UNITS: lambda e: e.said,
    EventKind.DEVICE_REPLACED: lambda e: e.said,
    EventKind.ESTIMATOR_RESTARTED: lambda e: e.said,
    EventKind.OTHER: lambda e: e.said,
}
"""What is said of each kind of event, with its figure where a text has {}."""


def _listed(words: Iterable[Axis | str]) -> str:
    """Join words with commas and "and"."""
    *most, last = list(words) or [""]
    return " and ".join(filter(None, (", ".join(most), last)))


def not_in_view(cameras: Iterable[str]) -> str:
    """Why a rig is not calibrated as a whole: these cameras have not seen the target."""
    return f"{', '.join(sorted(cameras))}: target not in view yet: show it to this camera, too"
