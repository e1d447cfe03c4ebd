"""Which devices deliver nothing new, for how long, and why. No I/O, no clock.

A calibration stays what it is while its devices are gone: `converged` says how well it is known, not that
data arrive. So that nobody takes an old estimate for one that is being followed, its reason says what is
missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from vical_daemon.bus.messages import DiagnosticsMessage, Level
from vical_daemon.estimation.guidance import Guidance
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.service.liveness import FRESH_S

_TURN_S = 1.0
"""At most so much of the time between two looks counts, s: the estimator may have been busy for longer, and
what arrived meanwhile still waits in the queue."""
_PERIODS = 5.0  # a slow camera is silent after so many intervals
_NOTHING_YET = (Status.WAITING, Status.INITIALISING)


@dataclass(slots=True)
class _Device:
    """One device.

    Attributes:
        limit_s: It is silent if nothing new came for longer, s.
        age_s: Since something new came, or since the role began, s.
        ever: Something has come.
        repeats: Messages came since, with nothing new in them.
    """

    limit_s: float
    age_s: float = 0.0
    ever: bool = False
    repeats: bool = False


class Silence:
    """Follows what comes from the devices of one calibration.

    Args:
        imu: Name of the IMU.
        camera_rates_hz: Nominal rate of each camera, by name.
    """

    def __init__(self, imu: str, camera_rates_hz: Mapping[str, float]) -> None:
        self._imu = f"imu/{imu}"
        self._devices = {self._imu: _Device(FRESH_S)}
        for name, rate_hz in camera_rates_hz.items():
            self._devices[f"camera/{name}"] = _Device(max(FRESH_S, _PERIODS / rate_hz))
        self._said: dict[str, str] = {}  # what is wrong with a device or its detector, by name
        self._looked_s: float | None = None

    def imu_came(self, *, new: bool) -> None:
        """Readings came; `new`: not only the same one again."""
        self._came(self._imu, new=new)

    def image_came(self, camera: str, *, new: bool) -> None:
        """What was found in an image came; `new`: not the same as in the one before, to the last bit."""
        self._came(f"camera/{camera}", new=new)

    def _came(self, name: str, *, new: bool) -> None:
        device = self._devices.get(name)
        if device is None:
            return
        device.repeats = not new
        if new:
            device.age_s, device.ever = 0.0, True

    def take(self, message: DiagnosticsMessage) -> None:
        """Take what a role says of its devices."""
        for status in message.statuses:
            bad = status.level > Level.OK
            self._said[status.name] = status.message if bad else ""

    def look(self, now_s: float) -> None:
        """Let time pass, by a steady clock, s."""
        passed_s = 0.0 if self._looked_s is None else min(max(now_s - self._looked_s, 0.0), _TURN_S)
        self._looked_s = now_s
        for device in self._devices.values():
            device.age_s += passed_s

    @property
    def silent(self) -> dict[str, float]:
        """Components (``imu/imu0``, ``camera/cam0``) from which nothing new comes, and for how long, s."""
        return {name: d.age_s for name, d in self._devices.items() if d.age_s > d.limit_s}

    @property
    def cameras(self) -> frozenset[str]:
        """Names of the cameras among them."""
        return frozenset(name.removeprefix("camera/") for name in self.silent if name != self._imu)

    def words(self, names: Iterable[str] | None = None) -> str:
        """Say what is missing, and why; empty: nothing.

        Args:
            names: Components to speak of; None: all.
        """
        wanted = set(self._devices if names is None else names)
        return "; ".join(self._line(name) for name in self.silent if name in wanted)

    def _line(self, name: str) -> str:
        device, short = self._devices[name], name.partition("/")[2]
        since = f"for {device.age_s:.0f} s" if device.ever else f"yet, after {device.age_s:.0f} s"
        line = f"nothing from {short} {since}"
        if device.repeats:
            line = f"nothing new from {short} {since}: it delivers the same again and again"
        why = self._said.get(name) or self._said.get(f"detect/{short}", "")
        return f"{line}: {why}" if why else line

    def told(self, estimate: CalibrationEstimate, camera: str) -> CalibrationEstimate:
        """Return an estimate as it is published for one camera, with what is missing of its devices.

        What the status says of a calibration stands. It asks for no motion, which would not be seen. A camera
        of which nothing is known waits, whatever is known of the others.
        """
        words = self.words((self._imu, f"camera/{camera}"))
        if not words:
            return estimate
        if camera not in estimate.cameras and camera in self.cameras:
            estimate = replace(estimate, status=Status.WAITING, progress=0.0)
        reason = "" if estimate.status in _NOTHING_YET else estimate.reason
        reason = "; ".join(filter(None, (words, reason)))
        return replace(estimate, reason=reason, guidance="", next_motion=Guidance())
