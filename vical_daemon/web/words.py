"""What the page says in words: the status as a sentence, and which motion is missing, about which axis."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TypedDict

from vical_daemon.estimation.result import CalibrationEstimate, Status

_SENTENCES = {
    Status.WAITING: "Waiting for data.",
    Status.INITIALISING: "Looking for a first solution.",
    Status.CONVERGING: "Getting sharper.",
    Status.CONVERGED: "Converged: the stated sigmas are small enough.",
    Status.DEGENERATE: "The motion so far does not reveal everything.",
    Status.INCONSISTENT: "The data contradict the model: do not use these numbers.",
}
# Imperatives only: "rotation about the optical axis" names what is not known, not what to do.
_TURN = re.compile(r"\b(rotate|rotating|turn|turning|tilt|tilting|nod|roll|pitch|yaw) ", re.IGNORECASE)
_MOVE = re.compile(r"\b(translat\w*|move|moving|accelerate|closer|further|sideways)\b", re.IGNORECASE)
_AXIS = re.compile(r"\b(?:cam(?:era)?|imu)?[ -]?([xyz])\b|\b(optical axis|line of sight|viewing direction)\b")


class Motion(TypedDict):
    """Axes to draw on the picture: of the camera, x right, y down, z along the line of sight."""

    rotate: list[str]
    translate: list[str]


def sentence(estimate: CalibrationEstimate) -> str:
    """Return the status in words, with the reason where there is one."""
    text = _SENTENCES[estimate.status]
    return f"{text.removesuffix('.')}: {estimate.reason.removesuffix('.')}." if estimate.reason else text


def silence(estimate: CalibrationEstimate, age_s: float) -> str:
    """Return what to say when the estimates of a camera have stopped.

    Args:
        estimate: The last one.
        age_s: How long ago it came, s.
    """
    return (
        f"No estimate for {age_s:.0f} s: is the calibrate process running? The values below are old; "
        f"the last status was {estimate.status}."
    )


def motion(texts: Iterable[str]) -> Motion:
    """Find the axes that guidance texts ask to turn about or to move along.

    A clause that names a motion without an axis stands for all three axes.

    >>> motion(["rotate about the optical axis"])
    {'rotate': ['z'], 'translate': []}
    >>> motion(["lever arm along the optical axis: rotate about the image's x axis (nod)"])
    {'rotate': ['x'], 'translate': []}
    >>> motion(["rotate about x and y; move sideways"])
    {'rotate': ['x', 'y'], 'translate': ['x', 'y', 'z']}
    """
    rotate: set[str] = set()
    translate: set[str] = set()
    for clause in re.split(r"[;:.\n]|, then", " ; ".join(f"{text} " for text in texts)):
        axes = {m.group(1) or "z" for m in _AXIS.finditer(clause)} or set("xyz")
        if _TURN.search(clause):
            rotate |= axes
        elif _MOVE.search(clause):
            translate |= axes
    return {"rotate": sorted(rotate), "translate": sorted(translate)}
