"""The processes of the simulated rig end without a word when the parent ended before they were ready."""

from __future__ import annotations

import multiprocessing
import time

import pytest
from vical_mocks.live_rig import _DEVICES, LiveRigSettings

BOARD = {"kind": "checkerboard", "cols": 8, "rows": 5, "row_spacing_m": 0.05, "col_spacing_m": 0.05}


@pytest.mark.parametrize("device", list(_DEVICES))
def test_a_device_whose_parent_has_ended_ends_and_prints_nothing(
    device: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("signal.signal", lambda *_: None)  # the devices run in this process here
    ours, theirs = multiprocessing.Pipe()
    ours.close()
    _DEVICES[device](LiveRigSettings(BOARD), time.monotonic(), theirs)  # ^C while they load their libraries
    assert capfd.readouterr() == ("", "")
