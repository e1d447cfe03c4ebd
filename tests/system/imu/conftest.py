"""An emulated GX3 on a pseudo terminal; it must leave no thread and no descriptor behind."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator

import pytest
from vical_mocks.gx3_emulator import Gx3Emulator


def open_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208


@pytest.fixture
def emulate() -> Iterator[Callable[..., Gx3Emulator]]:
    threads, descriptors = threading.active_count(), open_descriptors()
    started: list[Gx3Emulator] = []

    def start(**options) -> Gx3Emulator:
        emulator = Gx3Emulator(**options).start()
        started.append(emulator)
        return emulator

    yield start
    for emulator in started:
        emulator.stop()
    assert threading.active_count() == threads
    assert open_descriptors() == descriptors
