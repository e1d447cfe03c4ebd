"""Two processes with the same job for one device would publish two estimates on one key."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

from vical_daemon.cli import run
from vical_daemon.cli.errors import CliError
from vical_daemon.config.model import loads
from vical_daemon.service.claims import ClaimedError, Claims

CONFIG = loads(
    "rig: rover\nimus: {imu0: {port: a}}\ncalibration: {mode: target_free}\n"
    "cameras: {left: {uri: 'v4l2:a'}, right: {uri: 'v4l2:b'}}\n"
)


@pytest.fixture(autouse=True)
def runtime(tmp_path, monkeypatch):
    monkeypatch.setenv("VICAL_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(run, "_CLAIM_S", 0.0)


def claims(*roles: str) -> Claims:
    return run._claims(CONFIG, list(roles), threading.Event())


def test_a_second_estimator_of_a_camera_is_refused_in_one_line():
    with claims("detect", "estimate"):
        for roles in (("estimate",), ("detect",), ("web", "estimate")):
            with pytest.raises(CliError, match=r"already runs the role \w+ for left of rover; stop it first"):
                claims(*roles)
        with claims("imu", "camera"):
            pass
        for _ in range(2):
            claims("record", "web")  # one stands by, the other wants a port of its own
    with claims("estimate"):
        pass


def test_two_buses_with_rigs_of_one_name_do_not_hinder_each_other(tmp_path):
    other = replace(CONFIG, bus=replace(CONFIG.bus, socket="/run/other/zenoh.sock"))
    with claims("estimate"), run._claims(other, ["estimate"], threading.Event()):
        assert len(list(tmp_path.iterdir())) == 4  # two cameras each


def test_a_refused_process_holds_nothing(tmp_path):
    with Claims(tmp_path, ["a"], 0, threading.Event()):
        with pytest.raises(ClaimedError):
            Claims(tmp_path, ["b", "a"], 0, threading.Event())
        with Claims(tmp_path, ["b"], 0, threading.Event()):
            pass


def test_a_killed_process_gives_its_claim_back_and_a_new_one_waits_for_it(tmp_path):
    code = (
        "import pathlib, sys, threading, time; from vical_daemon.service.claims import Claims\n"
        "held = Claims(pathlib.Path(sys.argv[1]), ['a'], 0, threading.Event())\n"
        "print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        killer = threading.Timer(0.3, other.kill)
        killer.start()
        begin_s = time.monotonic()
        with Claims(tmp_path, ["a"], 30.0, threading.Event()):
            assert 0.2 < time.monotonic() - begin_s < 20.0
