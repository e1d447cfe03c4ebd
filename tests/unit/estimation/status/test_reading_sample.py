"""Data that two calibrations have used are recognised by their readings, whatever their stamps."""

from __future__ import annotations

import numpy as np
import pytest

from vical_daemon.estimation.status.reading_sample import ReadingSample, common_share


def sample(readings: np.ndarray) -> list[int]:
    kept = ReadingSample()
    for row in readings:
        kept.add(row[:3], row[3:])
    return kept.hashes


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_the_share_of_the_shorter_data_that_is_in_the_longer(step: float) -> None:
    readings = np.random.default_rng(1).standard_normal((8000, 6))
    if step:
        readings = np.round(readings / step) * step  # a coarse sensor
    first, second = readings[:4000], readings[4000:]
    for a, b, share in (
        (first, first, 1.0),
        (first, readings, 1.0),
        (readings, second, 1.0),
        (readings, readings[500:1500], 1.0),
        (first, second, 0.0),
        (readings[:6000], readings[3000:], 0.6),
        (readings[:40], readings[:20], 1.0),
    ):
        within = 0.2 if 0.0 < share < 1.0 else 0.0
        assert common_share(sample(a), sample(b)) == pytest.approx(share, abs=within)


def test_rest_of_a_coarse_sensor_is_not_taken_for_common_data() -> None:
    rng = np.random.default_rng(2)
    one, other = (np.round(rng.normal(0.0, 1.0, (3000, 6))) for _ in range(2))
    assert common_share(sample(one), sample(other)) == 0.0


def test_unknown_data_are_not_common() -> None:
    assert common_share([], [1, 2]) == common_share([], []) == 0.0
