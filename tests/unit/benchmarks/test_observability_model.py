"""Known results of observability from the model itself (Lie derivatives)."""

from itertools import combinations

import numpy as np
import pytest

from benchmarks.observability_model import ModelBlocks, model_rank
from vical_daemon.cli.observability import BLOCKS


def _lost(result):
    """Share of each block in the null space."""
    names = np.array(result.names)
    return {n for n in dict.fromkeys(result.names) if np.linalg.norm(result.null_space[:, names == n]) > 1e-6}


@pytest.mark.parametrize(
    "blocks",
    [
        ModelBlocks(),
        ModelBlocks(intrinsics=True, imu_matrix=True, target_scale=True, gravity="magnitude"),
        ModelBlocks(intrinsics=True, readout=True),
    ],
)
def test_before_a_known_target_everything_is_observable(blocks):
    result = model_rank(blocks)
    assert result.rank == result.unknowns


def test_without_a_target_only_position_and_the_turn_of_the_world_are_free():
    level = model_rank(ModelBlocks(target_free=True, gravity="known"))
    assert level.unknowns - level.rank == 4
    assert _lost(level) == {"attitude", "position", "velocity", "landmark"}
    tilted = model_rank(ModelBlocks(target_free=True, gravity="magnitude"))
    assert tilted.unknowns - tilted.rank == 6
    assert not _lost(tilted) & {"rotation", "lever_arm", "timeshift", "gyro_bias", "accel_bias"}


def test_nor_do_lens_and_imu_errors_without_a_target_add_to_that():
    full = model_rank(
        ModelBlocks(target_free=True, gravity="known", intrinsics=True, imu_matrix=True, points=5), order=10
    )
    assert full.unknowns - full.rank == 4


def test_the_readout_of_rows_is_observable_and_lost_with_the_delay():
    free = model_rank(ModelBlocks(target_free=True, gravity="known", readout=True))
    assert free.unknowns - free.rank == 4 and "readout" not in _lost(free)
    still = model_rank(ModelBlocks(readout=True), "constant")
    assert "timeshift" in _lost(still)


def test_rotation_about_one_axis_loses_the_lever_arm_along_it():
    result = model_rank(ModelBlocks(gravity="magnitude"), "one_axis")
    names = np.array(result.names)
    arm = result.null_space[:, names == "lever_arm"]
    assert result.unknowns - result.rank == 1
    np.testing.assert_allclose(np.abs(arm[0] / np.linalg.norm(arm[0])), [0.36, 0.48, 0.8], atol=1e-6)
    assert not _lost(result) & {"rotation", "timeshift"}


def test_pure_translation_loses_the_lever_arm_and_keeps_the_delay():
    result = model_rank(ModelBlocks(), "translation")
    assert "lever_arm" in _lost(result) and "timeshift" not in _lost(result)


def test_constant_rate_and_velocity_lose_the_delay():
    assert "timeshift" in _lost(model_rank(ModelBlocks(), "constant"))


def test_the_verdict_does_not_depend_on_the_draw():
    assert {model_rank(ModelBlocks(points=4), seed=s, order=10).rank for s in range(2)} == {25}


def test_an_unknown_motion_is_named():
    with pytest.raises(ValueError, match="one_axis"):
        model_rank(ModelBlocks(), "spiral")


@pytest.mark.parametrize("target_free", [False, True])
def test_all_that_can_be_asked_for_is_observable_but_one_scale(target_free):
    blocks = [b for b in BLOCKS if not (target_free and b == "target_scale")]
    gravity, chosen = ("magnitude", 6) if target_free else ("free", 0)  # of the world without a target
    for asked in (c for n in range(len(blocks) + 1) for c in combinations(blocks, n)):
        result = model_rank(
            ModelBlocks(**dict.fromkeys(asked, True), target_free=target_free, gravity=gravity)
        )
        lost = int({"imu_matrix", "target_scale"} <= set(asked))
        assert result.unknowns - result.rank == chosen + lost, asked
