"""Images that wait for the detector: which are kept, in which order, and which an overload drops."""

from itertools import pairwise

import pytest

from vical_daemon.bus.interface import Sample
from vical_daemon.detect import image_queue
from vical_daemon.detect.image_queue import OVER_S, ImageQueue

PERIOD_S = 0.05


class Clock:
    def __init__(self):
        self.s = 1000.0

    def __call__(self):
        return self.s


def image(number, size=100):
    return Sample("vical/rig0/camera/cam0/image", bytes(size), number)


def numbers(queue):
    taken = iter(lambda: queue.take(0.0), None)
    return [(camera, sample.sequence) for camera, sample in taken]


def detect(queue, clock, period_s, seconds, cost_s, cameras=("cam0",)):
    """Images come every `period_s`, and each takes the detector `cost_s`; return (age, camera, number)."""
    used, came, end_s = [], 0, clock.s + seconds
    next_s = clock.s
    while clock.s < end_s:
        while next_s <= clock.s:
            for camera in cameras:
                queue.put(camera, image(came))
            came, next_s = came + 1, next_s + period_s
        taken = queue.take(0.0)
        if taken is None:
            clock.s = next_s
            continue
        camera, sample = taken
        born_s = next_s - (came - sample.sequence) * period_s
        used.append((clock.s - born_s, camera, sample.sequence))
        clock.s += cost_s
    return used


def test_images_come_out_in_order_and_cameras_in_turn():
    queue = ImageQueue(["cam0", "cam1"])
    for number in range(2):
        queue.put("cam0", image(number))
    queue.put("cam1", image(7))
    assert numbers(queue) == [("cam0", 0), ("cam1", 7), ("cam0", 1)]
    assert queue.dropped == {"cam0": 0, "cam1": 0}


@pytest.mark.parametrize(("limit", "kept"), [(399, [1, 3]), (150, [3]), (50, [3])])
def test_a_full_queue_drops_every_second_image_and_keeps_one_however_large(monkeypatch, limit, kept):
    monkeypatch.setattr(image_queue, "QUEUE_BYTES", limit)
    queue = ImageQueue(["cam0"])
    for number in range(4):
        queue.put("cam0", image(number))
    assert queue.dropped["cam0"] == 4 - len(kept)
    assert numbers(queue) == [("cam0", number) for number in kept]


def test_what_was_cleared_leaves_room(monkeypatch):
    monkeypatch.setattr(image_queue, "QUEUE_BYTES", 300)
    queue = ImageQueue(["cam0"])
    for _ in range(20):
        for number in range(3):
            queue.put("cam0", image(number))
        queue.clear("cam0")
        assert numbers(queue) == []
    assert queue.dropped["cam0"] == 0


def test_a_burst_that_the_queue_can_hold_loses_nothing(monkeypatch):
    monkeypatch.setattr(image_queue, "QUEUE_BYTES", 6100)
    clock = Clock()
    queue = ImageQueue(["cam0"], clock)
    for _ in range(3):
        detect(queue, clock, PERIOD_S, 3.0, cost_s=20 * PERIOD_S)  # something else needs the computer
        detect(queue, clock, PERIOD_S, 30.0, cost_s=0.9 * PERIOD_S)  # it is slow to catch up
    assert queue.dropped["cam0"] == 0


def test_an_overload_that_lasts_drops_evenly_and_what_is_used_is_fresh(monkeypatch):
    monkeypatch.setattr(image_queue, "QUEUE_BYTES", 1000)
    clock, cameras = Clock(), ("cam0", "cam1", "cam2")
    queue = ImageQueue(cameras, clock)
    detect(queue, clock, PERIOD_S, 10.0, cost_s=0.5 * PERIOD_S, cameras=cameras)
    used = detect(queue, clock, PERIOD_S, 60.0, cost_s=0.5 * PERIOD_S, cameras=cameras)
    assert max(age_s for age_s, _, _ in used) <= PERIOD_S
    by_camera = [[n for _, c, n in used if c == camera] for camera in cameras]
    assert max(map(len, by_camera)) - min(map(len, by_camera)) <= 1
    steps = {b - a for own in by_camera for a, b in pairwise(own)}
    assert steps <= {1, 2}  # two thirds of all images


def test_an_overload_leaves_no_gap(monkeypatch):
    monkeypatch.setattr(image_queue, "QUEUE_BYTES", 5000)
    clock = Clock()
    queue = ImageQueue(["cam0"], clock)
    used = [number for _, _, number in detect(queue, clock, PERIOD_S, 60.0, cost_s=3.0 * PERIOD_S)]
    assert max(b - a for a, b in pairwise(used)) <= 12  # of 50 that wait


def test_after_an_overload_bursts_are_kept_again(monkeypatch):
    monkeypatch.setattr(image_queue, "QUEUE_BYTES", 6100)
    clock = Clock()
    queue = ImageQueue(["cam0"], clock)
    detect(queue, clock, PERIOD_S, 30.0, cost_s=3.0 * PERIOD_S)
    detect(queue, clock, PERIOD_S, 3.0 * OVER_S, cost_s=0.9 * PERIOD_S)
    dropped = queue.dropped["cam0"]
    assert dropped > 100
    detect(queue, clock, PERIOD_S, 3.0, cost_s=20 * PERIOD_S)
    detect(queue, clock, PERIOD_S, 30.0, cost_s=0.9 * PERIOD_S)
    assert queue.dropped["cam0"] == dropped
