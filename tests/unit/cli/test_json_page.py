"""docs/reference/json.md names every key that commands on recordings print (those of events: events.md)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from vical_mocks.harness.asl import write_asl
from vical_mocks.points import simulate

from vical_daemon.cli import main

PAGES = [Path(__file__).parents[3] / "docs/reference" / name for name in ("json.md", "events.md")]
NAMES = {"cam0", "imu0", "time shift", "position", "rotation", "lens"}  # of sensors and blocks
MADE = re.compile(
    r"(p|r|fx|fy|cx|cy|k\d|p\d|gyro_bias|accel_bias)(_[xyz])?(_\w+)?"
)  # of numbers of a calibration


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("json")
    write_asl(folder / "log", simulate(4, 14.0, timeshift_cam_imu_s=0.004))
    return folder


def keys(document: Any) -> Iterator[str]:
    if isinstance(document, dict):
        yield from document
    values = document.values() if isinstance(document, dict) else document
    for value in values if isinstance(document, dict | list) else ():
        yield from keys(value)


def test_the_page_names_every_key(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, result = str(recording / "log"), str(recording / "result.json")
    files = {word: str(recording / "log" / f"{word}.yaml") for word in ("target", "initial")}
    target = ["--target", files["target"], "--initial", files["initial"], "--json"]
    commands = [
        ["calibrate", log, *target, "-o", result],
        ["verify", log, "--against", result, *target],
        ["td-icp", log, *target, "--watch", "4"],
        ["td-icp", log, *target, "--sensors", "imu0,cam0"],
        ["observability", log, *target],
        ["compare", result, result, "--json"],
        ["compare", result, result, result, "--matrix", "--json"],
        ["info", log, "--json"],
        ["doctor", "--json"],
    ]
    text = "".join(path.read_text(encoding="utf-8") for path in PAGES)
    page = set(re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL)))
    for words in commands:
        assert main(words) in (0, 1, 3, 5), words
        found = set(keys(json.loads(capsys.readouterr().out)))
        assert len(found) > 3
        assert {key for key in found - page - NAMES if not MADE.fullmatch(key)} == set(), words
