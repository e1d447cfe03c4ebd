"""A headless Chromium driven over its DevTools protocol with aiohttp: no driver, no extra dependency."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import shutil
import subprocess
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiohttp

NAMES = ("chromium", "chromium-browser", "google-chrome")


def find() -> str | None:
    """Return the path of a Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Page:
    """One tab: evaluate, wait for a condition, screenshot; collects errors of the console."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket, self._number = socket, 0
        self.errors: list[str] = []

    async def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the DevTools protocol and return its result."""
        self._number += 1
        await self._socket.send_json({"id": self._number, "method": method, "params": parameters})
        while True:
            message = await self._socket.receive_json()
            if message.get("id") == self._number:
                return message.get("result", {})
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("method") == "Runtime.exceptionThrown":
            details = message["params"]["exceptionDetails"]
            self.errors.append(
                details.get("exception", {}).get("description") or details.get("text", "exception")
            )
        if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
            self.errors.append(message["params"]["entry"]["text"])

    async def open(self, url: str, width: int = 1400, height: int = 1250, *, dark: bool = False) -> None:
        """Open an address in a window of this size, px."""
        for domain in ("Runtime", "Log", "Page"):
            await self.call(f"{domain}.enable")
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await self.call("Emulation.setEmulatedMedia", features=[scheme])
        for address in ("about:blank", url):  # no answer may come from the page that was open before
            await self.call("Page.navigate", url=address)

    async def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        result = await self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        return result.get("result", {}).get("value")

    async def wait(self, expression: str, timeout_s: float = 45.0) -> Any:
        """Wait until a JavaScript expression is true and return it."""
        end = asyncio.get_running_loop().time() + timeout_s
        while not (value := await self.evaluate(expression)):
            if asyncio.get_running_loop().time() > end:
                raise AssertionError(f"never became true: {expression}; {self.errors}")
            await asyncio.sleep(0.1)
        return value

    async def screenshot(self, path: Path) -> None:
        """Write what is visible as a PNG."""
        result = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(result["data"]))


Script = Callable[[Page], Awaitable[Any]]


class Browser:
    """A running Chromium; each script gets a tab of its own.

    Args:
        folder: For its profile.
    """

    def __init__(self, folder: Path) -> None:
        chromium = find()
        assert chromium is not None
        command = [
            chromium, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--no-first-run", f"--user-data-dir={folder}", "--remote-debugging-port=0", "about:blank",
        ]  # fmt: skip
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        self._port = ""
        end = time.monotonic() + 60.0
        while not self._port:
            if self._process.poll() is not None or time.monotonic() > end:
                self.close()
                raise RuntimeError(f"{chromium} does not start")
            with suppress(FileNotFoundError, IndexError):  # Chromium makes it, then writes into it
                self._port = (folder / "DevToolsActivePort").read_text().splitlines()[0]
            time.sleep(0.02)

    def drive(self, script: Script) -> Any:
        """Run `await script(page)` in a new tab."""
        return asyncio.run(_run(script, self._port))

    def draw_svg(self, svg: str, folder: Path, path: Path) -> None:
        """Turn an SVG of rich into a PNG, its fonts replaced by the browser's own: nothing is fetched."""
        html = folder / "terminal.html"
        svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)
        html.write_text(f"<body style='margin:0;background:#fff'>{svg}</body>")

        async def script(page: Page) -> None:
            await page.open(html.as_uri(), 1100, 900)
            await page.wait("!!document.querySelector('svg')")
            height = await page.evaluate("document.querySelector('svg').getBoundingClientRect().height")
            await page.open(html.as_uri(), 1100, round(height) + 2)
            await page.wait("!!document.querySelector('svg')")
            await page.screenshot(path)

        self.drive(script)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()


async def _run(script: Script, port: str) -> Any:
    tabs = f"http://127.0.0.1:{port}/json"
    async with aiohttp.ClientSession() as session:
        async with session.put(f"{tabs}/new?about:blank") as answer:
            target = json.loads(await answer.text())
        try:
            async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                return await script(Page(socket))
        finally:
            async with session.get(f"{tabs}/close/{target['id']}"):
                pass
