"""A recording that was split into files is one recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import SimulatedRun, simulate

from vical_daemon.cli import main

CUTS_S = (1.0, 6.2)


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate(3, 11.0, camera_rate_hz=10.0, corner_sigma_px=0.3)


def _part(run: SimulatedRun, begin_s: float, end_s: float) -> SimulatedRun:
    """What was recorded between two times."""
    begin, end = (run.options.epoch_ns + round(1e9 * t) for t in (begin_s, end_s))
    imu = (run.t_imu_ns >= begin) & (run.t_imu_ns < end)
    return replace(
        run,
        t_imu_ns=run.t_imu_ns[imu],
        gyro_rps=run.gyro_rps[imu],
        specific_force_mps2=run.specific_force_mps2[imu],
        frames=[f for f in run.frames if begin <= f.t_cam_ns < end],
    )


def _calibrate(capsys, *folders: Path, command: str = "calibrate") -> dict:
    files = ["--target", str(folders[0] / "target.yaml"), "--initial", str(folders[0] / "initial.yaml")]
    assert main([command, *map(str, folders), *files, "--json"]) in (0, 3)
    return json.loads(capsys.readouterr().out)


def test_files_that_continue_one_another_are_one_recording(run, tmp_path, capsys) -> None:
    whole = _calibrate(capsys, write_asl(tmp_path / "whole", run, 100.0))
    ends = [0.0, *CUTS_S, 20.0]
    files = [
        write_asl(tmp_path / f"part{k}", _part(run, *ends[k : k + 2]), 100.0) for k in range(len(ends) - 1)
    ]
    split, merged = (_calibrate(capsys, *files, command=command) for command in ("calibrate", "merge"))
    for key in ("p_m", "covariance"):
        first, *others = (x["cameras"]["cam0"]["T_imu_cam"][key] for x in (whole, split, merged))
        for other in others:
            np.testing.assert_allclose(first, other, rtol=1e-9, atol=1e-12)
    assert split["frames"] == whole["frames"] == sum(x["frames"] for x in split["inputs"])
    # the first file is too short for a start of its own
    assert [x["used"] for x in split["inputs"]] == [True, True, True]
    assert [x["begin_s"] for x in split["inputs"]] == pytest.approx([0.0, *CUTS_S], abs=0.11)


def test_files_that_are_apart_are_recordings_of_their_own(run, tmp_path, capsys) -> None:
    parts = [
        write_asl(tmp_path / name, _part(run, begin, end), 100.0)
        for name, begin, end in (("first", 0.0, 5.0), ("second", 6.1, 11.0))
    ]
    begins = [x["begin_s"] for x in _calibrate(capsys, *parts)["inputs"]]
    assert begins[1] - begins[0] > 10.0
