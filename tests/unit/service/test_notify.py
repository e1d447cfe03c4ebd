"""Datagrams to systemd and journald, received on sockets of our own."""

from __future__ import annotations

import socket
import struct

import pytest

from vical_daemon.service import notify


@pytest.fixture
def receiver(tmp_path):
    path = str(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(path)
        server.settimeout(2)
        yield path, server


def test_systemd_hears_what_is_said(receiver, monkeypatch):
    path, server = receiver
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    assert notify.ready("two\nlines")
    assert server.recv(999) == b"READY=1\nSTATUS=two lines"
    assert notify.status("fine")
    assert server.recv(999) == b"STATUS=fine"
    assert notify.watchdog()
    assert server.recv(999) == b"WATCHDOG=1"
    assert notify.stopping()
    assert server.recv(999) == b"STOPPING=1"
    assert not notify.status("")


def test_without_systemd_nothing_happens(monkeypatch, tmp_path):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify.ready()
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    assert not notify.ready()
    monkeypatch.setenv("VICAL_JOURNAL_SOCKET", str(tmp_path / "nobody"))
    assert not notify.event("converged", "cam0")


def test_abstract_sockets(monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind("\0vical-test-notify")
        monkeypatch.setenv("NOTIFY_SOCKET", "@vical-test-notify")
        assert notify.ready()
        assert server.recv(99) == b"READY=1"


def test_events_have_fields(receiver, monkeypatch):
    path, server = receiver
    monkeypatch.setenv("VICAL_JOURNAL_SOCKET", path)
    assert notify.event("bumped", "cam0 moved", level="warning", camera="cam0", angle_rad=0.5)
    lines = server.recv(9999).decode().splitlines()
    assert lines == [
        "MESSAGE=cam0 moved", "PRIORITY=4", "SYSLOG_IDENTIFIER=vical", "VICAL_EVENT=bumped",
        "VICAL_CAMERA=cam0",
        "VICAL_ANGLE_RAD=0.5",
    ]  # fmt: skip


def test_text_with_line_breaks_cannot_forge_fields(receiver, monkeypatch):
    path, server = receiver
    monkeypatch.setenv("VICAL_JOURNAL_SOCKET", path)
    text = "a\nPRIORITY=0"
    assert notify.event("x", text)
    assert server.recv(9999).startswith(
        b"MESSAGE\n" + struct.pack("<Q", len(text)) + text.encode() + b"\nPRIORITY=5"
    )


def test_a_full_socket_does_not_stop_the_caller(receiver, monkeypatch):
    path, _ = receiver
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    results = [notify.watchdog() for _ in range(2000)]
    assert results[0]
    assert not results[-1]
