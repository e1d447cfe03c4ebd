"""Fixtures of the bus tests."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def rng_bus() -> np.random.Generator:
    return np.random.default_rng(20261121)
