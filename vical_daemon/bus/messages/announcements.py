"""Events, guidance and weak directions as parts of a CalibrationEstimate message.

A message holds the text as well as the data. Fields that are missing (older sender) or unknown (newer
sender) are read as text only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import TypeVar

from vical_daemon.bus.messages.cdr import CdrReader, CdrWriter
from vical_daemon.estimation.events import SAID, Cause, Event, EventKind
from vical_daemon.estimation.guidance import AXES, Block, Edge, Guidance, Lack, Verb, WeakDirection

_EDGES: tuple[Edge, ...] = ("left", "right", "top", "bottom")
_SMALLEST_EVENT, _SMALLEST_DIRECTION = 44, 72  # bytes
_Known = TypeVar("_Known", bound=StrEnum)


def write_events(writer: CdrWriter, events: Sequence[Event]) -> None:
    """Append a ``vical_msgs/Event[]``."""
    writer.scalar("I", len(events))
    for event in events:
        writer.string(str(event.kind))
        writer.string(event.camera)
        for number in (event.t_s, event.value, event.sigma):
            _write_number(writer, number)
        writer.string(str(event.cause))
        _write_number(writer, event.cause_value)


def read_events(reader: CdrReader, texts: Sequence[str]) -> list[Event]:
    """Read a ``vical_msgs/Event[]``; an event of unknown kind keeps its text."""
    found: list[Event] = []
    for i in range(reader.count(_SMALLEST_EVENT)):
        kind, camera = reader.string(), reader.string()
        t_s, value, sigma = (_read_number(reader) for _ in range(3))
        cause, cause_value = reader.string(), _read_number(reader)
        known, why = _known(EventKind, kind), _known(Cause, cause)
        if known is None or why is None:
            known, why = EventKind.OTHER, Cause.NONE
        if known in SAID:
            found.append(Event(known, t_s=t_s, said=texts[i] if i < len(texts) else ""))
        else:
            found.append(Event(known, camera, value, sigma, t_s, why, cause_value))
    return found


def untyped_events(texts: Sequence[str]) -> list[Event]:
    """Events of a message that has them as text only."""
    return [Event(EventKind.OTHER, said=text) for text in texts]


def write_guidance(writer: CdrWriter, guidance: Guidance) -> None:
    """Append a ``vical_msgs/Guidance``."""
    writer.string(str(guidance.verb))
    writer.string("".join(guidance.axes))
    writer.string(str(guidance.lack))
    writer.sequence(guidance.turned_about)
    _write_number(writer, guidance.rate_rps)
    writer.string(guidance.camera)
    writer.strings(list(guidance.edges))


def read_guidance(reader: CdrReader) -> Guidance:
    """Read a ``vical_msgs/Guidance``; an unknown one becomes empty guidance."""
    verb, letters, lack = reader.string(), reader.string(), reader.string()
    turned_about, rate_rps = reader.sequence().tolist(), _read_number(reader)
    camera, edges = reader.string(), reader.strings()
    known, what = _known(Verb, verb), _known(Lack, lack)
    if known is None or what is None or len(turned_about) not in (0, 3) or not set(letters) <= set(AXES):
        return Guidance()
    return Guidance(
        known,
        tuple(axis for axis in AXES if axis in letters),
        what,
        tuple(turned_about) if any(turned_about) else (),
        rate_rps,
        camera,
        tuple(edge for edge in _EDGES if edge in edges),
    )


def write_directions(writer: CdrWriter, directions: Sequence[WeakDirection]) -> None:
    """Append a ``vical_msgs/WeakDirection[]``."""
    writer.scalar("I", len(directions))
    for weak in directions:
        writer.string(str(weak.block))
        writer.fixed(weak.axis_cam)
        writer.scalar("d", weak.sigma)
        writer.scalar("d", weak.limit)
        write_guidance(writer, weak.guidance)


def read_directions(reader: CdrReader) -> list[WeakDirection]:
    """Read a ``vical_msgs/WeakDirection[]``; directions of unknown blocks are skipped."""
    found = []
    for _ in range(reader.count(_SMALLEST_DIRECTION)):
        block = _known(Block, reader.string())
        x, y, z = reader.fixed(3).tolist()
        sigma, limit = reader.scalar("d"), reader.scalar("d")
        guidance = read_guidance(reader)
        if block is not None:
            found.append(WeakDirection(block, (x, y, z), sigma, limit, guidance))
    return found


def _known(kind: type[_Known], text: str) -> _Known | None:
    return kind(text) if text in set(kind) else None


def _write_number(writer: CdrWriter, number: float | None) -> None:
    writer.scalar("d", math.nan if number is None else number)


def _read_number(reader: CdrReader) -> float | None:
    number: float = reader.scalar("d")
    return number if math.isfinite(number) else None
