"""What a rig sends, as the page's tests need it."""

import importlib.util
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def web_feed():
    """The module that feeds a bus with what a rig sends (shared with the system tests)."""
    path = Path(__file__).parents[2] / "system" / "output" / "web_feed.py"
    spec = importlib.util.spec_from_file_location("vical_web_feed", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
