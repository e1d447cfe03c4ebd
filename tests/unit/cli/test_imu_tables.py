"""`vical allan` and `vical imu-calibrate` read a table as that of a folder is read: units, separators."""

from __future__ import annotations

import json

import numpy as np
import pytest

from vical_daemon.cli import main


def table(path, stamp, step, separator=","):
    rng = np.random.default_rng(1)
    lines = ["timestamp,ax,ay,az,gx,gy,gz"] if separator == "," else []
    for i, row in enumerate(1e-3 * rng.standard_normal((4000, 6)) + [0, 0, 9.81, 0, 0, 0]):
        lines.append(separator.join([stamp.format(i * step), *(f"{x:.6f}" for x in row)]))
    path.write_text("\n".join(lines) + "\n")
    return str(path)


@pytest.mark.parametrize(
    ("stamp", "step", "unit"),
    [("{:d}", 5_000_000, ""), ("{:d}", 5, "milliseconds"), ("{:.3f}", 0.005, "seconds")],
)
def test_stamps_may_have_any_unit(tmp_path, capsys, stamp, step, unit):
    assert main(["allan", table(tmp_path / "a.csv", stamp, step), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["rate_hz"] == pytest.approx(200.0, rel=1e-3)
    assert (f"by their spacing the stamps are {unit}" in captured.err) == bool(unit)


@pytest.mark.parametrize("command", ["allan", "imu-calibrate"])
def test_a_wrong_separator_is_named(tmp_path, capsys, command):
    assert main([command, table(tmp_path / "a.csv", "{:d}", 5_000_000, ";")]) == 1
    line = capsys.readouterr().err
    assert "line 1 is not 7 numbers, separated by semicolons" in line and line.count("\n") == 1


def test_a_table_alone_is_no_recording_to_calibrate_from(tmp_path, capsys):
    assert main(["calibrate", table(tmp_path / "a.csv", "{:d}", 5_000_000)]) == 1
    assert "holds no camera" in capsys.readouterr().err
