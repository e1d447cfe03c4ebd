"""What both protocols offer to the driver above them: settings, raw samples, the session protocol."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import msgspec

from vical_drivers.errors import DriverError
from vical_drivers.microstrain.port import BytePort
from vical_drivers.samples import DeviceInfo

_log = logging.getLogger(__name__)
GYRO_ANALOG_DELAY_S = 0.57e-3
"""Analog filter of the GX3's gyro (2-pole RC, 358 Hz)."""
_ADC_AVERAGE_DELAY_S = 29.0 / 60.0 * 1e-3


def group_delay_s(filter_width: int) -> float:
    """Delay of a GX3's gyro chain, s: 30 taps at 30 kHz, M taps at 1 kHz, and the analog filter.

    The accelerometer's analog filter (1-pole RC, 226 Hz) is 0.13 ms slower. One sample has one stamp, and it
    is the gyro's: the time shift of a camera hangs on it, while 0.13 ms hardly change a specific force.

    >>> round(group_delay_s(15) * 1e3, 2)
    8.05
    """
    return _ADC_AVERAGE_DELAY_S + (filter_width - 1) / 2.0 * 1e-3 + GYRO_ANALOG_DELAY_S


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """What is asked of the device.

    Attributes:
        rate_hz: Samples per second; the device divides its own base rate by whole numbers.
        filter_width: M of the moving average on gyro and accelerometer (GX3), 1 .. 32 ms; None: as long as
            a sample lasts.
        baud: Bits per second wanted on the line; None: as found, or more where the rate needs it.
    """

    rate_hz: float = 100.0
    filter_width: int | None = None
    baud: int | None = None

    @property
    def taps(self) -> int:
        """M as it is asked of the device.

        An average as long as a sample lasts is all that happened since the last one, no more and no less: a
        longer one flattens fast motion and counts noise twice, a shorter one leaves motion out.
        """
        return self.filter_width or min(max(round(1000.0 / self.rate_hz), 1), 32)


@dataclass(frozen=True, slots=True)
class Applied:
    """What the device really does, read back from it.

    Attributes:
        rate_hz: Samples per second.
        group_delay_s: Lag of the data behind the device's timer, s; 0 where unknown.
        record_bytes: Length of one sample on the wire.
        tick_hz: Ticks per second of the timer in each sample; 0 where samples carry no time.
        tick_bits: Width of that timer; None where it does not wrap.
        filter_width: M in force, where known.
    """

    rate_hz: float
    group_delay_s: float
    record_bytes: int
    tick_hz: float
    tick_bits: int | None
    filter_width: int | None = None


class RawSample(msgspec.Struct, frozen=True, gc=False):
    """One sample as decoded, in SI units, with the device's own time.

    Attributes:
        ticks: Device timer as on the wire; None where the device sends no usable time.
        gyro_rps: Angular rate, rad/s.
        specific_force_mps2: Specific force, m/s^2.
        t_arrival_ns: CLOCK_MONOTONIC of its last byte, ns.
    """

    ticks: int | None
    gyro_rps: tuple[float, float, float]
    specific_force_mps2: tuple[float, float, float]
    t_arrival_ns: int


def raise_baud(port: BytePort, wanted: int, change: Callable[[int], None], *, explicit: bool) -> None:
    """Change the baud for a rate that needs it, where that means anything.

    On USB the UART's setting has no effect. A pseudo terminal or network bridge may have no baud at all:
    there a refusal is no error unless the user asked for this very baud.

    Raises:
        DriverError: The change failed on a real UART, or was asked for.
    """
    if port.link == "usb" and not explicit:
        return
    found = port.baud
    try:
        change(wanted)
    except DriverError:
        if explicit or port.link != "unknown":
            raise
        port.set_baud(found)
        _log.warning("port=%s baud=%d stays, the device did not follow to %d", port.name, found, wanted)


class Session(Protocol):
    """One open device, spoken to in its protocol."""

    @property
    def protocol(self) -> str:
        """Name of the protocol."""
        ...

    @property
    def checksum_errors(self) -> int:
        """Damaged records so far."""
        ...

    @property
    def skipped_bytes(self) -> int:
        """Bytes so far that belong to no record."""
        ...

    def identify(self) -> DeviceInfo:
        """Ask who it is."""
        ...

    def configure(self, settings: ImuSettings) -> Applied:
        """Set rate and filters (volatile), read them back and compare.

        Raises:
            DeviceRefusedError: The device does not take a setting.
        """
        ...

    def start(self) -> None:
        """Begin to stream."""
        ...

    def read(self, timeout_s: float) -> list[RawSample]:
        """Return what arrived; [] after the timeout."""
        ...

    def stop(self) -> None:
        """End the stream and leave the device as it was found; never raises."""
        ...

    def capture_gyro_bias(self, duration_s: float) -> tuple[float, float, float]:
        """Let the device average its gyro at rest; sets its volatile bias. Returns it, rad/s."""
        ...

    def poll(self, kind: int) -> dict[str, object]:
        """Ask for one record (single-byte data command, or MIP inertial field); its fields in SI units.

        Raises:
            DeviceRefusedError: The device has no such record.
        """
        ...

    def store_gyro_bias(self) -> None:
        """Write the volatile gyro bias to the EEPROM: only ever on a user's explicit wish."""
        ...

    def settings(self) -> dict[str, object]:
        """What is in force now, by name, for people."""
        ...

    def self_test(self) -> dict[str, bool]:
        """Run the built-in test; part -> passed."""
        ...
