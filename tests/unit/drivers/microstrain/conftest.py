"""Fixtures of the inertial drivers' tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def vectors() -> Path:
    """Captures of real devices; they are not ours to copy into the repository."""
    folder = Path(__file__).resolve().parents[4].parent / "shared" / "vectors"
    if not folder.is_dir():
        pytest.skip("../shared/vectors (real captures) is not here")
    return folder
