"""The 1394 bus clock and the host's: arithmetic of the cycle timer, and a two-sided fit.

CYCLE_TIME is 7 bits of seconds, 13 bits of cycles (8 kHz) and 12 bits of offset (24.576 MHz): 128 s, then
it starts again. The kernel reads it together with CLOCK_MONOTONIC with interrupts off
(``FW_CDEV_IOC_GET_CYCLE_TIMER2``), so a pair has no one-sided delay: a plain line through the pairs is
right, and no lower envelope is needed. Pure arithmetic.
"""

from __future__ import annotations

from collections import deque

import numpy as np

CYCLE_NS = 125_000
OFFSETS_PER_CYCLE = 3072
WRAP_NS = 128 * 1_000_000_000
COUNTER_IN_OFFSET_MASK = 0xF
"""Some cameras put a frame counter into the lowest four bits of an image's stamp."""

WINDOW_S = 30.0
SPACING_S = 0.1
MAX_SKEW = 500e-6
JUMP_NS = 50_000


def cycle_time_ns(register: int) -> int:
    """Return the time of a CYCLE_TIME value, ns in [0, 128 s), rounded down.

    >>> cycle_time_ns(1 << 25 | 2 << 12 | 1536)
    1000312500
    """
    seconds, cycles, offset = register >> 25 & 0x7F, register >> 12 & 0x1FFF, register & 0xFFF
    return seconds * 1_000_000_000 + cycles * CYCLE_NS + offset * CYCLE_NS // OFFSETS_PER_CYCLE


def image_cycle_time_ns(quadlet: int) -> int:
    """Return the time of an image's embedded stamp, ns in [0, 128 s), without the counter in its low bits.

    The masked bits are worth 0.65 us; their middle is taken.
    """
    middle = (COUNTER_IN_OFFSET_MASK + 1) // 2
    return cycle_time_ns(quadlet & ~COUNTER_IN_OFFSET_MASK | middle)


class CycleClock:
    """Maps cycle times to CLOCK_MONOTONIC by a line through simultaneous pairs.

    A bus reset may give the bus a new cycle master with another time: a pair that lies off the line by
    more than `JUMP_NS` starts the fit anew.
    """

    def __init__(self) -> None:
        self.restarts = 0
        self._begin()

    def _begin(self) -> None:
        self._pairs: deque[tuple[int, int]] = deque()  # unwrapped cycle ns, monotonic ns
        self._newest: tuple[int, int] | None = None
        self._slope = 1.0
        self._at_newest_ns = 0.0  # monotonic time of the line at the newest pair, relative to that pair
        self.sigma_ns = float(CYCLE_NS // OFFSETS_PER_CYCLE)

    @property
    def skew_ppm(self) -> float:
        """How much the bus clock runs fast against the host's, ppm."""
        return (1.0 / self._slope - 1.0) * 1e6

    def add(self, register: int, t_host_ns: int) -> None:
        """Take a pair read together; pairs come in order and less than 64 s apart."""
        cycle_ns = cycle_time_ns(register)
        if self._newest is not None:
            last_cycle_ns, last_host_ns = self._newest
            step_ns = (cycle_ns - last_cycle_ns) % WRAP_NS
            passed_ns = t_host_ns - last_host_ns
            if abs(step_ns - passed_ns) > JUMP_NS + MAX_SKEW * abs(passed_ns):
                self.restarts += 1
                self._begin()
            else:
                cycle_ns = last_cycle_ns + step_ns
        self._newest = (cycle_ns, t_host_ns)
        spacing_ns = SPACING_S * 1e9
        if len(self._pairs) >= 2 and cycle_ns - self._pairs[-2][0] < spacing_ns:
            self._pairs[-1] = self._newest
        else:
            self._pairs.append(self._newest)
        while cycle_ns - self._pairs[0][0] > WINDOW_S * 1e9:
            self._pairs.popleft()
        self._fit()

    def _fit(self) -> None:
        assert self._newest is not None
        cycle0, host0 = self._newest
        pairs = np.array([(c - cycle0, h - host0) for c, h in self._pairs], dtype=float)
        if pairs[-1, 0] - pairs[0, 0] < SPACING_S * 1e9:
            self._slope, self._at_newest_ns = 1.0, 0.0
            return
        x_mean, y_mean = pairs.mean(axis=0)
        x, y = pairs[:, 0] - x_mean, pairs[:, 1] - y_mean
        self._slope = float(x @ y / (x @ x))
        self._at_newest_ns = float(y_mean - self._slope * x_mean)
        residual = y - self._slope * x
        self.sigma_ns = max(float(np.sqrt(np.mean(residual**2))), CYCLE_NS / OFFSETS_PER_CYCLE)

    def to_host_ns(self, cycle_ns: int) -> int:
        """Map a cycle time that lies less than 128 s before the newest pair to CLOCK_MONOTONIC, ns.

        Raises:
            ValueError: No pair was added yet.
        """
        if self._newest is None:
            raise ValueError("no cycle timer reading yet")
        newest_cycle_ns, newest_host_ns = self._newest
        age_ns = (newest_cycle_ns - cycle_ns) % WRAP_NS
        return newest_host_ns + round(self._at_newest_ns - self._slope * age_ns)
