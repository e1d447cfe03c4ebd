"""Layouts of the errors of a window, as tests of its parts need them."""

from vical_daemon.estimation.model.state import make_layout
from vical_daemon.estimation.smoother.marginal_prior import CORE

NAME = "cam0"
ALL = ("imu_intrinsics", "accel_lag", "readout")


def window_layout(model="radtan", *, fix=(), estimate=ALL):
    """One camera; by default all is estimated that the target-free calibration estimates."""
    return make_layout({NAME: model}, fix=frozenset(fix), estimate=frozenset(estimate), core=CORE)


POSE_AND_CLOCK = window_layout(fix=("intrinsics",), estimate=())
