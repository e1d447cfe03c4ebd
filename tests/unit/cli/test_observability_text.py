"""`vical observability`: what is printed as lost is lost, and nothing else."""

from __future__ import annotations

import numpy as np

from vical_daemon.cli.observability import sigmas
from vical_daemon.estimation.tools.observability import judge

LAYOUT = {"rotation": slice(0, 3), "lever_arm": slice(3, 6), "timeshift": slice(6, 7)}
LEVER = LAYOUT["lever_arm"]


def _judged(lost: np.ndarray):
    """All is known to 0.01 of its unit but for one direction (given in the comparable units)."""
    lost = lost / np.linalg.norm(lost)
    units = judge(np.eye(7), LAYOUT).units
    information = (np.eye(7) - np.outer(lost, lost)) * 1e4
    return judge(information / np.outer(units, units), LAYOUT)


def test_an_unknown_with_a_trace_in_a_lost_direction_is_not_lost() -> None:
    result = _judged(np.array([5e-4, 0, 0, 0.9, 0.4, 0, 5e-4]))
    assert result.rank == 6
    found = sigmas(result)
    assert np.isinf(found[LEVER]).tolist() == [True, True, False]
    others = np.delete(found / result.units, [3, 4])
    assert np.isfinite(others).all()
    # Honest: the trace times what is known of the lost direction without any data.
    np.testing.assert_allclose(others[0], 5e-4 / np.hypot(0.9, 0.4) * 1e3, rtol=1e-2)
    np.testing.assert_allclose(others[1], 0.01, rtol=1e-3)


def test_nothing_is_lost_where_all_is_determined() -> None:
    result = judge(np.eye(7) * 1e10, LAYOUT)
    np.testing.assert_allclose(sigmas(result), 1e-5, rtol=1e-3)
