"""The answer of a verification in words."""

from __future__ import annotations

import math
from typing import Any

from vical_daemon.results.change_odds import FALSE_ALARM, MISSED

_SCALE = {"m": (1e3, "mm"), "rad": (180.0 / math.pi, "deg"), "s": (1e3, "ms"), "px": (1.0, "px")}


def describe(document: dict[str, Any], against: str) -> str:
    """Return the text of `vical verify --json`."""
    lines = [_headline(document, against)]
    for name, camera in document["cameras"].items():
        lines += ["", f"{name}: {camera['verdict']}, after {camera['seconds_used']:.0f} s of data"]
        if camera["reason"]:
            lines.append(f"  {camera['reason']}")
        lines += [f"  {change_text(change)}" for change in camera["changes"]]
        lines += [f"  {_block(block, row)}" for block, row in camera["blocks"].items()]
        lines += [f"  note: {note}" for note in camera["assumed"]]
    for name in document.get("not_checked", []):
        lines += ["", f"{name}: not checked, this recording does not have it"]
    if document["missing_motion"]:
        lines += ["", *(f"what would help: {text}" for text in document["missing_motion"])]
    return "\n".join(lines)


def _headline(document: dict[str, Any], against: str) -> str:
    verdict, probability = document["verdict"], document["probability_changed"]
    if verdict == "holds":
        return f"{against} holds (a relevant change is missed with a probability below {MISSED:g})"
    if verdict == "changed":
        moved = ", ".join(dict.fromkeys(change["what"] for change in document["changes"]))
        return f"{against} no longer holds: {moved} (false-alarm probability below {FALSE_ALARM:g})"
    chance = "" if probability is None else f", probability of a change {probability:.2g}"
    return f"cannot tell whether {against} holds{chance}"


def change_text(change: dict[str, Any]) -> str:
    """Say what has changed, by how much, and along which way."""
    scale, unit = _SCALE[change["unit"]]
    value, sigma = scale * change["value"], scale * change["sigma"]
    axis = change.get("axis")
    where = "imu" if change["what"] == "position" else "camera"
    along = "" if axis is None else f" along ({', '.join(f'{x:+.2f}' for x in axis)}) in the {where} frame"
    if change["what"] == "rotation":
        along = along.replace("along", "about")
    return f"{change['what']} changed by {value:.3g} ± {sigma:.2g} {unit}{along}"


def _block(block: str, row: dict[str, Any]) -> str:
    word = "holds" if row["holds"] else "does not hold, or undecided"
    return f"{block + ':':<12}{word}; smallest relevant change: {_size(row, 'counts_from')}" + (
        "" if row["holds"] else f", smallest visible change: {_size(row, 'visible_from')}"
    )


def _size(row: dict[str, Any], key: str) -> str:
    if row["unit"] not in _SCALE:
        return f"{100.0 * row[key]:.2g} % {row['unit']}"
    scale, unit = _SCALE[row["unit"]]
    return f"{scale * row[key]:.2g} {unit}"
