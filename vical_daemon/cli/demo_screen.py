"""Progress of `vical demo`: listens on the bus like any other client and draws what it hears."""

from __future__ import annotations

import sys
import time
from typing import Any

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Sample
from vical_daemon.bus.messages import decode_calibration, decode_diagnostics
from vical_daemon.cli import live_table
from vical_daemon.cli.errors import CliError
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.offline.trace import Trace


class Watch:
    """Keeps the last estimate, a trace of one entry a second, and the last status of each role."""

    def __init__(self, bus: Bus, rig: str, camera: str) -> None:
        self.estimate: CalibrationEstimate | None = None
        self.health: dict[str, str] = {}
        self._camera, self._trace = camera, Trace([camera])
        self._t_unsure_s = 0.0
        bus.subscribe(topics.CALIBRATION.key(rig, camera), self._on_estimate)
        bus.subscribe(topics.STATUS.pattern.format(rig=rig, name="*"), self._on_status)

    @property
    def trace(self) -> list[dict[str, Any]]:
        """How the calibration developed, see `Trace`."""
        return self._trace.points[self._camera]

    @property
    def duration_s(self) -> float:
        """Seconds of data so far."""
        return self.estimate.duration_s if self.estimate is not None else 0.0

    @property
    def frames(self) -> int:
        """Images used so far."""
        return self.estimate.frames if self.estimate is not None else 0

    @property
    def converged(self) -> bool:
        """Whether the last estimate is."""
        return self.estimate is not None and self.estimate.status is Status.CONVERGED

    @property
    def converged_for_s(self) -> float:
        """Seconds of data since the status became `converged` (and stayed)."""
        return self.duration_s - self._t_unsure_s

    def latest(self) -> CalibrationEstimate:
        """Return the last estimate.

        Raises:
            CliError: There is none.
        """
        if self.estimate is None:
            raise CliError("the demo failed: nothing was estimated; see the messages above")
        return self.estimate

    def _on_estimate(self, sample: Sample) -> None:
        estimate = self.estimate = decode_calibration(sample.payload).estimate
        if estimate.status is not Status.CONVERGED:
            self._t_unsure_s = estimate.duration_s
        if not self.trace or estimate.duration_s >= self.trace[-1]["t_s"] + 1.0:
            self._trace.take(estimate)

    def _on_status(self, sample: Sample) -> None:
        for status in decode_diagnostics(sample.payload).statuses:
            if status.name != "clock":
                self.health[status.name] = status.message


class Screen:
    """Progress on stderr: a live table on a terminal, a line every five seconds elsewhere."""

    def __init__(self, camera: str, *, quiet: bool) -> None:
        self._camera, self._quiet = camera, quiet
        self._next_s = 0.0
        self._live: Any = None

    def __enter__(self) -> Screen:
        if sys.stderr.isatty() and not self._quiet:
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)
            self._live.__enter__()
        return self

    def __exit__(self, *args: object) -> None:
        if self._live is not None:
            self._live.__exit__(*args)

    def show(self, watch: Watch) -> None:
        """Draw what is known now."""
        estimate = watch.estimate
        if estimate is None or self._quiet:
            return
        if self._live is not None:
            health = [f"{name}: {text}" for name, text in sorted(watch.health.items())]
            self._live.update(live_table.picture(self._camera, estimate, health), refresh=True)
        elif time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + 5.0
            print(live_table.one_line(self._camera, estimate), file=sys.stderr)
