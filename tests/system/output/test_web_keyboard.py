"""The live page by keyboard and screen reader, and after a robot that was away behind a proxy."""

import numpy as np
import pytest

pytestmark = pytest.mark.system

NAMELESS = """[...document.querySelectorAll('button, input, select, canvas, [role=img]')].filter((e) =>
  !(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length)
).map((e) => e.outerHTML).join()"""
KEY = "document.activeElement.dispatchEvent(new KeyboardEvent('keydown', {key: '%s', bubbles: true}))"


def test_keyboard_names_and_a_new_connection_in_a_browser(served, web_feed, browser):
    rng = np.random.default_rng(0)
    for k in range(1, 150):
        web_feed.publish_estimate(served.bus, web_feed.estimate(0.2 * k, rng))
    web_feed.publish_status(served.bus)

    async def script(page):
        await page.open(served.address, 320, 640)
        await page.wait("page.latest.cam0 !== undefined && scene.data !== null")
        assert await page.evaluate("document.documentElement.scrollWidth") <= 320
        assert await page.evaluate(NAMELESS) == ""
        assert await page.evaluate("document.getElementById('spoken').textContent") != ""

        pressed = (
            "[...document.querySelectorAll('.range [aria-pressed=true]')].map((b) => b.textContent).join()"
        )
        assert await page.evaluate(pressed) == "all"
        await page.evaluate("document.querySelector('.range button[data-span=\"60\"]').click()")
        assert await page.evaluate(pressed) == "last minute"

        await page.evaluate("document.getElementById('scene').focus()")
        for key, moved in (
            ("ArrowLeft", "scene.turn.yaw"),
            ("ArrowUp", "scene.turn.pitch"),
            ("+", "scene.zoom"),
        ):
            before = await page.evaluate(moved)
            await page.evaluate(KEY % key)
            assert await page.evaluate(moved) != before, key

        await page.evaluate("page.latest.cam1 = page.latest.cam0; draw(); $('tabs').firstChild.focus()")
        await page.evaluate(KEY % "ArrowRight")
        assert await page.evaluate("page.camera + document.activeElement.textContent") == "cam1cam1"
        assert await page.evaluate("document.querySelectorAll('#tabs [tabindex=\"0\"]').length") == 1

        enter = "new KeyboardEvent('keydown', {key: 'Enter', cancelable: true})"
        assert not await page.evaluate(f"$('token').dispatchEvent({enter})"), "Enter would accept"

        # what the browser does on an answer like 502: it closes the source, for good
        await page.evaluate("window.gone = page.source; gone.close(); gone.onerror()")
        assert await page.evaluate("document.getElementById('link').textContent") == "offline, trying again"
        await page.wait(
            "page.source !== gone && document.getElementById('link').textContent === 'live'", 20.0
        )
        return page.errors

    assert browser.drive(script) == []
