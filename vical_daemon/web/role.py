"""Role web: the page with the live calibration, on loopback unless the config says otherwise.

Read-only, unless a token is set on the robot: in the environment variable VICAL_WEB_TOKEN, or in the file
`web-token` of the state directory.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, Subscription
from vical_daemon.bus.messages import DiagnosticStatus, Level, encode_string
from vical_daemon.config.model import Config
from vical_daemon.config.paths import state_directory
from vical_daemon.config.priors import calibration_options
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.service.health import StatusSender
from vical_daemon.service.wall_clock import WallClock, service_clock
from vical_daemon.web.camera_watch import CameraWatch
from vical_daemon.web.downloads import Downloads
from vical_daemon.web.images import CameraView
from vical_daemon.web.server import PageServer
from vical_daemon.web.state import WebState

if TYPE_CHECKING:
    from vical_daemon.web.foxglove import FoxgloveServer

TOKEN_VARIABLE = "VICAL_WEB_TOKEN"  # noqa: S105  (the name of the variable, not a secret)
TOKEN_FILE = "web-token"  # noqa: S105
_log = logging.getLogger(__name__)


class WebError(Exception):
    """The page cannot be served; the message says where and what to try."""


class _Feeds:
    """Subscriptions of the page: calibrations and statuses always, images only while there are viewers."""

    def __init__(self, config: Config, bus: Bus, state: WebState) -> None:
        self._config, self._bus, self._state = config, bus, state
        self.views = {name: CameraView(name) for name in config.cameras}
        self._always = [
            bus.subscribe(topics.CALIBRATION.key(config.rig, name), state.take) for name in config.cameras
        ]
        seen = (topics.POINTS, topics.TRACKS, topics.PREDICTED, topics.STORED, topics.VERIFY)
        self._always += [
            bus.subscribe(t.key(config.rig, n), state.take) for n in config.cameras for t in seen
        ]
        self._always.append(bus.subscribe(f"{topics.ROOT}/{config.rig}/status/*", state.take))
        self._watched: dict[str, list[Subscription]] = {}
        for sample in bus.latest(f"{topics.ROOT}/{config.rig}/**"):
            state.take(sample)  # the last values from before the page started

    def watch(self, camera: str, on: bool) -> None:
        """Start or stop fetching images and points of one camera."""
        for subscription in self._watched.pop(camera, []):
            subscription.close()
        if on:
            view, rig = self.views[camera], self._config.rig
            kinds = (topics.POINTS, topics.TRACKS, topics.PREDICTED, topics.IMAGE, topics.COMPRESSED)
            self._watched[camera] = [self._bus.subscribe(t.key(rig, camera), view.take) for t in kinds]

    def close(self) -> None:
        """Leave the bus."""
        for camera in list(self._watched):
            self.watch(camera, False)
        for subscription in self._always:
            subscription.close()


def run(
    config: Config,
    bus: Bus,
    stop: threading.Event,
    *,
    clock: WallClock | None = None,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Serve the page until `stop`.

    Args:
        config: The rig; host and port in `config.web` (port 0: any free one).
        bus: Source of the data, and destination of commands.
        stop: Ends the role.
        clock: Monotonic to UNIX time; None: the clock that all processes of the service share.
        ready: Called with the address once it is served.

    Raises:
        WebError: The address cannot be used.
    """
    clock = clock or service_clock()
    points_m = _target_points(config)
    watches = {name: CameraWatch(points_m, camera.size) for name, camera in config.cameras.items()}
    state = WebState(config.rig, watches=watches, targets=calibration_options(config).targets)
    feeds = _Feeds(config, bus, state)
    try:
        asyncio.run(_serve(config, bus, stop, clock, state, feeds, ready))
    finally:
        feeds.close()


async def _serve(
    config: Config,
    bus: Bus,
    stop: threading.Event,
    clock: WallClock,
    state: WebState,
    feeds: _Feeds,
    ready: Callable[[str], None] | None,
) -> None:
    def command(role: str, word: str) -> None:
        bus.publish(topics.COMMAND.key(config.rig, role), encode_string(word))

    settings = config.web
    server = PageServer(
        state,
        feeds.views,
        feeds.watch,
        command,
        read_token(),
        settings.picture_rate_hz,
        settings.hosts,
        Downloads(config, state),
    )
    host, port = settings.host, settings.port
    try:
        port = await server.listen(host, port)
    except OSError as error:
        await server.close()
        code = error.errno or 0  # positive codes are the kernel's, whose text is shorter than asyncio's
        reason = os.strerror(code) if code > 0 else error.strerror or str(error)
        raise WebError(
            f"cannot serve the page on {host}:{port}: {reason}; set web.host or web.port"
        ) from error
    address = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
    _log.info("page at %s", address)
    if ready is not None:
        ready(address)
    status = StatusSender(config.rig, "web", bus, clock)
    viewer = _foxglove(config, bus)

    def statuses() -> list[DiagnosticStatus]:
        values = {"malformed": str(state.malformed), "address": address} | server.counters()
        return [DiagnosticStatus(Level.OK, "web", address, "", values)]

    def stopped() -> bool:
        status.tick(statuses)
        return stop.is_set()

    try:
        await server.run(stopped)
    finally:
        if viewer is not None:
            viewer.close()
        await server.close()


def _target_points(config: Config) -> FloatArray | None:
    """Return the points of the board; None without a target, or where its file is not on this computer."""
    if config.target_path is None or config.calibration.mode == "target_free":
        return None
    from vical_daemon.vision.target import TargetError, load_target

    try:
        return load_target(config.target_path).points_m
    except TargetError as error:
        _log.warning("the page does not know the board: %s", error)
        return None


def _foxglove(config: Config, bus: Bus) -> FoxgloveServer | None:
    """Start the Foxglove server if the config asks for it; a used port must not stop the page."""
    if not config.web.foxglove_port:
        return None
    from vical_daemon.web.foxglove import FoxgloveError, FoxgloveServer

    try:
        viewer = FoxgloveServer(bus, config, config.web.host, config.web.foxglove_port)
    except FoxgloveError as error:
        _log.warning("%s; set web.foxglove_port", error)
        return None
    _log.info("Foxglove at ws://%s:%d", config.web.host, viewer.port)
    return viewer


def read_token() -> str:
    """Return the token that allows commands; "" if none is set: commands are disabled."""
    token = os.environ.get(TOKEN_VARIABLE, "")
    if token:
        return token.strip()
    try:
        return (state_directory() / TOKEN_FILE).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
