"""The page over HTTP and in a real browser, with data flowing."""

import asyncio
import base64
import itertools
import json
import os
import socket
import threading
from pathlib import Path

import aiohttp
import numpy as np
import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import (
    CheckState,
    Level,
    VerifyResult,
    decode_string,
    encode_calibration,
    encode_verification,
)
from vical_daemon.config.model import Config, WebConfig
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.guidance import Guidance, Lack, Verb
from vical_daemon.estimation.result import Status
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.web import role as web

pytestmark = pytest.mark.system


def request(method, url, **options):
    async def go():
        async with (
            aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(60)) as session,
            session.request(method, url, **options) as answer,
        ):
            return answer.status, dict(answer.headers), await answer.text()

    return asyncio.run(go())


def test_files_and_headers(served):
    for name, kind in (
        ("", "text/html"),
        ("style.css", "text/css"),
        ("app.js", "javascript"),
        ("camera.js", "javascript"),
        ("meters.js", "javascript"),
        ("decide.js", "javascript"),
        ("scene.js", "javascript"),
    ):
        status, headers, text = request("GET", served.address + name)
        assert status == 200
        assert kind in headers["Content-Type"]
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        names = text.replace("http-equiv", "").replace("http://www.w3.org/2000/svg", "")
        assert "http" not in names  # nothing from outside
    for name in ("nothing", "../server.py", "server.py", "%2e%2e/server.py", "camera/none.mjpg"):
        assert request("GET", served.address + name)[0] == 404


def test_events_start_full_and_go_on(fed):
    async def listen():
        kinds, documents = [], []
        async with aiohttp.ClientSession() as session, session.get(fed.address + "events") as answer:
            assert answer.headers["Content-Type"] == "text/event-stream"
            async for line in answer.content:
                text = line.decode().strip()
                if text.startswith("event: "):
                    kinds.append(text[7:])
                if text.startswith("data: "):
                    documents.append(json.loads(text[6:]))
                if len(documents) == 5:
                    return kinds, documents
        return None

    kinds, documents = asyncio.run(listen())
    assert kinds[0] == "full"
    assert "update" in kinds[1:]
    rows = []
    for kind, document in zip(kinds, documents, strict=True):
        camera = document["cameras"]["cam0"]
        rows = camera["rows"] if kind == "full" else rows + camera["fresh"]
    times = [row[0] for row in rows]
    assert times == sorted(set(times))  # nothing twice, nothing out of order
    assert len(times) >= 149


def test_pictures_come_while_somebody_looks(fed):
    async def look():
        async with (
            aiohttp.ClientSession() as session,
            session.get(fed.address + "camera/cam0.mjpg") as answer,
        ):
            assert answer.headers["Content-Type"].startswith("multipart/x-mixed-replace")
            data = b""
            while data.count(b"--frame") < 3:
                data += await answer.content.readany()
            return data

    assert b"\xff\xd8\xff" in asyncio.run(look())


def test_picture_events_hold_what_was_found_and_what_was_expected(fed):
    async def look():
        address = fed.address + "camera/cam0/events"
        async with aiohttp.ClientSession() as session, session.get(address) as answer:
            assert answer.headers["Content-Type"] == "text/event-stream"
            pictures = []
            async for line in answer.content:
                if line.startswith(b"data: "):
                    pictures.append(json.loads(line[6:]))
                if len(pictures) == 3:
                    return pictures
        return []

    pictures = asyncio.run(look())
    stamps = [picture["stamp_s"] for picture in pictures]
    assert stamps == sorted(set(stamps))
    last = pictures[-1]
    assert last["size"] == [640, 480]
    assert base64.b64decode(last["jpeg"])[:3] == b"\xff\xd8\xff"
    ids, near = [row[0] for row in last["detected"]], {row[0]: row[1:] for row in last["predicted"]}
    assert ids == list(range(48))
    assert all(np.hypot(u - near[i][0], v - near[i][1]) < 4.0 for i, u, v in last["detected"])


def test_metrics(fed):
    status, headers, text = request("GET", fed.address + "metrics")
    assert (status, headers["Content-Type"]) == (200, "text/plain; version=0.0.4")
    assert "vical_timeshift_sigma_seconds" in text


@pytest.mark.parametrize(
    ("token", "body", "status"),
    [
        (None, {"command": "reset"}, 401),
        ("wrong", {"command": "reset"}, 401),
        ("open sesame", {"command": "shutdown"}, 400),
        ("open sesame", [], 400),
        ("open sesame", {"command": "reset"}, 200),
    ],
)
def test_commands_need_the_token(served, token, body, status):
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    assert request("POST", served.address + "api/command", json=body, headers=headers)[0] == status
    sent = [(s.key, decode_string(s.payload)) for s in served.commands]
    assert sent == ([("vical/rig0/command/estimate", "reset")] if status == 200 else [])


def test_exports_and_the_log_need_the_token(fed):
    (fed.logs / "run.mcap").write_text("a log")
    right = {"Authorization": "Bearer open sesame"}
    for path in ("api/export/ros", "api/log"):
        assert request("GET", fed.address + path)[0] == 401
        assert request("GET", fed.address + path, headers={"Authorization": "Bearer no"})[0] == 401
    status, headers, text = request("GET", fed.address + "api/export/ros", headers=right)
    assert (status, headers["Content-Disposition"]) == (200, 'attachment; filename="cam0.yaml"')
    assert "image_width: 640" in text
    status, headers, text = request("GET", fed.address + "api/log", headers=right)
    assert (status, headers["Content-Disposition"]) == (200, 'attachment; filename="run.mcap"')
    assert text == "a log"
    assert request("GET", fed.address + "api/export/nonsense", headers=right)[0] == 409


def test_without_a_token_nobody_commands(served, monkeypatch, tmp_path):
    monkeypatch.delenv("VICAL_WEB_TOKEN")
    monkeypatch.setenv("VICAL_STATE_DIR", str(tmp_path))
    assert web.read_token() == ""
    (tmp_path / "web-token").write_text("secret\n")
    assert web.read_token() == "secret"


def test_taken_port_is_said():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = Config(web=WebConfig(enabled=True, port=taken.getsockname()[1]))
        with pytest.raises(web.WebError, match=r"set web\.host or web\.port"):
            web.run(config, LocalBus(), threading.Event(), clock=private_clock())


def shots():
    """Folder for screenshots to look at: VICAL_SHOTS, else none are kept."""
    folder = os.environ.get("VICAL_SHOTS")
    return Path(folder) if folder else None


def test_in_a_browser(fed, browser, tmp_path):
    keep = shots() or tmp_path

    async def script(page):
        await page.open(fed.address)
        await page.wait("document.getElementById('link').textContent === 'live'")
        await page.wait("document.getElementById('picture').width === 640")
        marks = await page.wait(
            "document.querySelectorAll('#corners .detected, #corners .predicted').length === 2"
        )
        misfit = await page.evaluate("document.getElementById('misfit').textContent")
        status = await page.wait("document.getElementById('status').classList.contains('converged')")
        lever = await page.evaluate("document.getElementById('lever').textContent")
        sigmas = await page.evaluate("anglesSigma([0.9238795, 0, 0, 0.3826834], [0.1, 0.2, 0.3])")
        np.testing.assert_allclose(
            sigmas, [0.3, 0.2, 0.1], rtol=1e-3
        )  # of yaw, pitch, roll: turned about z alone
        before = await page.evaluate("page.rows.cam0.length")
        await page.wait(f"page.rows.cam0.length > {before}")  # live
        drawn = await page.evaluate(
            "(() => { const c = document.getElementById('c-lever'), d = c.getContext('2d')"
            ".getImageData(0, 0, c.width, c.height).data; return d.some((v) => v); })()"
        )
        devices = await page.evaluate("document.querySelector('#devices tbody').textContent")
        outside = await page.evaluate(
            "performance.getEntriesByType('resource').filter((e) => !e.name.startsWith(location.origin)"
            " && !e.name.startsWith('data:')).length"
        )
        await page.screenshot(keep / "page.png")
        return marks, misfit, status, lever, drawn, devices, outside, page.errors

    marks, misfit, status, lever, drawn, devices, outside, errors = browser.drive(script)
    assert errors == []
    assert marks  # detected and predicted
    assert misfit.startswith("48 corners, median error 0.")
    assert status
    assert lever.startswith("x")
    assert "±" in lever
    assert drawn
    assert "imu/imu0" in devices
    assert outside == 0
    assert (keep / "page.png").stat().st_size > 20_000


def test_a_calibration_that_stops_is_stale_in_a_browser(served, browser, web_feed, tmp_path):
    rng = np.random.default_rng(0)
    for k in range(1, 150):
        web_feed.publish_estimate(served.bus, web_feed.estimate(0.2 * k, rng))
    web_feed.publish_status(served.bus)

    async def script(page):
        await page.open(served.address)
        await page.wait("document.getElementById('status').textContent.startsWith('stale, ')")
        words = "document.querySelector('main').innerText + document.getElementById('status').innerText"
        return await page.evaluate(words), page.errors

    words, errors = browser.drive(script)
    assert errors == []
    assert "No estimate for" in words
    assert "silent for" in words  # of the devices
    assert "Converged:" not in words
    assert "no more motion needed" not in words


def test_commands_and_a_phone_in_a_browser(fed, browser, tmp_path):
    keep = shots() or tmp_path

    async def script(page):
        await page.open(fed.address, 390, 844, dark=True)
        await page.wait("!document.getElementById('control').hidden")
        await page.evaluate("document.getElementById('reason').textContent = '/folder'.repeat(40)")
        wide = await page.evaluate("document.documentElement.scrollWidth")
        await page.evaluate("document.getElementById('token').value = 'wrong'")
        await page.evaluate("document.querySelector('button[value=record_start]').click()")
        await page.wait("document.getElementById('answer').textContent === 'wrong token'")
        await page.evaluate("document.getElementById('token').value = 'open sesame'")
        await page.evaluate("document.querySelector('button[value=record_start]').click()")
        await page.wait("document.getElementById('answer').textContent.startsWith('sent')")
        await page.wait("document.getElementById('picture').width === 640")
        await page.evaluate("window.scrollTo(0, 0)")
        await page.screenshot(keep / "phone.png")
        return wide

    assert browser.drive(script) <= 390  # nothing to scroll sideways
    assert [(s.key, decode_string(s.payload)) for s in fed.commands] == [
        ("vical/rig0/command/record", "start")
    ]


def test_going_away_and_coming_back_keeps_no_connections(fed, browser):
    """Chromium opens six to one host: the fourth time, it waited for a minute until one was given up."""

    async def script(page):
        took_s = []
        for _ in range(5):
            begin_s = asyncio.get_running_loop().time()
            await page.open(fed.address)  # by way of another page
            await page.wait("document.getElementById('link')?.textContent === 'live'")
            await page.wait("page.latest.cam0 !== undefined && camera.source !== null")
            took_s.append(asyncio.get_running_loop().time() - begin_s)
        return took_s

    assert max(browser.drive(script)) < 25.0


SCENES = {  # what the rig sends, and what must stand on the page
    "converged": {},
    "guided": {"motion": Guidance(Verb.TURN, ("x", "y"), Lack.ONE_AXIS, (0.0, 0.0, 1.0))},
    "edges": {"motion": Guidance(Verb.SHOW, lack=Lack.EDGES, camera="cam0", edges=("left", "top"))},
    "fault": {"motion": Guidance(Verb.TURN, ("x", "y"))},
}


@pytest.mark.parametrize("scene", SCENES)
def test_what_stands_above_the_fold(served, web_feed, browser, tmp_path, scene):
    """In windows of two widths, light and dark: one browser opens the page in each."""
    keep, bus, rng = shots() or tmp_path, served.bus, np.random.default_rng(0)
    status = Status.CONVERGED if scene in ("converged", "edges") else Status.CONVERGING
    reason = "lever arm along the optical axis: ±12.0 mm" if status is Status.CONVERGING else ""
    event = Event(EventKind.STAMP_JITTER, "cam0", 1.2e-3, t_s=12.0)
    for k in range(1, 150):
        events = [event] if k == 60 else []
        sent = web_feed.estimate(0.2 * k, rng, status, reason=reason, events=events, **SCENES[scene])
        web_feed.publish_estimate(bus, sent)
    numbers = itertools.count(1)
    fault = (Level.ERROR, "no data for 3.0 s: is the cable plugged in?") if scene == "fault" else ()

    async def look(page, width, dark):
        web_feed.publish_status(bus, *fault)
        await page.open(served.address, width, 844 if width < 600 else 1250, dark=dark)
        await page.wait("document.getElementById('link').textContent === 'live'")
        await page.wait("document.querySelectorAll('#devices tbody tr').length > 1")
        for _ in range(49):  # points alone, as from a log without images
            web_feed.publish_points(bus, next(numbers))
            await asyncio.sleep(0.02)
        web_feed.publish_estimate(bus, sent)  # however long the browser took to start, this is fresh
        await page.wait("!page.latest.cam0.stale")
        await page.wait("document.querySelector('#corners path.detected') !== null")
        texts = {
            name: await page.evaluate(f"document.getElementById('{name}').textContent")
            for name in ("headline", "guidance", "motiontext", "reason", "news", "misfit", "facts")
        }
        texts["turned"] = await page.evaluate(
            "[...document.querySelectorAll('.axis.rotate')].map((a) => a.id.slice(-1)).join('')"
        )
        texts["edges"] = await page.evaluate("document.querySelectorAll('.edge.wanted').length")
        texts["wide"] = await page.evaluate(
            "Math.max(document.documentElement.scrollWidth, ...[...document.querySelectorAll('.scroll')]"
            ".map((box) => box.scrollWidth - box.clientWidth + innerWidth))"
        )
        texts["low"] = await page.evaluate(
            "document.getElementById('headline').getBoundingClientRect().bottom"
        )
        await page.screenshot(keep / f"{scene}_{width}_{'dark' if dark else 'light'}.png")
        if width < 600:
            await page.evaluate("document.getElementById('devices').scrollIntoView()")
            await page.screenshot(keep / f"{scene}_{width}_{'dark' if dark else 'light'}_devices.png")
        return texts

    windows = [(390, True), (390, False), (1400, False), (1400, True)]

    async def script(page):
        return {window: await look(page, *window) for window in windows}, page.errors

    seen, errors = browser.drive(script)
    assert errors == []
    for (width, _), texts in seen.items():
        assert texts["wide"] <= width  # nothing to scroll sideways, tables neither
        check_what_stands_there(scene, reason, texts)


def check_what_stands_there(scene, reason, texts):
    assert texts["low"] < 300
    assert "no images arrive" in texts["misfit"] and "1 sigma" in texts["facts"]
    assert "12 s: cam0: the stamps of the images jitter" in texts["news"]
    if scene == "fault":
        assert texts["headline"] == "imu/imu0 does not work."
        assert texts["guidance"].startswith("no data for 3.0 s") and texts["turned"] == ""
        assert texts["motiontext"] == ""
    elif scene == "guided":
        assert (texts["headline"], texts["turned"]) == ("The estimate is improving.", "xy")
        assert texts["motiontext"] == "turn about x and y" and texts["reason"] == reason
        assert "optical axis only" in texts["guidance"]
    elif scene == "edges":
        assert texts["headline"].startswith("Converged, except") and texts["edges"] == 2
        assert "show the target near" in texts["motiontext"]
    else:
        assert (texts["headline"], texts["motiontext"]) == ("Converged.", "no more motion needed")
        assert texts["guidance"] == "" and texts["edges"] == 0


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize(("width", "height"), [(390, 844), (820, 1180), (1400, 1000)])
def test_what_the_operator_needs_is_seen_without_scrolling(
    served, web_feed, browser, tmp_path, width, height, dark
):
    keep, bus, rng = shots() or tmp_path, served.bus, np.random.default_rng(0)
    stored = encode_calibration(web_feed.estimate(60.0, np.random.default_rng(5)), "cam0")
    bus.publish(topics.STORED.key(web_feed.RIG, "cam0"), stored)
    for k in range(1, 40):
        web_feed.publish_estimate(bus, web_feed.estimate(0.2 * k, rng))
    web_feed.publish_status(bus)
    for number in range(1, 30):
        web_feed.publish_image(bus, number)

    async def publish_images():
        for number in itertools.count(30):
            web_feed.publish_estimate(bus, web_feed.estimate(0.2 * min(number + 10, 70), rng))
            web_feed.publish_image(bus, number)
            await asyncio.sleep(0.05)

    async def script(page):
        await page.open(served.address, width, height, dark=dark)
        await page.wait("document.querySelectorAll('.meter').length === 7")
        feed = asyncio.create_task(publish_images())
        await page.wait("document.querySelector('#corners path.wanted') !== null")
        await page.wait("document.querySelectorAll('#corners path.cell').length > 0")
        for name in ("wanted", "imageadvice"):
            await page.wait(f"document.getElementById('{name}').textContent !== ''")
        low = await page.evaluate(
            "Math.max(...['status', 'headline', 'corners', 'wanted', 'imageadvice', 'meters']"
            ".map((id) => document.getElementById(id).getBoundingClientRect().bottom))"
        )
        texts = await page.evaluate(
            "Object.fromEntries(['wanted', 'imageadvice', 'imagefacts', 'storedsays', 'storedrows']"
            ".map((id) => [id, document.getElementById(id).textContent]))"
        )
        wide = await page.evaluate("document.documentElement.scrollWidth")
        await page.screenshot(keep / f"operator_{width}_{'dark' if dark else 'light'}.png")
        await page.evaluate("document.querySelector('button[data-room=\"1\"]').click()")
        drawn = await page.evaluate(
            "(() => { const c = document.getElementById('scene'), d = c.getContext('2d')"
            ".getImageData(0, 0, c.width, c.height).data; return d.some((v) => v); })()"
        )
        before = await page.evaluate("JSON.stringify(scene.turn)")
        await page.evaluate(
            "for (const [kind, x] of [['pointerdown', 40], ['pointermove', 90], ['pointerup', 90]])"
            " scene.canvas.dispatchEvent(new PointerEvent(kind, { pointerId: 1, clientX: x, clientY: 50 }))"
        )
        turned = await page.evaluate("JSON.stringify(scene.turn)") != before
        feed.cancel()
        return low, texts, wide, drawn, turned, page.errors

    low, texts, wide, drawn, turned, errors = browser.drive(script)
    assert errors == [] and wide <= width and low <= height
    assert texts["wanted"].startswith("bring the board into the outline")
    assert "in an exposure of 12 ms: shorten it to" in texts["imageadvice"]
    assert "images/s" in texts["imagefacts"] and "of the image covered" in texts["imagefacts"]
    assert "joint sigmas" in texts["storedsays"] and "lever arm x" in texts["storedrows"]
    assert drawn and turned


def test_a_calibration_that_holds_asks_for_no_board(served, web_feed, browser):
    """With `mode: verify`: `bring the board into the outline` stood below `The stored calibration holds.`"""
    bus, rng = served.bus, np.random.default_rng(0)
    for k in range(1, 40):
        web_feed.publish_estimate(bus, web_feed.estimate(0.2 * k, rng))
    for number in range(1, 30):
        web_feed.publish_image(bus, number)

    async def publish(verdict):
        for number in itertools.count(30):
            web_feed.publish_estimate(bus, web_feed.estimate(8.0 + 1e-3 * number, rng))
            web_feed.publish_image(bus, number)
            result = VerifyResult(1, "cam0", CheckState.RESTING, verdict[0], 1, text="store")
            bus.publish(topics.VERIFY.key(web_feed.RIG, "cam0"), encode_verification(result))
            await asyncio.sleep(0.05)

    async def script(page):
        verdict = ["cannot_tell"]
        await page.open(served.address, 390, 844)
        feed = asyncio.create_task(publish(verdict))
        await page.wait("document.querySelector('#corners path.wanted') !== null")
        verdict[0] = "holds"
        await page.wait("document.getElementById('status').textContent === 'holds'")
        await page.wait("document.querySelector('#corners path.wanted') === null")
        green = await page.evaluate("document.querySelector('.say').classList.contains('converged')")
        feed.cancel()
        return green, page.errors

    assert browser.drive(script) == (True, [])
