"""A headless Chromium driven over its DevTools protocol with aiohttp: no driver, no extra dependency."""

import asyncio
import base64
import json
import re
import shutil
import subprocess

import aiohttp

NAMES = ("chromium", "chromium-browser", "google-chrome")


def find():
    """Path of a Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Page:
    """One tab: evaluate, wait for a condition, screenshot; collects errors of the console."""

    def __init__(self, socket):
        self._socket, self._number, self.errors = socket, 0, []

    async def call(self, method, **parameters):
        self._number += 1
        await self._socket.send_json({"id": self._number, "method": method, "params": parameters})
        while True:
            message = await self._socket.receive_json()
            if message.get("id") == self._number:
                return message.get("result", {})
            self._note(message)

    def _note(self, message):
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(message["params"]["exceptionDetails"].get("text", "exception"))
        if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
            self.errors.append(message["params"]["entry"]["text"])

    async def open(self, url, width=1400, height=1250, *, dark=False):
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
        await self.call("Page.navigate", url=url)

    async def evaluate(self, expression):
        result = await self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        return result.get("result", {}).get("value")

    async def wait(self, expression, timeout_s=45.0):
        """Wait until a JavaScript expression is true and return it."""
        end = asyncio.get_running_loop().time() + timeout_s
        while not (value := await self.evaluate(expression)):
            if asyncio.get_running_loop().time() > end:
                raise AssertionError(f"never became true: {expression}; {self.errors}")
            await asyncio.sleep(0.1)
        return value

    async def screenshot(self, path):
        result = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(result["data"]))


def drive(script, folder):
    """Start a browser, run `await script(page)`, stop it."""
    command = [
        find(), "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
        f"--user-data-dir={folder}", "--remote-debugging-port=0", "about:blank",
    ]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        port = next(m.group(1) for line in process.stderr if (m := re.search(r"ws://127.0.0.1:(\d+)/", line)))
        return asyncio.run(_run(script, port))
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def draw_svg(svg, folder, path):
    """Turn an SVG of rich into a PNG, its fonts replaced by the browser's own: nothing is fetched."""
    html = folder / "terminal.html"
    svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)
    html.write_text(f"<body style='margin:0;background:#fff'>{svg}</body>")

    async def script(page):
        await page.open(html.as_uri(), 1100, 900)
        await page.wait("!!document.querySelector('svg')")
        height = await page.evaluate("document.querySelector('svg').getBoundingClientRect().height")
        await page.open(html.as_uri(), 1100, round(height) + 2)
        await page.wait("!!document.querySelector('svg')")
        await page.screenshot(path)

    drive(script, folder / "profile")


async def _run(script, port):
    async with aiohttp.ClientSession() as session:
        async with session.put(f"http://127.0.0.1:{port}/json/new?about:blank") as answer:
            target = json.loads(await answer.text())
        async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0) as socket:
            return await script(Page(socket))
