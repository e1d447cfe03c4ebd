"""An emulated GX3 on a pseudo terminal; it must leave no thread and no descriptor behind."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from vical_mocks.gx3_emulator import Gx3Emulator


def open_descriptors() -> set[tuple[str, str]]:
    """Number and target of each descriptor."""
    found = set()
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # that of the listing itself
            found.add((link.name, str(link.readlink())))
    return found


@pytest.fixture
def emulate() -> Iterator[Callable[..., Gx3Emulator]]:
    threads, descriptors = set(threading.enumerate()), open_descriptors()
    started: list[Gx3Emulator] = []

    def start(**options) -> Gx3Emulator:
        emulator = Gx3Emulator(**options).start()
        started.append(emulator)
        return emulator

    yield start
    for emulator in started:
        emulator.stop()
    # What is new counts: what an earlier test of this process left to the end of a thread may go meanwhile.
    assert set(threading.enumerate()) - threads == set()
    assert open_descriptors() - descriptors == set()
