"""`vical doctor` on made-up computers: what is wrong is named, each with what to do."""

from __future__ import annotations

import json
from pathlib import Path

from vical_daemon.cli import doctor, main


def _computer(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_a_good_computer_has_no_problem(tmp_path: Path) -> None:
    root = _computer(
        tmp_path,
        {
            "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc\n",
            "sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1\n",
            "dev/ttyUSB0": "",
            "dev/video0": "",
        },
    )
    findings = list(doctor.examine(root, lambda _path: True))
    assert not [f for f in findings if f.problem and f.what != "disk"]
    assert {"clock source", "device", "latency timer", "disk", "real time"} <= {f.what for f in findings}


def test_each_problem_says_what_to_do(tmp_path: Path) -> None:
    root = _computer(
        tmp_path,
        {
            "sys/devices/system/clocksource/clocksource0/current_clocksource": "hpet\n",
            "sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16\n",
            "sys/module/usbcore/parameters/usbfs_memory_mb": "16\n",
            "dev/ttyUSB0": "",
        },
    )
    findings = list(doctor.examine(root, lambda _path: False))
    problems = {f.what: f.problem for f in findings if f.problem}
    assert "hpet" in problems["clock source"] and "tsc=reliable" in problems["clock source"]
    assert "16 ms" in problems["latency timer"] and "| sudo tee " in problems["latency timer"]
    assert "ttyUSB0: not yours to use: " in problems["device"]
    (usbfs,) = [f for f in findings if f.what == "usbfs memory"]
    assert usbfs.text.startswith("16 MB; for a USB3 Vision camera")


def test_as_typed(capsys, monkeypatch) -> None:
    bad = doctor.Finding("device", "/dev/ttyUSB0", "/dev/ttyUSB0: not yours")
    monkeypatch.setattr(doctor, "examine", lambda: iter([doctor.Finding("clock source", "tsc"), bad]))
    assert main(["doctor", "--json"]) == 1
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert not found["ok"] and found["problems"] == ["/dev/ttyUSB0: not yours"]
    assert err == "vical: error: /dev/ttyUSB0: not yours\n"
    monkeypatch.setattr(doctor, "examine", lambda: iter([doctor.Finding("clock source", "tsc")]))
    assert main(["doctor"]) == 0
    assert "clock source" in capsys.readouterr().out
