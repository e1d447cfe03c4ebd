"""The processes of the simulated rig end without a word when their parent ends, ready or not."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest
from vical_mocks.live_rig import _DEVICES, LiveRigSettings, _start_deaf_to_interrupts

BOARD = {"kind": "checkerboard", "cols": 8, "rows": 5, "row_spacing_m": 0.05, "col_spacing_m": 0.05}


@pytest.mark.parametrize("device", list(_DEVICES))
def test_a_device_whose_parent_has_ended_ends_and_prints_nothing(
    device: str, capfd: pytest.CaptureFixture[str]
) -> None:
    ours, theirs = multiprocessing.Pipe()
    ours.close()
    _DEVICES[device](LiveRigSettings(BOARD), time.monotonic(), theirs)  # ^C while they load their libraries
    assert capfd.readouterr() == ("", "")


def test_no_interrupt_reaches_a_device_from_its_first_moment_on() -> None:
    process = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,), daemon=True)
    _start_deaf_to_interrupts(process)
    try:
        assert process.pid is not None
        os.kill(process.pid, signal.SIGINT)  # before it has imported anything
        status = Path(f"/proc/{process.pid}/status").read_text()
        blocked = next(line for line in status.splitlines() if line.startswith("SigBlk"))
        assert int(blocked.split()[1], 16) & 1 << signal.SIGINT - 1
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    finally:
        process.terminate()
        process.join()
