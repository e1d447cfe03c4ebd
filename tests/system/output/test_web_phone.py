"""The live page on a phone that sleeps, wakes and changes its network; and a page that is open for hours."""

import asyncio
import threading
from contextlib import suppress
from urllib.parse import urlsplit

import numpy as np
import pytest

pytestmark = pytest.mark.system


class Relay:
    """Stands between page and browser; what is open can be made to hang, as when a network went away."""

    def __init__(self, address):
        self._to, self._open = urlsplit(address), []
        self._loop, self._ready = asyncio.new_event_loop(), threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self._ready.wait(10)
        self.address = f"http://127.0.0.1:{self._port}/"

    def _run(self):
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._accept, "127.0.0.1", 0))
        self._port = server.sockets[0].getsockname()[1]
        self._ready.set()
        self._loop.run_forever()
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        server.close()
        self._loop.close()

    async def _accept(self, reader, writer):
        answers, asks = await asyncio.open_connection(self._to.hostname, self._to.port)
        live = asyncio.Event()
        live.set()
        self._open.append(live)
        try:
            with suppress(asyncio.CancelledError):
                await asyncio.gather(self._copy(reader, asks, live), self._copy(answers, writer, live))
        finally:
            asks.close()
            writer.close()

    async def _copy(self, reader, writer, live):
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                await live.wait()
                writer.write(data)
                await writer.drain()
        writer.close()

    def hang(self):
        """From now on nothing passes through what is open; nobody is told."""
        self._loop.call_soon_threadsafe(lambda: [live.clear() for live in self._open])

    def close(self):
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(20)


@pytest.fixture
def relay(fed):
    made = Relay(fed.address)
    yield made
    made.close()


def test_a_connection_that_died_in_silence_is_made_anew(relay, browser):
    """It said "The robot has not answered" for as long as the browser believed in its connection."""

    async def script(page):
        await page.open(relay.address, 400, 800)
        await page.wait("page.latest.cam0 !== undefined && camera.last !== null")
        await page.evaluate("window.before = [page.source, camera.source, camera.last.number]; 1")
        relay.hang()
        await page.wait("page.latest.cam0.status === 'stale'", 20.0)
        await page.wait("page.source !== before[0] && page.latest.cam0.status !== 'stale'", 20.0)
        await page.wait("camera.source !== before[1] && camera.last.number > before[2]", 20.0)
        assert await page.evaluate("before.slice(0, 2).every((s) => s.readyState === EventSource.CLOSED)")
        return page.errors

    assert browser.drive(script) == []


def test_a_phone_that_wakes_asks_at_once_and_draws_nothing_while_it_is_dark(fed, browser):
    async def script(page):
        await page.open(fed.address, 400, 800)
        await page.wait("page.latest.cam0 !== undefined && page.rows.cam0.length > 100")
        await page.evaluate("""window.dark = true; window.drawn = 0;
          Object.defineProperty(document, 'hidden', {get: () => window.dark});
          const set = charts.lever.set; charts.lever.set = function (...a) { window.drawn += 1;
            set.apply(this, a); }; 1""")
        rows = await page.evaluate("page.rows.cam0.length")
        await page.wait(f"page.rows.cam0.length > {rows + 4}")
        assert await page.evaluate("window.drawn") == 0
        await page.evaluate("window.dark = false; document.dispatchEvent(new Event('visibilitychange')); 1")
        assert await page.evaluate("window.drawn") > 0
        before = "window.before = page.source; page.heardAt = Date.now() - 60000;"
        await page.evaluate(f"{before} document.dispatchEvent(new Event('visibilitychange')); 1")
        assert await page.evaluate("page.source !== before && before.readyState === EventSource.CLOSED")
        await page.wait("document.getElementById('link').textContent === 'live'", 20.0)
        return page.errors

    assert browser.drive(script) == []


AN_HOUR = """for (let k = 0; k < 9000; k++) {
  const rows = [0, 1].map((i) => { const row = page.rows.cam0[page.rows.cam0.length - 1].slice();
    row[0] = 1000 + 0.4 * k + 0.2 * i; return row; });
  take({rig: 'demo', devices: page.devices, fault: null, sights: page.sights,
    cameras: {cam0: Object.assign({}, page.latest.cam0, {fresh: rows, rows: undefined})}}, false);
} page.rows.cam0.length"""


def test_an_hour_leaves_as_many_rows_as_charts_can_show(fed, browser):
    async def script(page):
        await page.open(fed.address, 400, 800)
        await page.wait("page.latest.cam0 !== undefined && page.rows.cam0.length > 100")
        await page.evaluate("page.source.close(); window.draw = () => 0; 1")
        begin = await page.evaluate("page.rows.cam0[0][0]")
        assert 1000 < await page.evaluate(AN_HOUR) <= 2000
        times = np.array(await page.evaluate("page.rows.cam0.map((row) => row[0])"))
        assert times[0] == begin and (np.diff(times) > 0.0).all()
        assert np.diff(times[times > 1000.0]).max() < 12.0  # a straight line for most of an hour before
        return page.errors

    assert browser.drive(script) == []
