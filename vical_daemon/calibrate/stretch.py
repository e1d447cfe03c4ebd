"""When a stretch of data for a check ends: the rig stands still, shows no points, or time is up. No I/O."""

from __future__ import annotations

from contextlib import suppress

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import MessageError, decode_points
from vical_daemon.calibrate.motion import Motion

LONGEST_S = 30.0
"""Longest stretch of data between two pauses, s: as a check takes at most where the motion shows enough."""
_BLIND_S = 5.0  # without points a stretch ends: the board is not in view (the first image waits for OpenCV)
_STILL_S = 3.0  # without motion a stretch ends


class Stretch:
    """One stretch of data of a check.

    Args:
        imu_key: Of the inertial samples.
        motion: Whether the rig moves; has seen motion already.
        now_s: Any steady clock.
        used_s: Data that the check has used before, s.
    """

    def __init__(self, imu_key: str, motion: Motion, now_s: float, used_s: float) -> None:
        self._imu_key, self._motion = imu_key, motion
        self._seen_s, self._before_s = now_s, used_s

    def take(self, sample: Sample, now_s: float) -> None:
        """Take a message that the check has taken."""
        if sample.key == self._imu_key:
            self._motion.take(sample, now_s)
        elif _shows_points(sample):
            self._seen_s = now_s

    def over(self, now_s: float, used_s: float) -> bool:
        """Whether more data now would bring nothing, or it is time for a pause."""
        still, blind = now_s - self._motion.moved_s > _STILL_S, now_s - self._seen_s > _BLIND_S
        return still or blind or used_s - self._before_s >= LONGEST_S


def _shows_points(sample: Sample) -> bool:
    """Whether it is a message with points in it."""
    parsed = topics.parse_key(sample.key)
    if parsed is None or parsed.topic not in (topics.POINTS, topics.TRACKS):
        return False
    with suppress(MessageError):
        return len(decode_points(sample.payload).ids) > 0
    return False
