"""HTTP: the page, server-sent events, MJPEG, metrics, and (behind a token) commands."""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from aiohttp import web

from vical_daemon.web.images import CameraView
from vical_daemon.web.metrics import metrics
from vical_daemon.web.state import WebState

TICK_S = 0.2
VIEWERS_LIMIT = 32
SLOW_S = 10.0  # a client that does not take one update within this is let go
STATIC = Path(__file__).parent / "static"
COMMANDS = {  # name on the page: role that is told, and the word it is told
    "record_start": ("record", "start"),
    "record_stop": ("record", "stop"),
    "reset": ("estimate", "reset"),
}
_FILES = {"": "index.html", "style.css": "style.css", "app.js": "app.js", "chart.js": "chart.js"}
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
        state: What is shown.
        views: Camera views by name.
        watch: Called with (camera, True) when the first viewer of a camera comes, (camera, False) when
            the last one goes: without viewers no image is fetched.
        command: Called with (role, word) for a command; None: read-only.
        token: What a client must show to command; "": nobody may.
    """

    def __init__(
        self,
        state: WebState,
        views: dict[str, CameraView],
        watch: Watch,
        command: Command | None = None,
        token: str = "",
    ) -> None:
        self.state, self.views = state, views
        self._watch, self._command, self._token = watch, command, token
        self._number = 0
        self._update = b""
        self._ticked = asyncio.Condition()
        self._pictures: dict[str, tuple[int, bytes]] = {}
        self._pictured = asyncio.Condition()
        self._listeners = 0
        self._viewers: dict[str, int] = dict.fromkeys(views, 0)

    def application(self) -> web.Application:
        """Return the aiohttp application."""
        app = web.Application(middlewares=[_secure], client_max_size=4096)
        app.router.add_get("/events", self._events)
        app.router.add_get("/camera/{name}.mjpg", self._mjpeg)
        app.router.add_get("/api/state", self._state)
        app.router.add_post("/api/command", self._post_command)
        app.router.add_get("/metrics", self._metrics)
        app.router.add_get("/{file:[a-z.]*}", self._static)
        return app

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Tick until `stopped` says so: digest the bus, wake the listeners."""
        loop = asyncio.get_running_loop()
        while not stopped():
            begin_s = loop.time()
            update = self.state.tick()
            if self._listeners:
                self._update = _event("update", update)
            async with self._ticked:
                self._number += 1
                self._ticked.notify_all()
            for name, view in self.views.items():
                if self._viewers[name]:
                    await self._make_picture(name, view)
            await asyncio.sleep(max(TICK_S - (loop.time() - begin_s), 0.01))

    async def _make_picture(self, name: str, view: CameraView) -> None:
        try:
            jpeg = await asyncio.to_thread(view.jpeg)
        except (ValueError, IndexError) as error:  # an image that is not what it says
            _log.debug("picture of %s: %s", name, error)
            return
        if jpeg is not None:
            async with self._pictured:
                self._pictures[name] = (self._pictures.get(name, (0, b""))[0] + 1, jpeg)
                self._pictured.notify_all()

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
            pass
        finally:
            self._listeners -= 1
        return response

    async def _send_events(self, response: web.StreamResponse) -> None:
        seen = -1
        while True:
            current = bool(self._update) and self._number == seen + 1
            # A client that is new, or was too slow to have had every update, gets everything.
            body = self._update if current else _event("full", self._full())
            seen = self._number
            await asyncio.wait_for(response.write(body), SLOW_S)
            await self._next_tick(seen)

    async def _next_tick(self, seen: int) -> None:
        async with self._ticked:
            await self._ticked.wait_for(lambda: self._number != seen)

    async def _mjpeg(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in self.views:
            raise web.HTTPNotFound
        if sum(self._viewers.values()) >= VIEWERS_LIMIT:
            raise web.HTTPServiceUnavailable(text="too many viewers")
        response = web.StreamResponse(
            headers={"Content-Type": "multipart/x-mixed-replace; boundary=frame", **_HEADERS}
        )
        await response.prepare(request)
        self._viewers[name] += 1
        if self._viewers[name] == 1:
            self._watch(name, True)
        try:
            await self._send_pictures(response, name)
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            pass
        finally:
            self._viewers[name] -= 1
            if self._viewers[name] == 0:
                self._watch(name, False)
        return response

    async def _send_pictures(self, response: web.StreamResponse, name: str) -> None:
        seen = 0
        while True:
            seen, jpeg = await self._next_picture(name, seen)
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            await asyncio.wait_for(response.write(head.encode() + jpeg + b"\r\n"), SLOW_S)

    async def _next_picture(self, name: str, seen: int) -> tuple[int, bytes]:
        async with self._pictured:
            await self._pictured.wait_for(lambda: self._pictures.get(name, (0, b""))[0] != seen)
            return self._pictures[name]

    async def _post_command(self, request: web.Request) -> web.Response:
        if not self._token or self._command is None:
            raise web.HTTPForbidden(text="this page is read-only: no token is set on the robot")
        given = request.headers.get("Authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            raise web.HTTPUnauthorized(text="wrong token")
        try:
            document = await request.json()
            role, word = COMMANDS[document["command"]]
        except (json.JSONDecodeError, KeyError, TypeError, UnicodeDecodeError):
            raise web.HTTPBadRequest(text=f"command must be one of {', '.join(COMMANDS)}") from None
        self._command(role, word)
        _log.info("command from %s: %s %s", request.remote, role, word)
        return web.json_response({"sent": document["command"]})


def _event(kind: str, document: dict[str, Any]) -> bytes:
    return f"event: {kind}\ndata: {json.dumps(document, allow_nan=False)}\n\n".encode()


@web.middleware
async def _secure(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """Add the security headers to every answer that is not a stream (those have them already)."""
    response = await handler(request)
    if not response.prepared:
        response.headers.update({k: v for k, v in _HEADERS.items() if k not in response.headers})
    return response
