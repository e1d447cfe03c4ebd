"""Mechanisms of the calibration without a board, for `benchmarks ablation`."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.ablation_patches import (
    DRIFTS,
    HARDLY,
    MOVED,
    SMALL,
    WRONG,
    Mechanism,
    gives,
    put,
    then,
)
from vical_daemon.estimation import target_free
from vical_daemon.estimation.model import start_sigmas
from vical_daemon.estimation.noise.lens_limit import LensMisfit
from vical_daemon.estimation.smoother import (
    alternative_models,
    bundle,
    clock_changes,
    first_window,
    marginal_prior,
    normal,
    target_free_status,
)
from vical_daemon.estimation.smoother.alternative_models import AlternativeModels
from vical_daemon.estimation.smoother.bundle import Bundle
from vical_daemon.estimation.smoother.target_free_status import TargetFreeStatus


def _own_factor(self: TargetFreeStatus) -> float:
    return self.factor()


def _agreed() -> list[tuple[Any, ...]]:
    agrees = TargetFreeStatus.agrees

    def always(self: Any, *args: Any, **kwargs: Any) -> bool:
        agrees(self, *args, **kwargs)
        return True

    return [(TargetFreeStatus, "agrees", always)]


def _compared() -> list[tuple[Any, ...]]:
    weighed = AlternativeModels.weighed
    return [
        (
            AlternativeModels,
            "weighed",
            lambda self, carry, factor, _compared: weighed(self, carry, factor, True),
        )
    ]


def _both_blocks(*args: Any) -> tuple[int, ...]:
    layout = args[3]
    return target_free.mounting(layout) + target_free.clock(layout)


def _as_it_is(carry: Any) -> Any:
    return carry


_FAULTS = (
    "free: skew 100 ppm",
    "free: stamp jitter 1 ms",
    "free: 3 % outliers",
    "free: accelerometer 0.3 ms late",
    "free: imu 0.3 % off",
)
_CHANGES = ("nothing", DRIFTS, "5 ms", "20 ms", "0.5 deg", "2 deg", "camera clock +0.5 s")
_RULE: dict[str, Any] = {"free": True, "faults": _FAULTS, "disturbances": _CHANGES}

FREE: dict[str, Mechanism] = {
    "free: clock drift": Mechanism(
        MOVED,
        "a state for the drift of the time shift",
        lambda: [(start_sigmas, "SKEW_SIGMA", HARDLY * start_sigmas.SKEW_SIGMA)],
        free=True,
        faults=("free: skew 100 ppm",),
        disturbances=("nothing", DRIFTS),
    ),
    "free: clocks that change": Mechanism(
        MOVED,
        "before each window the time shift may step and its drift may change",
        lambda: [(target_free, "opened", _as_it_is)],
        free=True,
        faults=("free: skew 100 ppm",),
        disturbances=("nothing", DRIFTS, "5 ms"),
    ),
    "free: step within a stretch": Mechanism(
        MOVED,
        "a step between two boundaries is a hypothesis of its own",
        lambda: [(clock_changes, "_KINDS", clock_changes._KINDS[:2] + clock_changes._KINDS[3:])],
        free=True,
        disturbances=("nothing", DRIFTS, "5 ms", "20 ms"),
    ),
    "free: eight jumps": Mechanism(
        MOVED,
        "of the clocks at boundaries between windows; without: three",
        lambda: [(clock_changes, "REMEMBERED", 3)],
        free=True,
        faults=("free: skew 100 ppm",),
        disturbances=("nothing", DRIFTS, "5 ms", "20 ms"),
    ),
    "free: changes ten times as often": Mechanism(
        MOVED,
        "one change of the clocks an hour; without: ten",
        lambda: [(clock_changes, "CLOCK_CHANGES_HZ", 10.0 * clock_changes.CLOCK_CHANGES_HZ)],
        free=True,
        faults=("free: skew 100 ppm",),
        disturbances=("nothing", DRIFTS, "5 ms", "20 ms"),
    ),
    "free: changes a tenth as often": Mechanism(
        MOVED,
        "one change of the clocks an hour; without: one in ten hours",
        lambda: [(clock_changes, "CLOCK_CHANGES_HZ", 0.1 * clock_changes.CLOCK_CHANGES_HZ)],
        free=True,
        faults=("free: skew 100 ppm",),
        disturbances=("nothing", DRIFTS, "5 ms", "20 ms"),
    ),
    "free: windows show": Mechanism(
        MOVED,
        "a change is decided when two windows follow it",
        lambda: [(alternative_models, "_WINDOWS_SHOW", 0)],
        free=True,
        faults=("free: skew 100 ppm",),
        disturbances=("nothing", DRIFTS, "5 ms", "20 ms"),
    ),
    "free: own lens": Mechanism(
        SMALL,
        "each window has a lens of its own about the common one",
        lambda: [then(normal.Problem, "__init__", put(own=0))],
        **_RULE,
    ),
    "free: own lens, size": Mechanism(
        SMALL,
        "how far it may be from the common one is measured",
        lambda: [(LensMisfit, "learn", gives(None))],
        **_RULE,
    ),
    "free: own lens, where seen": Mechanism(
        SMALL,
        "patches without features do not count",
        lambda: [(normal, "patches_seen", gives(None))],
        **_RULE,
    ),
    "free: parallax": Mechanism(
        WRONG,
        "windows whose rays hardly cross are given up",
        lambda: [(target_free, "LEAST_PARALLAX", 0.0), (first_window, "LEAST_PARALLAX", 0.0)],
        **_RULE,
    ),
    "free: walk of the delay": Mechanism(
        MOVED,
        "the time shift may wander from window to window",
        lambda: [(marginal_prior, "SHIFT_WALK", 0.0)],
        **_RULE,
    ),
    "free: what has changed": Mechanism(
        MOVED,
        "mounting and clock tested apart; without: both are new",
        lambda: [(target_free, "changed_blocks", _both_blocks)],
        free=True,
        disturbances=("5 ms", "20 ms", "2 deg"),
    ),
    "free: windows fit": Mechanism(
        WRONG,
        "noise, links and refused features of a window",
        lambda: [
            (target_free_status, "_MOST_SIGMA_PX", np.inf),
            (target_free_status, "_MOST_INERTIAL", np.inf),
            (target_free_status, "_MOST_REFUSED", np.inf),
        ],
        free=True,
        faults=("free: 3 % outliers",),
        disturbances=("20 ms", "2 deg", "30 % junk corners for 3 s"),
    ),
    "free: windows fit, links": Mechanism(
        WRONG, "only the links", lambda: [(target_free_status, "_MOST_INERTIAL", np.inf)], **_RULE
    ),
    "free: windows agree": Mechanism(
        WRONG,
        "a window that contradicts what is known is given up",
        _agreed,
        free=True,
        disturbances=("5 ms", "0.5 deg", "10 mm"),
    ),
    "free: tolerant at first": Mechanism(
        WRONG,
        "fifty times the limit in the first four windows",
        lambda: [(target_free_status, "_LEARNING", 0)],
        **_RULE,
    ),
    "free: outliers refused": Mechanism(
        WRONG,
        "observations beyond 4.7 sigma",
        lambda: [(Bundle, "_refuse", gives(0))],
        free=True,
        faults=("free: 3 % outliers",),
    ),
    "free: Huber": Mechanism(
        WRONG,
        "large errors weigh less",
        lambda: [(normal, "HUBER", 1e9), (bundle, "HUBER", 1e9)],
        free=True,
        faults=("free: 3 % outliers",),
    ),
    "free: windows' scatter": Mechanism(
        SMALL,
        "variances by how much windows disagree",
        lambda: [(TargetFreeStatus, "factor", gives(1.0))],
        free=True,
    ),
    "free: scatter before two windows": Mechanism(
        SMALL,
        "until confirmed, disagreement counts at once and in full",
        lambda: [(TargetFreeStatus, "_reported_factor", _own_factor)],
        **_RULE,
    ),
    "free: pixel errors last": Mechanism(
        SMALL,
        "errors that stay with a feature count once",
        lambda: [(bundle, "correlation", gives(1.0))],
        free=True,
    ),
    "free: late and shifted images": Mechanism(
        SMALL,
        "by how much each image is late or shifted, as unknowns",
        lambda: [(Bundle, "_suspects_offsets", gives(False))],
        free=True,
        faults=("free: stamp jitter 1 ms",),
    ),
    "free: lag of the accelerometer": Mechanism(
        SMALL,
        "the delay between gyro and accelerometer as an unknown",
        lambda: [(start_sigmas, "LAG_SIGMA_S", HARDLY * start_sigmas.LAG_SIGMA_S)],
        free=True,
        faults=("free: accelerometer 0.3 ms late",),
    ),
    "free: imu before comparison": Mechanism(
        SMALL,
        "before windows can be compared the imu is doubted at least by half",
        _compared,
        **_RULE,
    ),
}
