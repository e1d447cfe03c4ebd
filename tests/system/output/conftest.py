"""The page served over a LocalBus that is fed like a rig's."""

import importlib.util
import json
import sys
import threading
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from vical_daemon.bus.interface import LocalBus
from vical_daemon.config.model import CameraConfig, Config, ImuConfig, WebConfig
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.web import role as web


def load(name):
    """Import a module beside this file (tests have no packages)."""
    unique = f"vical_output_{name}"
    if unique not in sys.modules:
        spec = importlib.util.spec_from_file_location(unique, Path(__file__).with_name(f"{name}.py"))
        sys.modules[unique] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[unique])
    return sys.modules[unique]


@pytest.fixture(scope="session")
def web_feed():
    return load("web_feed")


@pytest.fixture(scope="session")
def browser():
    module = load("browser")
    if module.find() is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    return module


class Served:
    """A running page: its bus, address, and everything sent as commands."""

    def __init__(self, bus, address):
        self.bus, self.address, self.commands = bus, address, []


@pytest.fixture
def served(web_feed, monkeypatch):
    monkeypatch.setenv("VICAL_WEB_TOKEN", "open sesame")
    bus, stop, ready, addresses = LocalBus(), threading.Event(), threading.Event(), []
    config = Config(
        rig=web_feed.RIG,
        imus={"imu0": ImuConfig(port="none")},
        cameras={"cam0": CameraConfig(uri="none")},
        web=WebConfig(enabled=True, port=0),
    )
    options = {"clock": private_clock(), "ready": lambda address: (addresses.append(address), ready.set())}
    thread = threading.Thread(target=web.run, args=(config, bus, stop), kwargs=options)
    thread.start()
    assert ready.wait(60)
    page = Served(bus, addresses[0])
    bus.subscribe("vical/*/command/*", lambda sample: page.commands.append(sample))
    yield page
    stop.set()
    thread.join(60)
    assert not thread.is_alive()


@pytest.fixture
def fed(served, web_feed):
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
