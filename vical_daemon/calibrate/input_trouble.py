"""What the estimator cannot see of its input: devices that deliver nothing new, a target file that is wrong.

A calibration stays what it is while its devices are gone: `converged` says how well it is known, not that
data arrive. So that nobody takes an old estimate for one that is being followed, its reason says what is
missing. No I/O, no clock.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

from vical_daemon.bus.messages import DiagnosticsMessage, DiagnosticStatus, Level
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.guidance import Guidance
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.service.liveness import FRESH_S

_TURN_S = 1.0
"""At most so much of the time between two looks counts, s: the estimator may have been busy for longer, and
what arrived meanwhile still waits in the queue."""
_PERIODS = 5.0  # a slow camera is silent after so many intervals
WRONG_TARGET = "wrong_target"
"""Value of a detector's status: what its images contradict in the target file, one line."""
LOOKS_FOR = "looks_for"
"""Likewise: the board that it found in none of many images, in words."""
_REFUSED = 0.01
"""Share of refused readings from which on they are the IMU's trouble. Bytes damaged on a serial line pass its
checksum once in 65 536 times."""
_LEAST, _LATEST = 200, 2000  # readings of which the share is taken
_NOTHING_YET = (Status.WAITING, Status.INITIALISING)


@dataclass(slots=True)
class _Device:
    """One device.

    Attributes:
        limit_s: It is silent if nothing new came for longer, s.
        age_s: Since something new came, or since the role began, s.
        ever: Something has come.
        repeats: Messages came since, with nothing new in them.
        driven: Its driver says how old its last data are.
    """

    limit_s: float
    age_s: float = 0.0
    ever: bool = False
    repeats: bool = False
    driven: bool = False


class InputTrouble:
    """Follows what comes from the devices of one calibration.

    Args:
        imu: Name of the IMU.
        camera_rates_hz: Nominal rate of each camera, by name.
        always: All data come here all the time. If not, what drivers say of their last data counts as well.
    """

    def __init__(self, imu: str, camera_rates_hz: Mapping[str, float], *, always: bool = True) -> None:
        self._always = always
        self._imu = f"imu/{imu}"
        self._devices = {self._imu: _Device(FRESH_S)}
        for name, rate_hz in camera_rates_hz.items():
            self._devices[f"camera/{name}"] = _Device(max(FRESH_S, _PERIODS / rate_hz))
        self._said: dict[str, str] = {}  # what is wrong with a device or its detector, by name
        self._refused: dict[str, str] = {}  # why the last message that came cannot be true
        self._why_refused, self._counts = "", [0, 0]  # of the imu's latest readings: used, refused
        self._units_announced = False
        self._wrong_target: dict[str, str] = {}  # what images contradict in the target file, by camera
        self._looks_for: dict[str, str] = {}  # the board that was found in no image, by camera
        self._looked_s: float | None = None

    def imu_came(self, count: int = 1, *, new: bool) -> None:
        """Readings came; `new`: not only the same one again."""
        self._came(self._imu, new=new)
        self._count(0, count)

    def imu_refused(self, why: str) -> None:
        """A reading came that no device measures; `why`: one line."""
        self._refused[self._imu] = f"its readings are refused: {why}"
        self._why_refused = why
        self._count(1, 1)

    def _count(self, which: int, count: int) -> None:
        self._counts[which] += count
        if sum(self._counts) > _LATEST:
            self._counts = [n // 2 for n in self._counts]

    @property
    def partly_refused(self) -> str:
        """Say that some of the imu's latest readings are refused, and why; empty: hardly any are."""
        total = sum(self._counts)
        share = self._counts[1] / max(total, 1)
        if share < _REFUSED or total < _LEAST:
            return ""
        name = self._imu.partition("/")[2]
        return f"{100.0 * share:.0f} % of {name}'s readings are refused: {self._why_refused}"

    def causes(self, events: list[Event]) -> list[Event]:
        """Return events with the cause, once, in place of the gaps that refused readings leave."""
        refused = self.partly_refused
        if refused:
            events = [event for event in events if event.kind is not EventKind.IMU_GAP]
            events += [Event(EventKind.IMU_UNITS, said=refused)]
        kept = [e for e in events if e.kind is not EventKind.IMU_UNITS or not self._units_announced]
        self._units_announced |= any(event.kind is EventKind.IMU_UNITS for event in kept)
        return kept

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
            self._refused.pop(name, None)

    def take(self, message: DiagnosticsMessage) -> None:
        """Take what a role says of its devices."""
        for status in message.statuses:
            bad = status.level > Level.OK
            self._said[status.name] = status.message if bad else ""
            if not self._always:
                self._of_driver(status)
            role, _, name = status.name.partition("/")
            if WRONG_TARGET in status.values:
                self._wrong_target[name] = status.values[WRONG_TARGET]
            if role == "detect":
                self._looks_for[name] = status.values.get(LOOKS_FOR, "")

    def _of_driver(self, status: DiagnosticStatus) -> None:
        device = self._devices.get(status.name)
        with suppress(KeyError, ValueError):
            age_s = float(status.values["data_age_s"])
            if device is not None:
                device.driven, device.ever = True, device.ever or math.isfinite(age_s)
                device.age_s = age_s if math.isfinite(age_s) else device.age_s

    def look(self, now_s: float, listening: Container[str] = ()) -> None:
        """Let time pass.

        Args:
            now_s: By a steady clock, s.
            listening: Components whose data come here now, if not all do always.
        """
        passed_s = 0.0 if self._looked_s is None else min(max(now_s - self._looked_s, 0.0), _TURN_S)
        self._looked_s = now_s
        for name, device in self._devices.items():
            if self._always or device.driven or name in listening:
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
        why = self._refused.get(name) or self._said.get(name) or self._said.get(f"detect/{short}", "")
        return f"{line}: {why}" if why else line

    def of_camera(self, camera: str) -> str:
        """Say what one camera's calibration lacks, and why; empty: nothing."""
        return self.words((self._imu, f"camera/{camera}"))

    def told(self, estimate: CalibrationEstimate, camera: str) -> CalibrationEstimate:
        """Return an estimate as it is published for one camera, with the trouble of its input.

        What the status says of a calibration stands. While something is missing no motion is asked for, which
        would not be seen. A camera of which nothing is known waits, whatever is known of the others.
        """
        missing = self.of_camera(camera)
        refused = "" if missing else self.partly_refused
        wrong = "; ".join(filter(None, (refused, self._wrong_target.get(camera, ""))))
        board = self._looks_for.get(camera, "") if estimate.status is Status.WAITING else ""
        if board and not missing and not wrong:
            text = f"{estimate.reason}; {camera} looks for {board}, as the target file says"
            return replace(estimate, reason=text)
        if not missing and not wrong:
            return estimate
        if camera not in estimate.cameras and camera in self.cameras:
            estimate = replace(estimate, status=Status.WAITING, progress=0.0)
        reason = "" if estimate.status in _NOTHING_YET else estimate.reason
        estimate = replace(estimate, reason="; ".join(filter(None, (missing, wrong, reason))))
        return replace(estimate, guidance="", next_motion=Guidance()) if missing else estimate
