"""Why images are copied: what to do differs."""

from __future__ import annotations

import logging

import pytest
import zenoh

from vical_daemon.bus import zenoh_session


@pytest.fixture(autouse=True)
def not_warned(monkeypatch):
    monkeypatch.setattr(zenoh_session, "_warned", False)


def reason(caplog) -> str:
    (record,) = [record for record in caplog.records if "copies images" in record.message]
    return record.message


@pytest.mark.parametrize(("shared", "says"), [(True, "there is no /dev/shm"), (False, "ulimit -l")])
def test_the_line_names_what_is_in_the_way(monkeypatch, caplog, shared, says):
    def opened(config):
        if config["transport"]["shared_memory"]["enabled"]:
            raise zenoh.ZError("Unable to create SHM segment")

    monkeypatch.setattr(zenoh_session, "_open", opened)
    monkeypatch.setattr(zenoh_session, "can_share_memory", lambda: shared)
    caplog.set_level(logging.INFO)
    zenoh_session.open_session(zenoh_session.base_config(router=True), router=True)
    assert says in reason(caplog)
    assert ("ulimit" in reason(caplog)) is not shared


def test_a_client_says_nothing_of_it(monkeypatch, caplog):
    """`vical watch` of an ordinary user had the line each time, and has nothing to do with images."""
    monkeypatch.setattr(zenoh_session, "_open", lambda config: None)
    monkeypatch.setattr(zenoh_session, "can_share_memory", lambda: False)
    caplog.set_level(logging.INFO)
    zenoh_session.open_session(zenoh_session.base_config())
    assert not caplog.records
