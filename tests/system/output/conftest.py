"""The page served over a LocalBus that is fed like a rig's."""

import json
import threading
import time
from urllib.request import urlopen

import numpy as np
import pytest
from vical_mocks.harness import browser, web_feed

from vical_daemon.bus.interface import LocalBus
from vical_daemon.vision.target import Checkerboard


@pytest.fixture(scope="session", name="web_feed")
def web_feed_module():
    return web_feed


@pytest.fixture(scope="session", name="browser")
def running_browser(tmp_path_factory):
    if browser.find() is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    running = browser.Browser(tmp_path_factory.mktemp("profile"))
    yield running
    running.close()


class Served:
    """A running page: its bus, address, folder of logs, and everything sent as commands."""

    def __init__(self, bus, address, logs):
        self.bus, self.address, self.logs, self.commands = bus, address, logs, []


@pytest.fixture
def served(monkeypatch, tmp_path):
    monkeypatch.setenv("VICAL_WEB_TOKEN", "open sesame")
    board = tmp_path / "board.yaml"
    board.write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
    bus, stop, ready, addresses = LocalBus(), threading.Event(), threading.Event(), []
    known = {"target": board, "logs": tmp_path}
    thread = web_feed.serve_page(bus, stop, lambda address: (addresses.append(address), ready.set()), **known)
    assert ready.wait(60)
    page = Served(bus, addresses[0], tmp_path)
    bus.subscribe("vical/*/command/*", lambda sample: page.commands.append(sample))
    yield page
    stop.set()
    thread.join(60)
    assert not thread.is_alive()


@pytest.fixture
def fed(served):
    """Half a minute of history, then live data at 5 Hz (images at 10 Hz) until the test ends."""
    rng, stop = np.random.default_rng(0), threading.Event()
    for k in range(1, 150):
        web_feed.publish_estimate(served.bus, web_feed.estimate(0.2 * k, rng))

    def digested():
        with urlopen(served.address + "api/state") as answer:
            return bool(json.load(answer)["cameras"])

    while not digested():
        time.sleep(0.05)

    def feed():
        k = 150
        while not stop.wait(0.1):
            k += 1
            web_feed.publish_estimate(served.bus, web_feed.estimate(0.2 * k, rng))
            web_feed.publish_status(served.bus)
            web_feed.publish_image(served.bus, k)

    thread = threading.Thread(target=feed)
    thread.start()
    yield served
    stop.set()
    thread.join()
