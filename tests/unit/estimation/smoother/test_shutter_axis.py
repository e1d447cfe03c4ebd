"""shutter_axis.py: any gain beyond chance is worth an adjustment with columns."""

from types import SimpleNamespace

import pytest

from vical_daemon.estimation.smoother.shutter_axis import shows_columns


@pytest.mark.parametrize(
    ("gain", "misfit", "worth"),
    [(5.0, 1.0, False), (12.0, 1.0, True), (5.0, 0.4, False), (20.0, 4.0, False), (50.0, 4.0, True)],
)
def test_columns_are_tried_where_they_explain_more_than_chance(gain, misfit, worth):
    problem = SimpleNamespace(late_by_columns=lambda seen: gain)
    fit = SimpleNamespace(squares=1000.0 * misfit, dof=1000)
    assert shows_columns(SimpleNamespace(seen=object(), problem=problem), fit) is worth
    assert not shows_columns(SimpleNamespace(seen=None, problem=problem), fit)
