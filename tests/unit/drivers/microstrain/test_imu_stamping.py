"""What the driver says of its samples besides their stamps."""

import pytest
from vical_drivers.microstrain.session import Applied, RawSample
from vical_drivers.microstrain.stamping import SampleStamper

S = 1_000_000_000


def test_the_rate_is_that_of_the_last_seconds() -> None:
    """The mean since the connection said 74 Hz long after a device had changed from 100 to 50 Hz."""
    stamper = SampleStamper(Applied(100.0, 0.0, 43, 62_500.0, 32), 1_000.0)
    t_ns = 1_000 * S
    assert stamper.rate_hz == 100.0
    for rate_hz in (100, 50, 200, 100):
        for _ in range(11 * rate_hz):
            t_ns += S // rate_hz
            stamper.stamp([RawSample(t_ns * 62_500 // S % 2**32, (0.0,) * 3, (0.0,) * 3, t_ns)])
        assert stamper.rate_hz == pytest.approx(rate_hz, rel=1e-3)
