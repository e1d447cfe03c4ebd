"""What is asked of a device: an average that neither overlaps the next nor leaves a gap."""

import pytest
from vical_drivers.microstrain.session import ImuSettings


@pytest.mark.parametrize(("rate_hz", "taps"), [(1000, 1), (500, 2), (333.3, 3), (100, 10), (10, 32)])
def test_an_average_lasts_as_long_as_a_sample(rate_hz, taps):
    assert ImuSettings(rate_hz).taps == taps


def test_what_is_asked_for_is_taken():
    assert ImuSettings(500.0, 15).taps == 15
