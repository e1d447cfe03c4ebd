"""The queue between the bus and a reader: what it keeps, what it drops and counts."""

import pytest

from vical_daemon.bus.interface import Sample, SampleQueue


def kept(queue):
    samples = iter(lambda: queue.recv(0.0), None)
    return [sample.sequence for sample in samples]


def filled(queue, sizes):
    for number, size in enumerate(sizes):
        queue.put(Sample("vical/rig0/image/cam0", bytes(size), number))
    return queue


@pytest.mark.parametrize(("depth", "numbers"), [(10, [0, 1, 2, 3, 4]), (2, [0, 1])])
def test_it_keeps_so_many_samples_and_counts_the_rest(depth, numbers):
    queue = filled(SampleQueue(depth), [100] * 5)
    assert queue.dropped == 5 - len(numbers)
    assert kept(queue) == numbers


def test_what_was_taken_leaves_room():
    queue = SampleQueue(3)
    for _ in range(20):
        assert kept(filled(queue, [100] * 3)) == [0, 1, 2]
    assert queue.dropped == 0
