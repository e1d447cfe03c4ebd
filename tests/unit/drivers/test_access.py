"""What a user is advised to do about a device that may not be opened."""

import grp
import os
from types import SimpleNamespace

import pytest
from vical_drivers.access import how_to_open


@pytest.mark.parametrize(
    ("gid", "advice"),
    [(20, "it belongs to group dialout: sudo usermod -aG dialout $USER"), (0, "sudo chmod a+rw /dev/ttyS0")],
)
def test_nobody_is_advised_to_join_group_root(monkeypatch, gid, advice) -> None:
    monkeypatch.setattr(os, "stat", lambda *_, **__: SimpleNamespace(st_gid=gid))
    monkeypatch.setattr(
        grp, "getgrgid", lambda number: SimpleNamespace(gr_name={0: "root", 20: "dialout"}[number])
    )
    said = how_to_open("/dev/ttyS0")
    assert advice in said and "usermod -aG root" not in said


def test_a_group_without_a_name(monkeypatch) -> None:
    """In a container the group of a passed device is often a mere number."""
    monkeypatch.setattr(os, "stat", lambda *_, **__: SimpleNamespace(st_gid=986))
    monkeypatch.setattr(grp, "getgrgid", lambda _number: (_ for _ in ()).throw(KeyError()))
    assert "group dialout" in how_to_open("/dev/ttyUSB0", "dialout")
