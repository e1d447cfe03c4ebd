"""The camera's clock against the arrival of first packets: takes the network's jitter off. No I/O."""

from __future__ import annotations

import logging

from vical_drivers.envelope import LowerEnvelope

_log = logging.getLogger(__name__)
MIN_AGE_S = 1.0
"""A mapping that is younger dates no frame."""
_SETTLED_S = 5.0
"""A mapping that is younger is not certain enough to say so."""
_JUMP_S = 5e-3
"""Stamps that are off by less do not show that the clock was set: 5 ms are 400 packets of 1500 bytes at
1 Gbit/s, more than the queues of a switch hold for one port."""
_AGREE_S, _AGREE_FRAMES = 2.0, 10
"""For so long, and in so many frames, all arrivals must be late: a busy computer has moments."""


class CameraClock:
    """Maps the camera's stamps to the host. A clock that was set (PTP) begins a new mapping.

    Attributes:
        settings: How often the camera's clock was set while it ran.

    Args:
        name: Of the camera, for the log.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self.settings = 0
        self._device_ns = self._step_ns = 0
        self.forget()

    def forget(self) -> None:
        """Begin a new mapping with the next frame."""
        self._first: tuple[int, int] | None = None
        self._envelope = LowerEnvelope()
        self._in_time_s, self._late_frames = 0.0, 0

    @property
    def skew(self) -> float:
        """Relative rate error of the two clocks."""
        return self._envelope.skew

    def date(self, device_ns: int, first_packet_ns: int) -> tuple[int, int] | None:
        """Return (first packet without its jitter, one sigma), CLOCK_MONOTONIC ns; None: not known yet.

        Args:
            device_ns: The camera's stamp; 0 or less: it has none.
            first_packet_ns: Arrival, CLOCK_MONOTONIC.
        """
        step_ns, step_before_ns = device_ns - self._device_ns, self._step_ns
        self._device_ns, self._step_ns = device_ns, step_ns
        if device_ns <= 0:
            self.forget()
            return None
        if self._first is not None:
            x_s = (device_ns - self._first[0]) * 1e-9
            late_s = (first_packet_ns - self._first[1]) * 1e-9 - x_s - self._envelope.line(x_s)
            longer_s = 1e-9 * (step_ns - step_before_ns)
            if step_ns <= 0 or self._was_set(x_s, late_s, longer_s):
                self.settings += 1
                _log.warning(
                    "the clock of %s was set by %+.2f s: for %g s frames are dated by their first packet",
                    *(self._name, longer_s if abs(longer_s) > _JUMP_S else -late_s, MIN_AGE_S),
                )
                self.forget()
        if self._first is None:
            self._first = device_ns, first_packet_ns
        x_s = (device_ns - self._first[0]) * 1e-9
        self._envelope.add(x_s, (first_packet_ns - self._first[1]) * 1e-9 - x_s)
        if x_s < MIN_AGE_S:
            return None
        t_ns = self._first[1] + round((x_s + self._envelope.line(x_s)) * 1e9)
        return t_ns, round(self._envelope.sigma_s * 1e9)

    def _was_set(self, x_s: float, late_s: float, longer_s: float) -> bool:
        """Tell whether the camera's clock was set: forward makes a frame early, back all of them late.

        A frame is early as well if all before it were late, as on a computer that loads programs. But then
        its stamp is not further from the one before than usual (`longer_s`).
        """
        if x_s < _SETTLED_S:
            return False
        if late_s < _JUMP_S:
            self._in_time_s, self._late_frames = x_s, 0
            return longer_s > _JUMP_S and late_s < -(_JUMP_S + 5.0 * self._envelope.sigma_s)
        self._late_frames += 1
        return x_s - self._in_time_s > _AGREE_S and self._late_frames >= _AGREE_FRAMES
