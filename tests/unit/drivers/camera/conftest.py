"""A fake kernel with cameras for every test of the V4L2 grabber."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.v4l2.camera import V4l2Camera
from vical_mocks.v4l2_camera import FakeCamera
from vical_mocks.v4l2_kernel import FakeKernel

OpenCamera = Callable[..., V4l2Camera]


@pytest.fixture
def kernel(tmp_path: Path) -> FakeKernel:
    return FakeKernel(tmp_path)


@pytest.fixture
def open_fake(kernel: FakeKernel) -> Iterator[OpenCamera]:
    """Plug a fake camera in and open it; all of it is closed, and checked for leaks, afterwards."""
    opened: list[V4l2Camera] = []

    def open_it(camera: FakeCamera, number: int = 0, **settings: Any) -> V4l2Camera:
        path = kernel.plug(camera, number)
        source = V4l2Camera(path, CameraSettings(**settings), kernel=kernel, wait=_wait(kernel))
        opened.append(source)
        return source

    yield open_it
    for source in opened:
        source.close()
    assert kernel.open_descriptors == 0
    assert not kernel.mappings


def _wait(kernel: FakeKernel) -> Callable[[float], None]:
    def wait(timeout_s: float) -> None:
        kernel.clock.sleep_until(kernel.clock.now_ns + round(timeout_s * 1e9))

    return wait
