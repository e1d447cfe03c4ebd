"""HTTP: the page, server-sent events, MJPEG, metrics, and (behind a token) commands."""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
from aiohttp import web

from vical_daemon.bus.log_limit import LogLimit
from vical_daemon.results.export import ExportError
from vical_daemon.results.report.scene import SCRIPT as SCENE_SCRIPT
from vical_daemon.web.connections import BODY_S, Gate, Malformed, http_logger
from vical_daemon.web.downloads import Downloads
from vical_daemon.web.hosts import AllowedHosts
from vical_daemon.web.images import CameraView, Sight, drawn_jpeg, picture_event
from vical_daemon.web.metrics import metrics
from vical_daemon.web.state import WebState

TICK_S = 0.4
VIEWERS_LIMIT = 32
SLOW_S = 10.0  # a client that takes longer to receive an update is disconnected
STATIC = Path(__file__).parent / "static"
PICTURE_RATE_HZ = 2.0
COMMANDS = {  # name on the page: role and command
    "record_start": ("record", "start"),
    "record_stop": ("record", "stop"),
    "reset": ("estimate", "reset"),
    "accept": ("estimate", "accept"),
    "discard": ("estimate", "discard"),
    "calibrate": ("estimate", "calibrate"),
    "verify": ("estimate", "verify"),
    "check": ("estimate", "check"),
}
_FILES: dict[str, str | Path] = {
    "": "index.html",
    "style.css": "style.css",
    "app.js": "app.js",
    "chart.js": "chart.js",
    "camera.js": "camera.js",
    "meters.js": "meters.js",
    "decide.js": "decide.js",
    "scene.js": SCENE_SCRIPT,  # the report draws with it, too
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
_log = logging.getLogger(__name__)

Watch = Callable[[str, bool], None]
Command = Callable[[str, str], None]


class PageServer:
    """Serves the page. All methods run in one event loop.

    Args:
        state: State to show.
        views: Camera views by name.
        watch: Called with (camera, True) for the first viewer of a camera, (camera, False) after the
            last one: without viewers no image is fetched.
        command: Called with (role, word) for a command; None: read-only.
        token: Token that a client must send with a command; "": no client may command.
        picture_rate_hz: Highest picture rate.
        hosts: Further host names of the page, besides this computer's own.
        downloads: Makes exports and finds the log; None: there are none.
    """

    def __init__(
        self,
        state: WebState,
        views: dict[str, CameraView],
        watch: Watch,
        command: Command | None = None,
        token: str = "",
        picture_rate_hz: float = PICTURE_RATE_HZ,
        hosts: Sequence[str] = (),
        downloads: Downloads | None = None,
    ) -> None:
        self._downloads = downloads
        self.state, self.views = state, views
        self._watch, self._command, self._token = watch, command, token
        self._number = 0
        self._update = b""
        self._ticked = asyncio.Condition()
        self._listeners = 0
        self._picture_s = 1.0 / picture_rate_hz
        self._hosts = AllowedHosts(hosts)
        self._gate: Gate | None = None
        self._runner: web.AppRunner | None = None
        self._listener: asyncio.Server | None = None
        self._malformed = Malformed()
        self._refusals = LogLimit(5, 60.0)
        self._refused = 0
        self._broadcasts = {
            (name, kind): _Broadcast(make)
            for name in views
            for kind, make in (("events", picture_event), ("mjpg", drawn_jpeg))
        }

    def application(self) -> web.Application:
        """Return the aiohttp application."""
        app = web.Application(middlewares=[self._secure], client_max_size=4096)
        app.router.add_get("/events", self._events)
        app.router.add_get("/camera/{name}/events", self._picture_events)
        app.router.add_get("/camera/{name}.mjpg", self._mjpeg)
        app.router.add_get("/api/state", self._state)
        app.router.add_post("/api/command", self._post_command)
        app.router.add_get("/api/export/{format:[a-z0-9]+}", self._export)
        app.router.add_get("/api/log", self._log_file)
        app.router.add_get("/metrics", self._metrics)
        app.router.add_get("/{file:[a-z.]*}", self._static)
        return app

    async def listen(self, host: str, port: int) -> int:
        """Start serving; return the port (0: any free port).

        Raises:
            OSError: The address cannot be used.
        """
        self._runner = web.AppRunner(
            self.application(), access_log=None, shutdown_timeout=0.3, logger=http_logger(self._malformed)
        )
        await self._runner.setup()
        assert self._runner.server is not None
        self._gate = Gate(self._runner.server)
        self._listener = await asyncio.get_running_loop().create_server(self._gate, host, port)
        return int(self._listener.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Stop serving; may be called twice."""
        if self._listener is not None:
            self._listener.close()
        if self._runner is not None:
            await self._runner.cleanup()

    def counters(self) -> dict[str, str]:
        """Return counters of connections and requests."""
        return {
            "connections": str(self._gate.open if self._gate else 0),
            "connections_refused": str(self._gate.refused if self._gate else 0),
            "requests_malformed": str(self._malformed.count),
            "requests_refused": str(self._refused),
        }

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Until `stopped`: process messages from the bus and wake the listeners, once per tick."""
        loop = asyncio.get_running_loop()
        pictures = [loop.create_task(self._make_pictures(name)) for name in self.views]
        try:
            while not stopped():
                begin_s = loop.time()
                update = self.state.tick(wanted=self._listeners > 0)
                self._update = _event("update", update) if update is not None else b""
                async with self._ticked:
                    self._number += 1
                    self._ticked.notify_all()
                if self._gate is not None:
                    self._gate.sweep()
                await asyncio.sleep(max(TICK_S - (loop.time() - begin_s), 0.01))
        finally:
            for task in pictures:
                task.cancel()
            await asyncio.gather(*pictures, return_exceptions=True)

    async def _make_pictures(self, name: str) -> None:
        """Make each picture once for all viewers, and none while there are no viewers."""
        broadcasts = [broadcast for (camera, _), broadcast in self._broadcasts.items() if camera == name]
        while True:
            wanted = [broadcast for broadcast in broadcasts if broadcast.viewers]
            sight = self.views[name].next() if wanted else None
            if sight is not None:
                for broadcast in wanted:
                    await broadcast.make(sight)
            await asyncio.sleep(self._picture_s)

    async def _static(self, request: web.Request) -> web.StreamResponse:
        name = _FILES.get(request.match_info["file"])
        if name is None:
            raise web.HTTPNotFound
        return web.FileResponse(STATIC / name)

    async def _state(self, _request: web.Request) -> web.Response:
        return web.json_response(self._full())

    async def _metrics(self, _request: web.Request) -> web.Response:
        text = metrics(self.state)
        return web.Response(body=text.encode(), headers={"Content-Type": "text/plain; version=0.0.4"})

    @web.middleware
    async def _secure(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Refuse unknown host names; add the security headers to every answer (streams have them already)."""
        assert self._gate is not None
        connection = request.protocol
        self._gate.busy(connection)
        try:
            self._check_host(request)
            response = await handler(request)
            if not response.prepared:
                _add_headers(response)
            return response
        except web.HTTPException as error:
            _add_headers(error)
            raise
        finally:
            self._gate.idle(connection)

    def _check_host(self, request: web.Request) -> None:
        named = request.headers.getall("Host", [])
        own = request.transport.get_extra_info("sockname") if request.transport is not None else None
        if len(named) == 1 and self._hosts.allows(named[0], own[0] if own else ""):
            return
        asked = ", ".join(named)[:80]
        self._note_refusal(f"a request from {request.remote} for the host {asked!r}; see web.hosts")
        raise web.HTTPMisdirectedRequest(text=f"this page has another name than {asked!r}; see web.hosts")

    def _note_refusal(self, what: str) -> None:
        self._refused += 1
        more = self._refusals.admit()
        if more is not None:
            _log.warning("refused %s%s", what, more)

    def _full(self) -> dict[str, Any]:
        control = bool(self._token) and self._command is not None
        return self.state.full() | {"views": sorted(self.views), "control": control}

    async def _events(self, request: web.Request) -> web.StreamResponse:
        if self._listeners >= VIEWERS_LIMIT:
            raise web.HTTPServiceUnavailable(text="too many viewers")
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream", **_HEADERS})
        await response.prepare(request)
        self._listeners += 1
        try:
            await self._send_events(response)
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            pass  # the viewer left, or is too slow: it reconnects
        finally:
            self._listeners -= 1
        return response

    async def _send_events(self, response: web.StreamResponse) -> None:
        seen = -1
        while True:
            current = bool(self._update) and self._number == seen + 1
            # A client that is new, or missed an update, gets the full state.
            body = self._update if current else _event("full", self._full())
            seen = self._number
            await asyncio.wait_for(response.write(body), SLOW_S)
            await self._next_tick(seen)

    async def _next_tick(self, seen: int) -> None:
        async with self._ticked:
            await self._ticked.wait_for(lambda: self._number != seen)

    async def _mjpeg(self, request: web.Request) -> web.StreamResponse:
        kind = "multipart/x-mixed-replace; boundary=frame"
        return await self._send_pictures(request, "mjpg", kind, _part)

    async def _picture_events(self, request: web.Request) -> web.StreamResponse:
        return await self._send_pictures(request, "events", "text/event-stream", lambda event: event)

    async def _send_pictures(
        self, request: web.Request, kind: str, content_type: str, wrap: Callable[[bytes], bytes]
    ) -> web.StreamResponse:
        name = request.match_info["name"]
        broadcast = self._broadcasts.get((name, kind))
        if broadcast is None:
            raise web.HTTPNotFound
        if sum(other.viewers for other in self._broadcasts.values()) >= VIEWERS_LIMIT:
            raise web.HTTPServiceUnavailable(text="too many viewers")
        response = web.StreamResponse(headers={"Content-Type": content_type, **_HEADERS})
        await response.prepare(request)
        self._count_viewer(name, broadcast, 1)
        try:
            seen = 0
            while True:
                seen, picture = await broadcast.after(seen)
                await asyncio.wait_for(response.write(wrap(picture)), SLOW_S)
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            pass  # the viewer left, or is too slow: it reconnects
        finally:
            self._count_viewer(name, broadcast, -1)
        return response

    def _count_viewer(self, name: str, broadcast: _Broadcast, change: int) -> None:
        """Count viewers; fetch the images of a camera while it has any."""
        before = any(s.viewers for (camera, _), s in self._broadcasts.items() if camera == name)
        broadcast.viewers += change
        after = any(s.viewers for (camera, _), s in self._broadcasts.items() if camera == name)
        if before != after:
            self._watch(name, after)

    def _check_token(self, request: web.Request, what: str) -> None:
        if not self._token or self._command is None:
            raise web.HTTPForbidden(text="this page is read-only: no token is set on the robot")
        given = request.headers.get("Authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(errors="replace"), self._token.encode()):
            self._note_refusal(f"{what} from {request.remote} without the right token")
            raise web.HTTPUnauthorized(text="wrong token")

    async def _export(self, request: web.Request) -> web.Response:
        self._check_token(request, "an export")
        if self._downloads is None:
            raise web.HTTPNotFound
        try:
            name, data = self._downloads.export(request.match_info["format"], force="force" in request.query)
        except ExportError as error:
            raise web.HTTPConflict(text=str(error)) from None
        return web.Response(body=data, headers=_attached(name))

    async def _log_file(self, request: web.Request) -> web.StreamResponse:
        self._check_token(request, "a download")
        path = None if self._downloads is None else await asyncio.to_thread(self._downloads.newest_log)
        if path is None:
            raise web.HTTPNotFound(text="there is no log on this computer; is recording on?")
        return web.FileResponse(path, headers=_attached(path.name))

    async def _post_command(self, request: web.Request) -> web.Response:
        self._check_token(request, "a command")
        assert self._command is not None
        try:
            async with asyncio.timeout(BODY_S):
                document = json.loads(await request.read())
            role, word = COMMANDS[document["command"]]
        except TimeoutError:
            raise web.HTTPRequestTimeout(text="the command did not come") from None
        except (ValueError, KeyError, TypeError, RecursionError, web.RequestPayloadError):
            raise web.HTTPBadRequest(text=f"command must be one of {', '.join(COMMANDS)}") from None
        self._command(role, word)
        _log.info("command from %s: %s %s", request.remote, role, word)
        return web.json_response({"sent": document["command"]})


class _Broadcast:
    """Sends the newest picture of one camera, in one encoding, to any number of viewers."""

    def __init__(self, encode: Callable[[Sight], bytes | None]) -> None:
        self.viewers = 0
        self._encode = encode
        self._number, self._picture = 0, b""
        self._made = asyncio.Condition()

    async def make(self, sight: Sight) -> None:
        """Encode a picture and wake the viewers."""
        try:
            picture = self._encode(sight)  # takes 1 ms; a thread would cost more
        except (ValueError, IndexError) as error:  # a malformed image
            _log.debug("picture: %s", error)
            return
        if picture is not None:
            async with self._made:
                self._number, self._picture = self._number + 1, picture
                self._made.notify_all()

    async def after(self, seen: int) -> tuple[int, bytes]:
        """Wait for a newer picture than number `seen`."""
        async with self._made:
            await self._made.wait_for(lambda: self._number != seen)
            return self._number, self._picture


def _attached(name: str) -> dict[str, str]:
    return {
        "Content-Disposition": f'attachment; filename="{name}"',
        "Content-Type": "application/octet-stream",
    }


def _part(jpeg: bytes) -> bytes:
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
    return head.encode() + jpeg + b"\r\n"


def _event(kind: str, document: dict[str, Any]) -> bytes:
    return f"event: {kind}\ndata: ".encode() + msgspec.json.encode(document) + b"\n\n"


def _add_headers(response: web.StreamResponse) -> None:
    response.headers.update({k: v for k, v in _HEADERS.items() if k not in response.headers})
