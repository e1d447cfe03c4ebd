"""Clocks and wires as they are: crystals that run fast or slow and wander, and links that delay and bunch.

All times here are host seconds (CLOCK_MONOTONIC where the emulator runs live, any origin in simulated time).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

BITS_PER_BYTE = 10


@dataclass(frozen=True, slots=True)
class SkewedClock:
    """A device clock: device seconds as a function of host seconds.

    Attributes:
        t_start_s: Host time at which the device clock reads zero.
        skew_ppm: Constant part of its rate error; positive runs fast.
        wander_ppm: Amplitude of a slow sine added to the rate error (temperature).
        wander_period_s: Its period.
    """

    t_start_s: float = 0.0
    skew_ppm: float = 0.0
    wander_ppm: float = 0.0
    wander_period_s: float = 600.0

    def device_s(self, t_host_s: float) -> float:
        """Device seconds at a host time."""
        t = t_host_s - self.t_start_s
        omega = 2.0 * math.pi / self.wander_period_s
        wander_s = self.wander_ppm * 1e-6 * (1.0 - math.cos(omega * t)) / omega
        return (1.0 + self.skew_ppm * 1e-6) * t + wander_s

    def host_s(self, device_s: float) -> float:
        """Host time at which the device clock reads `device_s` (Newton's method; the rate is nearly 1)."""
        t_host_s = self.t_start_s + device_s
        for _ in range(4):
            t_host_s -= self.device_s(t_host_s) - device_s
        return t_host_s


class Link(Protocol):
    """What lies between device and host; delays bytes, never reorders them."""

    def push(self, data: bytes, t_ready_s: float) -> None:
        """Hand over bytes that the device has ready at a host time (must not decrease)."""
        ...

    def poll(self, t_now_s: float) -> list[tuple[float, bytes]]:
        """Return what has arrived until now: (arrival, bytes), in order."""
        ...

    def next_s(self) -> float | None:
        """When the next bytes arrive, as far as is known; None where none are under way."""
        ...

    def set_baud(self, baud: int) -> None:
        """Change the wire's speed."""
        ...


class _Queue:
    """Bytes under way with known arrivals."""

    def __init__(self) -> None:
        self._under_way: deque[tuple[float, bytes]] = deque()

    def poll(self, t_now_s: float) -> list[tuple[float, bytes]]:
        """See `Link.poll`."""
        out = []
        while self._under_way and self._under_way[0][0] <= t_now_s:
            out.append(self._under_way.popleft())
        return out

    def next_s(self) -> float | None:
        """See `Link.next_s`."""
        return self._under_way[0][0] if self._under_way else None

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`; without a wire it changes nothing."""


class DirectLink(_Queue):
    """Everything arrives at once."""

    def push(self, data: bytes, t_ready_s: float) -> None:
        """See `Link.push`."""
        self._under_way.append((t_ready_s, data))


class UsbLink(_Queue):
    """Native USB: the host collects what is there whenever it polls, every 1 .. 2 ms at random."""

    def __init__(self, rng: np.random.Generator, least_s: float = 1e-3, most_s: float = 2e-3) -> None:
        super().__init__()
        self._rng = rng
        self._range = (least_s, most_s)
        self._next_poll_s = -math.inf

    def push(self, data: bytes, t_ready_s: float) -> None:
        """See `Link.push`."""
        if self._next_poll_s < t_ready_s - 1.0:
            self._next_poll_s = t_ready_s
        while self._next_poll_s < t_ready_s:
            self._next_poll_s += self._rng.uniform(*self._range)
        if self._under_way and self._under_way[-1][0] == self._next_poll_s:
            _t_s, before = self._under_way.pop()
            data = before + data
        self._under_way.append((self._next_poll_s, data))


class UartLink(_Queue):
    """RS-232: bytes take ten bits each, then the host's interrupt adds a little.

    Args:
        rng: Source of the jitter.
        baud: Bits per second.
        jitter_s: Mean of the exponential delay between last byte and arrival.
        buffer_s: What the device would have to queue longer than this it drops, silently.
    """

    def __init__(
        self, rng: np.random.Generator, baud: int = 115_200, jitter_s: float = 30e-6, buffer_s: float = 0.05
    ) -> None:
        super().__init__()
        self._rng = rng
        self._baud = baud
        self._jitter_s = jitter_s
        self._buffer_s = buffer_s
        self._free_s = -math.inf
        self._last_arrival_s = -math.inf
        self.dropped = 0

    def push(self, data: bytes, t_ready_s: float) -> None:
        """See `Link.push`."""
        if self._free_s > t_ready_s + self._buffer_s:
            self.dropped += 1
            return
        self._free_s = max(self._free_s, t_ready_s) + len(data) * BITS_PER_BYTE / self._baud
        arrival_s = max(self._free_s + self._rng.exponential(self._jitter_s), self._last_arrival_s)
        self._last_arrival_s = arrival_s
        self._under_way.append((arrival_s, data))

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`."""
        self._baud = baud


class FtdiLink:
    """A USB-serial chip: sends 62 bytes when it has them, or what it has when its latency timer fires.

    Args:
        rng: Source of the jitter of USB and of the timer's phase.
        baud: Bits per second on the UART side.
        latency_s: Latency timer, 16 ms out of the box, 1 ms in low-latency mode.
        packet: Payload of one full USB packet, bytes.
    """

    def __init__(
        self, rng: np.random.Generator, baud: int = 115_200, latency_s: float = 16e-3, packet: int = 62
    ) -> None:
        self._rng = rng
        self._baud = baud
        self._latency_s = latency_s
        self._packet = packet
        self._free_s = -math.inf
        self._bytes: deque[tuple[float, int]] = deque()
        self._timer_s: float | None = None

    def push(self, data: bytes, t_ready_s: float) -> None:
        """See `Link.push`."""
        if self._timer_s is None:
            self._timer_s = t_ready_s + self._rng.uniform(0.0, self._latency_s)
        byte_s = BITS_PER_BYTE / self._baud
        self._free_s = max(self._free_s, t_ready_s)
        for value in data:
            self._free_s += byte_s
            self._bytes.append((self._free_s, value))

    def next_s(self) -> float | None:
        """See `Link.next_s`."""
        if not self._bytes or self._timer_s is None:
            return None
        if len(self._bytes) >= self._packet:
            return min(self._bytes[self._packet - 1][0], self._firing_after(self._bytes[0][0]))
        return self._firing_after(self._bytes[0][0])

    def _firing_after(self, t_s: float) -> float:
        assert self._timer_s is not None
        behind = math.ceil((t_s - self._timer_s) / self._latency_s)
        return self._timer_s + max(0, behind) * self._latency_s

    def poll(self, t_now_s: float) -> list[tuple[float, bytes]]:
        """See `Link.poll`."""
        out: list[tuple[float, bytes]] = []
        while (flush_s := self.next_s()) is not None and flush_s <= t_now_s:
            chunk = bytearray()
            while self._bytes and self._bytes[0][0] <= flush_s and len(chunk) < self._packet:
                chunk.append(self._bytes.popleft()[1])
            if len(chunk) < self._packet:
                self._timer_s = flush_s
            usb_s = float(self._rng.uniform(0.0, 125e-6))
            arrival_s = flush_s + usb_s if not out else max(out[-1][0], flush_s + usb_s)
            out.append((arrival_s, bytes(chunk)))
        return out

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`."""
        self._baud = baud


LINKS = ("direct", "usb", "uart", "ftdi")


def make_link(kind: str, rng: np.random.Generator, baud: int = 115_200) -> Link:
    """Make a link by name, one of `LINKS`."""
    if kind == "direct":
        return DirectLink()
    if kind == "usb":
        return UsbLink(rng)
    if kind == "uart":
        return UartLink(rng, baud)
    if kind == "ftdi":
        return FtdiLink(rng, baud)
    raise ValueError(f"unknown link {kind!r}; known are {', '.join(LINKS)}")
