"""`vical allan` and `vical imu-calibrate` read a table as that of a folder is read: units, separators."""

from __future__ import annotations

import json

import numpy as np
import pytest

from vical_daemon.cli import main


def table(path, stamp, step, separator=","):
    rng = np.random.default_rng(1)
    lines = ["timestamp,ax,ay,az,gx,gy,gz".replace(",", separator)]
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


@pytest.mark.parametrize(
    ("name", "separator"),
    [("a.csv", ";"), ("a.tsv", "\t"), ("a.txt", " ")],
    ids=["semicolon", "tab", "space"],
)
def test_separators_and_dates_are_understood(tmp_path, capsys, name, separator):
    path = table(tmp_path / name, "2026-01-31 12:00:{0:013.10f}", 0.005, separator)
    assert main(["allan", path, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rate_hz"] == pytest.approx(200.0, rel=1e-3)


def test_a_table_alone_is_no_recording_to_calibrate_from(tmp_path, capsys):
    assert main(["calibrate", table(tmp_path / "a.csv", "{:d}", 5_000_000)]) == 1
    assert "holds no camera" in capsys.readouterr().err
