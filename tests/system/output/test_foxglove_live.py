"""The Foxglove WebSocket, spoken to by hand (aiohttp), and `vical web` over a real bus."""

import asyncio
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from urllib.request import urlopen

import aiohttp
import numpy as np
import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import encode_imu, encode_points
from vical_daemon.config.model import CameraConfig, Config, ImuConfig
from vical_daemon.web.foxglove import FoxgloveError, FoxgloveServer, rig_keys

pytestmark = pytest.mark.system
CONFIG = Config(imus={"imu0": ImuConfig(port="none")}, cameras={"cam0": CameraConfig(uri="none")})


class CountingBus(LocalBus):
    """Notes what is fetched."""

    def __init__(self):
        super().__init__()
        self.open = set()

    def subscribe(self, key_expression, handler=None, **options):
        self.open.add(key_expression)
        return super().subscribe(key_expression, handler, **options)

    def remove(self, subscription):
        self.open.discard(subscription.expression)
        super().remove(subscription)


@pytest.fixture
def bus():
    return CountingBus()


@pytest.fixture
def server(bus):
    server = FoxgloveServer(bus, CONFIG, "127.0.0.1", 0)
    yield server
    server.close()
    server.close()


async def advertised(channel_socket):
    channels = {}
    while len(channels) < len(rig_keys(CONFIG)) + 2:
        message = await channel_socket.receive(timeout=30)
        if message.type is aiohttp.WSMsgType.TEXT:
            document = json.loads(message.data)
            for channel in document.get("channels", []):
                channels[channel["topic"]] = channel
    return channels


def test_a_viewer_gets_the_bytes_of_the_bus_and_only_while_it_looks(bus, server):
    imu = topics.IMU.key("rig0", "imu0")
    points = topics.POINTS.key("rig0", "cam0")
    payload = encode_imu(10**18, "imu0", (0.1, 0.2, 0.3), (0.0, 0.0, 9.8))
    corners = encode_points(10**18, "cam0", np.arange(3), np.arange(6.0).reshape(3, 2))
    assert bus.open == set()

    async def talk():
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"ws://127.0.0.1:{server.port}", protocols=["foxglove.sdk.v1"]) as viewer,
        ):
            channels = await advertised(viewer)
            wanted = [f"/{imu}", f"/{points}/annotations"]
            request = [{"id": 7 + i, "channelId": channels[topic]["id"]} for i, topic in enumerate(wanted)]
            await viewer.send_json({"op": "subscribe", "subscriptions": request})
            while bus.open != {imu, points}:
                await asyncio.sleep(0.02)
            bus.publish(imu, payload)
            bus.publish(points, corners)
            got = {}
            while len(got) < 2:
                message = await viewer.receive(timeout=30)
                if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 1:
                    got[struct.unpack_from("<I", message.data, 1)[0]] = message.data[13:]
            await viewer.send_json({"op": "unsubscribe", "subscriptionIds": [7, 8]})
            while bus.open:
                await asyncio.sleep(0.02)
            return channels, got

    channels, got = asyncio.run(asyncio.wait_for(talk(), 60))
    assert got[7] == payload
    assert len(got[8]) > 30
    channel = channels[f"/{imu}"]
    assert (channel["encoding"], channel["schemaName"]) == ("cdr", "sensor_msgs/msg/Imu")
    assert "geometry_msgs/Quaternion" in channel["schema"]
    assert channels[f"/{points}/annotations"]["schemaName"] == "foxglove.ImageAnnotations"


def test_taken_port_is_said(bus):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(FoxgloveError, match="cannot serve Foxglove"):
            FoxgloveServer(bus, CONFIG, "127.0.0.1", taken.getsockname()[1])


def test_vical_web_finds_the_rig_by_itself(tmp_path, web_feed):
    from vical_daemon.bus.zenoh_bus import open_bus

    path = tmp_path / "zenoh.sock"
    environment = os.environ | {"VICAL_RUNTIME_DIR": str(tmp_path), "VICAL_STATE_DIR": str(tmp_path)}
    host = open_bus(mode="router", socket=path)
    stop = threading.Event()

    def feed():
        rng, t = np.random.default_rng(0), 0.0
        while not stop.wait(0.1):
            t += 0.2
            web_feed.publish_estimate(host, web_feed.estimate(t, rng))

    thread = threading.Thread(target=feed)
    thread.start()
    command = [sys.executable, "-m", "vical_daemon", "web", "--port", "0", "--foxglove", "0", "--json"]
    try:
        stop.wait(0.5)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True)
        address = json.loads(process.stdout.readline())["address"]
        cameras = {}
        while not cameras:
            with urlopen(address + "api/state") as answer:
                cameras = json.load(answer)["cameras"]
        assert cameras["cam0"]["status"] in ("converging", "converged")
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        process.stdout.close()
    finally:
        stop.set()
        thread.join()
        host.close()


def test_vical_web_without_a_bus_is_one_line(tmp_path, capsys, monkeypatch):
    from vical_daemon.cli import main

    monkeypatch.setenv("VICAL_RUNTIME_DIR", str(tmp_path))
    assert main(["web", "--connect", "nowhere"]) == 1  # one that may still come is waited for
    assert main(["web", "--port", "99999"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
