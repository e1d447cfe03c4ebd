"""Every `>>>` in a docstring is run: an example that no longer holds is worse than none."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGES = {"vical_daemon": ROOT, "vical_drivers": ROOT / "drivers", "vical_mocks": ROOT / "mocks"}
MODULES = sorted(
    ".".join(path.relative_to(root).with_suffix("").parts)
    for package, root in PACKAGES.items()
    for path in (root / package).rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)


def test_examples_are_found():
    assert {"vical_daemon.cli.info", "vical_drivers.camera.v4l2.abi"} <= set(MODULES)


@pytest.mark.parametrize("module", MODULES)
def test_examples_of_a_module_hold(module):
    assert doctest.testmod(importlib.import_module(module)).failed == 0
