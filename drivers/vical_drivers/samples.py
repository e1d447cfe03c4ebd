"""What drivers deliver: frozen, stamped samples, and the protocols of their sources.

Inside one host every stamp is CLOCK_MONOTONIC in integer nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import msgspec
import numpy as np
import numpy.typing as npt


class ImuSample(msgspec.Struct, frozen=True, gc=False):
    """One inertial sample; a struct in C, because it is made 1000 times a second.

    Attributes:
        t_host_ns: Instant the sensor *measured* (device clock mapped to CLOCK_MONOTONIC, wire time
            and the sensor's own filter delay subtracted), ns.
        t_arrival_ns: CLOCK_MONOTONIC when the bytes were read, ns; for diagnosis only.
        device_ticks: Device clock, unwrapped (never decreases within one power-up).
        gyro_rps: Angular rate in the imu frame, rad/s.
        specific_force_mps2: Specific force in the imu frame, m/s^2 (level and at rest: one axis reads
            9.8 *against* gravity; what an accelerometer measures, not acceleration).
        t_sigma_ns: One-sigma uncertainty of `t_host_ns`, ns.
        lost_before: Samples known to be missing just before this one.
    """

    t_host_ns: int
    t_arrival_ns: int
    device_ticks: int
    gyro_rps: tuple[float, float, float]
    specific_force_mps2: tuple[float, float, float]
    t_sigma_ns: int = 0
    lost_before: int = 0


@dataclass(frozen=True, slots=True)
class Frame:
    """One image.

    Attributes:
        t_exposure_mid_ns: Middle of the exposure, CLOCK_MONOTONIC, ns.
        t_arrival_ns: When the frame reached this process, CLOCK_MONOTONIC, ns.
        sequence: The source's own frame number; gaps are dropped frames.
        image: Pixels, shape (height, width) uint8/uint16 or (height, width, 3) uint8 (BGR).
        encoding: ROS name of the pixel format: mono8, mono16 or bgr8.
        stamp_rule: How the stamp was made, e.g. "soe+exposure/2", "eof-readout-exposure/2",
            "uvc-pts+exposure/2", "embedded-cycle-timer", "simulated".
        exposure_ns: Exposure time where known, ns.
        readout_ns: First to last row where known (0 for a global shutter), ns.
        t_sigma_ns: One-sigma uncertainty of the stamp, ns.
        dropped_before: Frames known to be missing just before this one, or found only now to be missing
            before the last one.
    """

    t_exposure_mid_ns: int
    t_arrival_ns: int
    sequence: int
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    encoding: str
    stamp_rule: str
    exposure_ns: int | None = None
    readout_ns: int | None = None
    t_sigma_ns: int = 0
    dropped_before: int = 0


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Identity of a device; `serial_number` keys the stored calibration."""

    kind: str
    model: str
    serial_number: str
    firmware: str = ""
    path: str = ""
    protocol: str = ""
    details: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SourceStats:
    """Counters of a source since it was opened; `extra` holds what only one kind has.

    Attributes:
        jitter_us: Spread of arrivals or stamps about an even grid, us; None: recorded data are played back,
            whose times of arrival say nothing about a device.
    """

    samples: int = 0
    lost: int = 0
    checksum_errors: int = 0
    resync_bytes: int = 0
    reconnects: int = 0
    rate_hz: float = 0.0
    clock_skew_ppm: float = 0.0
    jitter_us: float | None = 0.0
    extra: dict[str, float] = field(default_factory=dict)


class Source(Protocol):
    """What every source of samples has; leaving its `with` block closes it."""

    @property
    def info(self) -> DeviceInfo:
        """Identity of the device."""
        ...

    def stats(self) -> SourceStats:
        """Counters since the source was opened."""
        ...

    def close(self) -> None:
        """Stop the stream and free the device; may be called twice."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


@runtime_checkable
class ImuSource(Source, Protocol):
    """Anything that yields inertial samples: driver, emulation or replay."""

    def read(self, timeout_s: float) -> list[ImuSample]:
        """Return the samples that arrived, in order; [] after `timeout_s` without any.

        Raises:
            DeviceLostError: The device went away; `read` may be called again after a pause, and the
                source reconnects automatically.
            DeviceReplacedError: Another device came back in its place; this source is closed.
        """
        ...


@runtime_checkable
class FrameSource(Source, Protocol):
    """Anything that yields frames: camera driver, simulated camera or replay."""

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s` without one.

        Raises:
            DeviceLostError: The camera went away; `read` may be called again after a pause.
        """
        ...
