"""One contract for both buses: in memory, and zenoh with a router and a client on a unix socket."""

from __future__ import annotations

import threading
import time

import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus, LocalBus, key_matches
from vical_daemon.bus.zenoh_bus import BusError, open_bus

pytestmark = pytest.mark.system
IMU = topics.IMU.key("rig0", "imu0")
CALIBRATION = topics.CALIBRATION.key("rig0", "cam0")


@pytest.fixture(scope="module")
def zenoh_pair(tmp_path_factory):
    socket = tmp_path_factory.mktemp("bus") / "z.sock"
    router = open_bus(mode="router", socket=socket)
    client = open_bus(mode="client", socket=socket)
    yield router, client
    client.close()
    router.close()


def pair(request) -> tuple[Bus, Bus]:
    if request.param == "local":
        bus = LocalBus()
        return bus, bus
    router, client = request.getfixturevalue("zenoh_pair")
    return (router, client) if request.param == "zenoh down" else (client, router)


@pytest.fixture(params=["local", "zenoh up", "zenoh down"])
def ends(request):
    """(sender, receiver)"""
    return pair(request)


def until(condition, timeout_s: float = 30.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return bool(condition())


def probe(sender: Bus, receiver: Bus, key: str) -> None:
    """Wait until what is sent on a key arrives (zenoh: the declaration has reached the other side)."""
    arrived = threading.Event()
    subscription = receiver.subscribe(key, lambda _: arrived.set())
    assert until(lambda: sender.publish(key, b"probe") or arrived.wait(0.02))
    subscription.close()
    time.sleep(0.05)


class TestBusContract:
    """What every role may rely on."""

    def test_order_and_numbers(self, ends):
        sender, receiver = ends
        key = topics.IMU.key("rig0", "contract1")
        subscription = receiver.subscribe(key, depth=1000)
        probe(sender, receiver, key)
        for i in range(500):
            sender.publish(key, str(i).encode())
        samples = []
        while len([s for s in samples if s.payload != b"probe"]) < 500:
            sample = subscription.recv(5)
            assert sample is not None
            samples.append(sample)
        samples = [s for s in samples if s.payload != b"probe"]
        assert [s.payload for s in samples] == [str(i).encode() for i in range(500)]
        numbers = [s.sequence for s in samples]
        assert numbers == list(range(numbers[0], numbers[0] + 500))
        assert {s.key for s in samples} == {key}
        assert subscription.dropped == 0
        subscription.close()

    def test_handler_gets_every_sample(self, ends):
        sender, receiver = ends
        key = topics.POINTS.key("rig0", "contract2")
        got: list[bytes] = []
        subscription = receiver.subscribe(key, lambda sample: got.append(sample.payload))
        probe(sender, receiver, key)
        for i in range(100):
            sender.publish(key, str(i).encode())
        wanted = [str(i).encode() for i in range(100)]
        assert until(lambda: [g for g in got if g != b"probe"] == wanted)
        subscription.close()

    def test_full_queue_drops_and_counts(self, ends):
        sender, receiver = ends
        key = topics.POINTS.key("rig0", "contract3")
        probe(sender, receiver, key)
        subscription = receiver.subscribe(key, depth=4)
        time.sleep(0.1)
        for i in range(20):
            sender.publish(key, str(i).encode())
        assert until(lambda: subscription.dropped == 16)
        kept = []
        while (sample := subscription.recv(0)) is not None:
            kept.append(int(sample.payload))
        assert kept == [0, 1, 2, 3]
        subscription.close()

    def test_latest_is_kept_where_the_table_says_so(self, ends):
        sender, receiver = ends
        key, fleeting = topics.CALIBRATION.key("rig0", "contract4"), topics.IMU.key("rig0", "contract4")
        for i in range(3):
            sender.publish(key, str(i).encode())
            sender.publish(fleeting, str(i).encode())
        assert until(lambda: [s.payload for s in receiver.latest(key)] == [b"2"])
        assert [s.key for s in receiver.latest("vical/rig0/*/contract4")] == [key]
        assert receiver.latest(topics.CALIBRATION.key("rig9", "cam0")) == []
        assert [s.payload for s in sender.latest(key)] == [b"2"]  # one's own value as well

    def test_recv_waits_and_gives_up(self, ends):
        _, receiver = ends
        subscription = receiver.subscribe(topics.IMU.key("rig0", "silent"))
        begin = time.monotonic()
        assert subscription.recv(0) is None
        assert subscription.recv(0.1) is None
        assert 0.09 < time.monotonic() - begin < 3
        subscription.close()

    def test_close_wakes_whoever_waits(self, ends):
        _, receiver = ends
        subscription = receiver.subscribe(topics.IMU.key("rig0", "silent"))
        result: list[object] = ["nothing"]
        thread = threading.Thread(target=lambda: result.append(subscription.recv(None)))
        thread.start()
        subscription.close()
        subscription.close()
        thread.join(5)
        assert result == ["nothing", None]

    def test_large_payloads(self, ends):
        sender, receiver = ends
        key = topics.IMAGE.key("rig0", "contract5")
        probe(sender, receiver, key)
        subscription = receiver.subscribe(key)
        time.sleep(0.1)
        image = bytes(range(256)) * 5120
        got: list[bytes] = []

        def arrived() -> bool:  # images may be dropped on a busy machine: send again
            sender.publish(key, image)
            sample = subscription.recv(0.5)
            return sample is not None and (got.append(sample.payload) or True)

        assert until(arrived)
        assert set(got) == {image}
        subscription.close()

    def test_many_threads_may_publish(self, ends):
        sender, receiver = ends
        key = topics.IMU.key("rig0", "contract6")
        probe(sender, receiver, key)
        subscription = receiver.subscribe(key, depth=5000)
        time.sleep(0.1)
        threads = [
            threading.Thread(target=lambda: [sender.publish(key, b"x") for _ in range(200)]) for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        numbers = set()
        while len(numbers) < 800 and (sample := subscription.recv(3)) is not None:
            numbers.add(sample.sequence)
        assert len(numbers) == 800
        subscription.close()


def test_handler_that_fails_does_not_end_the_subscription(zenoh_pair, caplog):
    router, client = zenoh_pair
    key = topics.IMU.key("rig0", "fails")
    seen = []

    def handler(sample):
        seen.append(sample)
        raise ValueError("junk")

    subscription = router.subscribe(key, handler)
    probe(client, router, key)
    before = len(seen)
    client.publish(key, b"1")
    client.publish(key, b"2")
    assert until(lambda: len(seen) == before + 2)
    assert len([r for r in caplog.records if "failed" in r.message]) == 1
    subscription.close()


def test_messages_of_strangers_are_taken(zenoh_pair):
    """Plain zenoh without our numbers, and with a forged attachment."""
    router, client = zenoh_pair
    key = topics.IMU.key("rig0", "stranger")
    probe(client, router, key)
    subscription = router.subscribe(key)
    time.sleep(0.1)
    client.session.put(key, b"plain")
    client.session.put(key, b"forged", attachment=b"vic1" + bytes(3))
    client.session.put(key, b"jump", attachment=b"vic1" + b"\xff" * 12)
    assert [subscription.recv(5).payload for _ in range(3)] == [b"plain", b"forged", b"jump"]
    subscription.close()


def test_clients_come_back_to_a_new_router(tmp_path):
    socket = tmp_path / "z.sock"
    router = open_bus(mode="router", socket=socket)
    client = open_bus(mode="client", socket=socket)
    client.publish(CALIBRATION, b"before")
    assert until(lambda: [s.payload for s in router.latest(CALIBRATION)] == [b"before"])
    router.close()
    assert until(lambda: not client.connected)
    begin = time.monotonic()
    for _ in range(50):
        client.publish(IMU, b"into the void")
    assert time.monotonic() - begin < 1
    router = open_bus(mode="router", socket=socket)
    assert until(lambda: client.connected)
    assert until(lambda: [s.payload for s in router.latest(CALIBRATION)] == [b"before"])
    subscription = router.subscribe(IMU)
    assert until(lambda: client.publish(IMU, b"again") or subscription.recv(0.05) is not None)
    client.close()
    router.close()


def test_socket_of_a_killed_router_is_taken_over(tmp_path):
    import socket as sockets

    path = tmp_path / "z.sock"
    dead = sockets.socket(sockets.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    router = open_bus(mode="router", socket=path)
    with pytest.raises(BusError, match="already hosts the bus"):
        open_bus(mode="router", socket=path)
    router.close()


def test_what_cannot_be_opened_is_one_line(tmp_path):
    for options in (
        {"mode": "client", "socket": tmp_path / "no.sock"},
        {"mode": "client"},
        {"mode": "client", "connect": ["nonsense"]},
        {"mode": "router", "socket": tmp_path / "no" / "folder" / "z.sock"},
        {"mode": "router", "listen": ["tcp/not.an.address:1"]},
        {"mode": "client", "connect": ["tls/127.0.0.1:1"], "tls_ca": str(tmp_path / "ca.pem")},
    ):
        with pytest.raises(BusError) as error:
            open_bus(**options)
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="router or client"):
        open_bus(mode="peer")


def test_key_expressions():
    assert key_matches("vical/**", "vical/rig0/imu/imu0")
    assert key_matches("**", "a")
    assert key_matches("vical/*/status/*", "vical/rig1/status/imu")
    assert not key_matches("vical/*/status/*", "vical/rig1/status")
    assert key_matches("a/**/z", "a/z")
    assert not key_matches("a/b", "a/b/c")


def test_robot_works_without_its_site_and_joins_it_later(tmp_path):
    """A rig's router and a site's router: started in any order, each rig under its own key."""
    import socket as sockets

    with sockets.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    names = ("robot1", "robot2")
    users = tmp_path / "users.txt"
    users.write_text("".join(f"{name}:secret\n" for name in names))
    begin = time.monotonic()
    robots = [
        open_bus(
            mode="router", socket=tmp_path / f"{name}.sock", connect=[f"tcp/127.0.0.1:{port}"], user=name,
            password="secret", password_file=str(users),
        )
        for name in names
    ]  # fmt: skip
    assert time.monotonic() - begin < 5  # does not wait for the site
    role = open_bus(mode="client", socket=tmp_path / "robot1.sock", user="robot1", password="secret")
    role.publish(topics.CALIBRATION.key("robot1", "cam0"), b"1")
    robots[1].publish(topics.CALIBRATION.key("robot2", "cam0"), b"2")
    assert until(lambda: len(robots[0].latest("vical/robot1/calibration/*")) == 1)
    site = open_bus(
        mode="router", tcp_port=port, password_file=str(users), user="robot1", password="secret",
        publishers=names,
    )  # fmt: skip
    assert until(lambda: {s.payload for s in site.latest("vical/*/calibration/*")} == {b"1", b"2"}, 10)
    got: list[str] = []
    subscription = site.subscribe("vical/**", lambda sample: got.append(sample.key))
    key = topics.IMU.key("robot1", "imu0")
    assert until(lambda: role.publish(key, b"x") or key in got)
    subscription.close()
    for bus in (role, *robots, site):
        bus.close()
