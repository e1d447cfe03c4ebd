"""The emulated GX3 as a machine in time: bytes in, dated bytes out; no pseudo terminal, no thread, no sleep.

So the same device runs behind a pseudo terminal in real time and, for studies, in simulated time as fast as
the processor allows.
"""

from __future__ import annotations

from collections import deque

from vical_mocks.clock import SkewedClock
from vical_mocks.gx3_mip import MipFace
from vical_mocks.gx3_single_byte import SingleByteFace
from vical_mocks.gx3_state import Gx3State, Identity, Settings
from vical_mocks.imu import BASE_RATE_HZ, ImuErrors, ImuModel, Motion


class Gx3Device:
    """One GX3-25, powered up at `clock.t_start_s`.

    Args:
        motion: True motion over host seconds; None for at rest.
        clock: Its crystal.
        protocol: "single-byte" (firmware below 2) or "mip".
        model: For MIP: "gx3", "gx5" or "cv7" (see `mip_models.MODELS`).
        errors: Sensor errors; None for none.
        seed: Seed of the sensor noise.
        identity: What it answers when asked who it is.
        eeprom: What it starts with.
        first_ticks: Its timer at the first power-up.

    Attributes:
        baud: Bits per second of its UART.
        sent: (timer, true host time) of the cycles that sent something: the truth for time stamps.
    """

    def __init__(
        self,
        motion: Motion | None = None,
        *,
        clock: SkewedClock | None = None,
        protocol: str = "single-byte",
        model: str = "gx3",
        errors: ImuErrors | None = None,
        seed: int = 0,
        identity: Identity | None = None,
        eeprom: Settings | None = None,
        first_ticks: int = 0,
    ) -> None:
        self.clock = clock or SkewedClock()
        imu = ImuModel(motion, self.clock, errors, seed)
        self.state = Gx3State(imu, self.clock, identity or Identity(), eeprom=eeprom or Settings())
        self.face: SingleByteFace | MipFace
        if protocol == "mip":
            self.face = MipFace(self.state, self._reset, self._change_baud, model)
        elif protocol == "single-byte":
            self.face = SingleByteFace(self.state, self._reset, self._change_baud)
        else:
            raise ValueError(f"unknown protocol {protocol!r}; known are single-byte, mip")
        self.sent: deque[tuple[int, float]] = deque(maxlen=2_000_000)
        self._next_k, self._done_k = 0, -1
        self._coming_baud: int | None = None
        self.power_up(self.clock.t_start_s)
        self.state.set_ticks(0, first_ticks)

    def power_up(self, t_host_s: float) -> None:
        """As after the supply came on: settings from the EEPROM, timer at zero."""
        self.state.power_up()
        self.face.power_up()
        self.baud = self.state.settings.baud
        self._coming_baud = None
        self._next_k = self._k_after(t_host_s)
        self.state.set_ticks(self._next_k, 0)

    def _k_after(self, t_host_s: float) -> int:
        """First base sample after a host time that ends a cycle."""
        k = int(self.clock.device_s(t_host_s) * BASE_RATE_HZ) + 1
        period = self.face.period()
        return -(-k // period) * period

    def _reset(self) -> None:
        self.power_up(self.clock.host_s(self._next_k / BASE_RATE_HZ))

    def _change_baud(self, baud: int) -> None:
        self._coming_baud = baud

    def wire_is_idle(self) -> None:
        """Tell the device that all it said has left the wire: now a new baud takes effect."""
        if self._coming_baud is not None:
            self.baud, self._coming_baud = self._coming_baud, None

    def receive(self, data: bytes, t_host_s: float) -> None:
        """Take bytes from the host; they act at the end of the running cycle."""
        before = self.face.busy
        self.face.receive(data)
        next_k = self._k_after(t_host_s)
        # Where nothing was to be done, the next cycle stands where a stream would have gone on: ignore it.
        self._next_k = min(self._next_k, next_k) if before else max(self._done_k + 1, next_k)

    def next_s(self) -> float | None:
        """Host time of the next cycle; None while there is nothing to do."""
        return self.clock.host_s(self._next_k / BASE_RATE_HZ) if self.face.busy else None

    def advance(self, t_host_s: float) -> list[tuple[float, bytes]]:
        """Run until a host time; return what became ready to send: (host time, bytes)."""
        out: list[tuple[float, bytes]] = []
        while (t_s := self.next_s()) is not None and t_s <= t_host_s:
            k = self._done_k = self._next_k
            if data := self.face.cycle(k):
                out.append((t_s, data))
                self.sent.append((self.state.ticks(k), t_s))
            period = self.face.period()
            self._next_k = max(self._next_k, (k // period + 1) * period)
        return out
