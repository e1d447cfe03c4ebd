"""What both protocols of the emulated GX3 share: settings, EEPROM, timer, sensor values."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from vical_mocks.clock import SkewedClock
from vical_mocks.imu import FloatArray, ImuModel

G_MPS2 = 9.80665
TICKS_PER_BASE_SAMPLE = 62.5
BAUDS = (115_200, 230_400, 460_800, 921_600)


@dataclass(slots=True)
class Identity:
    """Strings that the device answers with."""

    firmware: int = 1130
    model_number: str = "6223-4220"
    serial_number: str = "6223-12345"
    model_name: str = "3DM-GX3-25"
    options: str = "5g, 300d/s"
    lot: str = "I042Y"


@dataclass(slots=True)
class Settings:
    """Sampling settings (0xDB) and what else the EEPROM keeps."""

    decimation: int = 10
    flags: int = 0x0003
    taps: int = 15
    mag_taps: int = 17
    up_s: int = 10
    north_s: int = 10
    mag_power: int = 0
    baud: int = 115_200
    power_up_mode: int = 1
    preset_command: int = 0
    gyro_bias_rps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accel_bias_g: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(slots=True)
class Gx3State:
    """A GX3 between two commands.

    Attributes:
        model: The sensor.
        clock: Its crystal.
        identity: Who it says it is.
        settings: In force now.
        eeprom: In force after power-up.
        eeprom_writes: How often anything was stored; a good driver leaves it at 0.
        ticks_offset: Added to 62.5 ticks per base sample; moves when the timer is set.
    """

    model: ImuModel
    clock: SkewedClock
    identity: Identity = field(default_factory=Identity)
    settings: Settings = field(default_factory=Settings)
    eeprom: Settings = field(default_factory=Settings)
    eeprom_writes: int = 0
    ticks_offset: int = 0
    eeprom_words: dict[int, int] = field(default_factory=dict)

    def power_up(self) -> None:
        """Take the settings from the EEPROM."""
        self.settings = replace(self.eeprom)

    def store(self, **changes: object) -> None:
        """Write settings to the EEPROM."""
        self.eeprom = replace(self.eeprom, **changes)  # type: ignore[arg-type]
        self.eeprom_writes += 1

    def ticks(self, k: int) -> int:
        """The 32-bit timer at base sample `k`: 62.5 ticks a sample, so it steps by 62 and 63."""
        return (int(k * TICKS_PER_BASE_SAMPLE) + self.ticks_offset) % 2**32

    def set_ticks(self, k: int, value: int) -> None:
        """Restart the timer at `value`."""
        self.ticks_offset += value - self.ticks(k)

    def accel_g(self, k: int) -> FloatArray:
        """Filtered specific force, g, bias taken off."""
        return self.model.sample(k, self.settings.taps)[1] / G_MPS2 - self.settings.accel_bias_g

    def gyro_rps(self, k: int) -> FloatArray:
        """Filtered angular rate, rad/s, bias taken off."""
        return self.model.sample(k, self.settings.taps)[0] - self.settings.gyro_bias_rps

    def increments(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Delta angle (rad) and delta velocity (g s) over one data period."""
        angle, velocity = self.model.increments(k, self.settings.decimation)
        period_s = self.settings.decimation / 1000.0
        return (
            angle - np.array(self.settings.gyro_bias_rps) * period_s,
            velocity / G_MPS2 - np.array(self.settings.accel_bias_g) * period_s,
        )

    def mag_gauss(self, k: int) -> FloatArray:
        """A steady field; NaN where the magnetometer is switched off."""
        off = self.settings.flags & 0x100
        return np.full(3, np.nan) if off else np.array([0.2, 0.01, 0.45]) + 0.0 * k

    def matrix(self, k: int) -> FloatArray:
        """Orientation matrix M: V_local = M V_earth, earth axes north, east, down."""
        if not self.settings.flags & 1:
            return np.full((3, 3), np.nan)
        down = -self.accel_g(k)
        down = down / max(float(np.linalg.norm(down)), 1e-9)
        field = np.array([0.2, 0.01, 0.45])
        east = np.cross(down, field)
        east = east / max(float(np.linalg.norm(east)), 1e-9)
        return np.column_stack([np.cross(east, down), east, down])

    def capture_gyro_bias(self, k: int, duration_ms: int) -> tuple[float, float, float]:
        """Average the raw gyro over the last `duration_ms` and take it as the bias."""
        first = k - max(duration_ms, 1)
        steps = range(first, k, max(1, self.settings.taps))
        mean = np.mean([self.model.sample(i, self.settings.taps)[0] for i in steps], axis=0)
        self.settings.gyro_bias_rps = (float(mean[0]), float(mean[1]), float(mean[2]))
        return self.settings.gyro_bias_rps
