"""EuRoC's recording described another way (`benchmarks/symmetries.py`): the answer follows."""

from __future__ import annotations

import pytest
from vical_mocks.harness.recordings import read

from benchmarks.euroc_halves import FOLDER
from benchmarks.euroc_stretches import stretch
from benchmarks.symmetries import answer, differences, views
from vical_daemon.vision.target import load_target

BEGIN_S, SECONDS = 30.0, 12.0
SAME = ["imu: y, z, x", "picture turned by 90 deg"]


def test_the_answer_depends_neither_on_conventions_nor_on_the_direction_of_time():
    if not FOLDER.is_dir():
        pytest.skip(f"no {FOLDER}")
    items = stretch(read(FOLDER), BEGIN_S, SECONDS, 1)
    points_m, of = load_target(FOLDER / "target.yaml").points_m, views()
    found = {
        name: answer(items, of[name], points_m, target_free=False)
        for name in ("as recorded", *SAME, "backwards")
    }
    base = found["as recorded"]
    assert base is not None
    for name in SAME:
        other = found[name]
        assert other is not None and other.status == base.status
        assert differences(other, base).largest_z < 0.4, name  # rounding decides which images a start takes
        assert abs(other.sigmas / base.sigmas - 1.0).max() < 0.1, name
    backwards = found["backwards"]
    assert backwards is not None and differences(backwards, base).largest_z < 2.0
