"""Frames keep the exposure that was in force when they began to expose."""

import pytest
from vical_drivers.camera.exposure_stamper import ExposureStamper
from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.stamps import Anchor, RawStamp

MS = 1_000_000


@pytest.mark.parametrize(("began_ms", "exposure_ms"), [(990, 10), (1002, 20), (1030, 5)])
def test_two_changes_while_frames_wait(began_ms, exposure_ms):
    """A frame from before both changes got the exposure between them: 5 ms off."""
    stamper = ExposureStamper(CameraSettings())
    for exposure_ns, t_set_ns in ((10 * MS, 0), (20 * MS, 1000 * MS), (5 * MS, 1010 * MS)):
        stamper.set_exposure(exposure_ns, t_set_ns)
    stamp, exposure_ns = stamper.stamp(RawStamp(began_ms * MS, Anchor.START_OF_EXPOSURE, None, 1000))
    assert exposure_ns == exposure_ms * MS
    assert stamp.t_exposure_mid_ns == began_ms * MS + exposure_ms * MS // 2
