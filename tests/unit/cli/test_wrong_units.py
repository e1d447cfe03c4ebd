"""Units that people mix up are named by every command that reads an IMU, with a board and without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.bus.interface import LocalBus
from vical_daemon.cli import main

RIG = reference_rig(3)
DEG, G = 180.0 / np.pi, 9.80665


@pytest.fixture(scope="module")
def runs() -> dict[str, SimulatedRun]:
    return {
        "board": simulate(3, 12.0, rig=RIG),
        "short": simulate(3, 2.8, rig=RIG),
        "board, 6 s": simulate(3, 6.0, rig=RIG),
        "free, 6 s": simulate_tracks(3, 6.0, rig=RIG, camera_rate_hz=10.0),
        "free": simulate_tracks(3, 12.0, rig=RIG, camera_rate_hz=10.0),
    }


def said(
    tmp_path: Path, capsys, command: str, run: SimulatedRun, free: bool, gyro: float, accel: float
) -> str:
    """What a command says to a recording in other units, with exit code 1."""
    wrong = replace(run, gyro_rps=gyro * run.gyro_rps, specific_force_mps2=accel * run.specific_force_mps2)
    folder = write_asl(tmp_path / "a", wrong)
    if free:
        table = folder / "mav0/cam0/corners.csv"
        table.rename(table.with_name("tracks.csv"))
    board = [] if free else ["--target", str(folder / "target.yaml")]
    options = [] if command == "info" else ["--initial", str(folder / "initial.yaml"), *board]
    assert main([command, str(folder), *options]) == (0 if command == "info" else 1)
    out = capsys.readouterr()
    error = out.out if command == "info" else out.err.strip().splitlines()[-1]
    assert "same recording?" not in error
    return error


@pytest.mark.parametrize("command", ["calibrate", "td-icp", "observability", "info"])
@pytest.mark.parametrize("kind", ["board", "free"])
def test_degrees_a_second(tmp_path, capsys, runs, kind, command):
    error = said(tmp_path, capsys, command, runs[kind], kind == "free", DEG, 1.0)
    assert "deg/s: multiply by pi/180" in error or "degrees per second (factor 57.3)" in error


@pytest.mark.parametrize("command", ["calibrate", "td-icp", "observability"])
@pytest.mark.parametrize("gyro", [DEG, 60.0 / (2.0 * np.pi)], ids=["deg/s", "rpm"])
def test_rates_of_a_recording_too_short_for_gravity_to_turn(tmp_path, capsys, runs, command, gyro):
    error = said(tmp_path, capsys, command, runs["short"], False, gyro, 1.0)
    assert "times the camera's" in error and "rad/s" in error


@pytest.mark.parametrize(("gyro", "times"), [(2.0, "2 times"), (0.5, "only 1/2 of")])
def test_a_gyro_read_with_another_range(tmp_path, capsys, runs, gyro, times):
    """All numbers are half or twice as large: the sensor was set to another full scale."""
    folder = write_asl(tmp_path / "a", replace(runs["board"], gyro_rps=gyro * runs["board"].gyro_rps))
    options = ["--target", f"{folder}/target.yaml", "--initial", f"{folder}/initial.yaml"]
    assert main(["td-icp", str(folder), *options]) == 1
    error = capsys.readouterr().err
    assert f"the gyro's rates are {times} the camera's: is its range the one" in error


@pytest.mark.parametrize("command", ["calibrate", "observability", "info"])
@pytest.mark.parametrize("kind", ["board", "free"])
@pytest.mark.parametrize(("accel", "unit"), [(1.0 / G, "like g: multiply"), (1000.0 / G, "mg (multiply")])
def test_multiples_of_gravity(tmp_path, capsys, runs, kind, command, accel, unit):
    assert unit in said(tmp_path, capsys, command, runs[kind], kind == "free", 1.0, accel)


@pytest.mark.parametrize("kind", ["board", "free"])
def test_gravity_instead_of_specific_force(tmp_path, capsys, runs, kind):
    """As phones of Apple report it. Nothing refuses it at once: each attempt to start takes longer."""
    error = said(tmp_path, capsys, "calibrate", runs[f"{kind}, 6 s"], kind == "free", 1.0, -1.0)
    assert "reports gravity instead of specific force" in error and "negate all three" in error


def test_swapped_columns_in_other_units(tmp_path, capsys, runs):
    run = runs["board"]
    swapped = replace(run, gyro_rps=run.specific_force_mps2 / G, specific_force_mps2=run.gyro_rps * DEG)
    assert "columns seem to be swapped" in said(tmp_path, capsys, "info", swapped, False, 1.0, 1.0)


def test_a_replay_warns_of_other_units(tmp_path, capsys, runs, monkeypatch):
    monkeypatch.setattr("vical_daemon.cli.replay._open_bus", lambda _: LocalBus())
    folder = write_asl(tmp_path / "a", replace(runs["board"], gyro_rps=DEG * runs["board"].gyro_rps))
    assert main(["replay", str(folder), "--speed", "0"]) == 0
    assert "deg/s: multiply by pi/180" in capsys.readouterr().err


@pytest.mark.parametrize(("bias", "code"), [(0.9, 1), (0.9 / DEG, 0)], ids=["deg/s", "rad/s"])
def test_an_imu_at_rest_with_a_usual_bias_in_degrees(tmp_path, capsys, bias, code):
    """Noise alone does not show its unit; a bias of 0.9 rad/s no gyro has."""
    rng = np.random.default_rng(4)
    values = rng.normal(0.0, 1e-3, (20_000, 6)) + np.array([0.0, bias, 0.0, 0.0, 0.0, 9.81])
    rows = (f"{k * 10_000_000}," + ",".join(f"{x:.6f}" for x in row) for k, row in enumerate(values.tolist()))
    (tmp_path / "rest.csv").write_text("\n".join(rows) + "\n")
    assert main(["allan", str(tmp_path / "rest.csv")]) == code
    assert ("although gravity in the accelerometer does not turn" in capsys.readouterr().err) == (code == 1)
