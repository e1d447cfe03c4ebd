"""The emulated GX3 as a machine in time: bytes in, dated bytes out; no pseudo terminal, no thread, no sleep.

So the same device runs behind a pseudo terminal in real time and, for studies, in simulated time as fast as
the processor allows.
"""

from __future__ import annotations

from collections import deque

from vical_mocks.clock import SkewedClock
from vical_mocks.gx3_single_byte import SingleByteFace
from vical_mocks.gx3_state import Gx3State, Identity, Settings
from vical_mocks.imu import BASE_RATE_HZ, ImuErrors, ImuModel, Motion


class Gx3Device:
    """One GX3-25, powered up at `clock.t_start_s`.

    Args:
        motion: True motion over host seconds; None for at rest.
        clock: Its crystal.
        protocol: "single-byte" (firmware below 2) or "mip".
        errors: Sensor errors; None for none.
        seed: Seed of the sensor noise.
        identity: What it answers when asked who it is.
        eeprom: What it starts with.
    """

    def __init__(
        self,
        motion: Motion | None = None,
        *,
        clock: SkewedClock | None = None,
        protocol: str = "single-byte",
        errors: ImuErrors | None = None,
        seed: int = 0,
        identity: Identity | None = None,
        eeprom: Settings | None = None,
        first_ticks: int = 0,
    ) -> None:
        self.clock = clock or SkewedClock()
        model = ImuModel(motion, self.clock, errors, seed)
        self.state = Gx3State(model, self.clock, identity or Identity(), eeprom=eeprom or Settings())
        self.state.ticks_offset = first_ticks
        self.face = SingleByteFace(self.state, self._reset, self._change_baud)
        self.protocol = protocol
        self.sent: deque[tuple[int, float]] = deque(maxlen=2_000_000)
        self._next_k = 0
        self._baud_after: int | None = None
        self.power_up()

    def power_up(self) -> None:
        """As after the supply came on (the base sample counter keeps running for the model's sake)."""
        self.state.power_up()
        self.face.power_up()

    def _reset(self) -> None:
        self.power_up()
        self.state.set_ticks(self._next_k, 0)

    def _change_baud(self, baud: int) -> None:
        self._baud_after = baud

    @property
    def baud(self) -> int:
        """Baud of its UART now."""
        return self.state.settings.baud

    def receive(self, data: bytes, t_host_s: float) -> None:
        """Take bytes from the host; they act at the end of the running cycle."""
        if not self.face.busy:
            k = int(self.clock.device_s(t_host_s) * BASE_RATE_HZ) + 1
            period = self.face.period()
            self._next_k = max(self._next_k, -(-k // period) * period)
        self.face.receive(data)

    def next_s(self) -> float | None:
        """Host time of the next cycle; None while there is nothing to do."""
        return self.clock.host_s(self._next_k / BASE_RATE_HZ) if self.face.busy else None

    def advance(self, t_host_s: float) -> list[tuple[float, bytes]]:
        """Run until a host time; return what became ready to send: (host time, bytes)."""
        out: list[tuple[float, bytes]] = []
        while (t_s := self.next_s()) is not None and t_s <= t_host_s:
            k = self._next_k
            if data := self.face.cycle(k):
                out.append((t_s, data))
                self.sent.append((self.state.ticks(k), t_s))
            period = self.face.period()
            self._next_k = (k // period + 1) * period
        return out
