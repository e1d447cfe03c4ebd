"""Mechanisms of the estimation, and how `benchmarks ablation` takes each away: by a patch, not by a switch.

A patch replaces attributes of classes or modules while a study runs. An attribute that no longer exists makes
it fail, so that the study cannot run on without doing anything.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from vical_daemon.estimation import calibrator, target_free
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.filter import image_intake, image_update
from vical_daemon.estimation.filter import snapshot as board_snapshot
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.image_intake import ImageIntake
from vical_daemon.estimation.inertial.faulty_readings import RangeLimits, SpikeFilter
from vical_daemon.estimation.inertial.imu_intake import ImuIntake
from vical_daemon.estimation.inertial.stamp_steps import StampSteps
from vical_daemon.estimation.init import initial_filter
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.noise.lens_agreement import LensAgreement
from vical_daemon.estimation.noise.shared_errors import SharedErrors
from vical_daemon.estimation.selection import clock_drift, model_selection
from vical_daemon.estimation.selection.model_acceptance import ModelAcceptance
from vical_daemon.estimation.smoother import bundle, handover, judge, normal, quality, starter
from vical_daemon.estimation.smoother.bundle import Bundle
from vical_daemon.estimation.smoother.carry import DRIFT
from vical_daemon.estimation.smoother.doubts import TargetFreeDoubts
from vical_daemon.estimation.smoother.jitter import StampOffsets
from vical_daemon.estimation.smoother.judge import TargetFreeStatus
from vical_daemon.estimation.status import change_watch
from vical_daemon.estimation.status.drift_watch import DriftWatch
from vical_daemon.estimation.status.recent_past import RecentPast
from vical_daemon.estimation.status.status_evaluator import StatusEvaluator
from vical_daemon.estimation.status.steady_status import SteadyStatus
from vical_daemon.estimation.target_free import TargetFreeCalibrator

SMALL, WRONG, MOVED = "sigmas too small", "rig or data wrong", "the delay moved"
_NEVER = 10**9
_STEPS = ("nothing", "5 ms", "20 ms", "0.5 deg", "2 deg", "10 mm", "2 deg, 10 mm, 5 ms")
_DRIFTS = "clock drifts by 100 ppm from then on"
_JUNK = ("nothing", "30 % junk corners for 3 s", "all corners junk for 1 s", "2 deg")
_KEPT = ("2 deg", "2 deg, 10 mm, 5 ms", "bump in a gap of 5 s")
_HARDLY = 1e-4  # of a prior sigma: the state exists and stays where it is


class Change(NamedTuple):
    """What to replace.

    Attributes:
        owner: A class or module.
        name: Of its attribute.
        new: The new one.
        of_objects: It is an attribute of the objects of the class, not of the class.
    """

    owner: Any
    name: str
    new: Any
    of_objects: bool = False


@dataclass(frozen=True)
class Mechanism:
    """One mechanism.

    Attributes:
        family: Which question it answers.
        purpose: What it is for.
        changes: Makes the patch.
        free: It belongs to calibration without a target.
        faults: Cases of `ablation_data.FAULTS` that it was made for.
        disturbances: Of `ablation_disturbances.DISTURBANCES`, those that concern it.
    """

    family: str
    purpose: str
    changes: Callable[[], Sequence[tuple[Any, ...]]]
    free: bool = False
    faults: tuple[str, ...] = ()
    disturbances: tuple[str, ...] = ()


@contextmanager
def without(mechanism: Mechanism | None) -> Iterator[None]:
    """The estimation without a mechanism; None: as it is."""
    with ExitStack() as stack:
        for change in mechanism.changes() if mechanism is not None else []:
            owner, name, new, of_objects = Change(*change)
            if of_objects and f"self.{name}" not in inspect.getsource(owner):
                raise AttributeError(f"objects of {owner.__name__} have no {name}")
            stack.enter_context(patch.object(owner, name, new, create=of_objects))
        yield


def _is(value: Any) -> Callable[..., Any]:
    return lambda *_args, **_kwargs: value


def _held_at(value: Any) -> property:
    """An attribute that keeps its value whatever is written."""
    return property(lambda _self: deepcopy(value), lambda _self, _new: None)


def _then(owner: Any, name: str, do: Callable[[Any], None]) -> tuple[Any, str, Any]:
    """The method as it is, and something done to its object afterwards."""
    method = getattr(owner, name)

    @wraps(method)
    def both(self: Any, *args: Any, **kwargs: Any) -> Any:
        result = method(self, *args, **kwargs)
        do(self)
        return result

    return owner, name, both


def _first(owner: Any, name: str, do: Callable[[Any], None]) -> tuple[Any, str, Any]:
    """Something done to the object, then the method as it is."""
    method = getattr(owner, name)

    @wraps(method)
    def both(self: Any, *args: Any, **kwargs: Any) -> Any:
        do(self)
        return method(self, *args, **kwargs)

    return owner, name, both


def _put(**values: Any) -> Callable[[Any], None]:
    def put(self: Any) -> None:
        for name, value in values.items():
            setattr(self, name, value)

    return put


def _no_state(block: str) -> Callable[[], list[tuple[Any, ...]]]:
    def drop(self: Any) -> None:
        self._states = (self._states - {block}) | (self.options.estimate & {block})

    return lambda: [_first(Calibrator, "_lay_out", drop)]


def _ones(self: Any) -> None:
    self.factors = np.ones_like(self.factors)


def _not_moved(self: Any) -> None:
    self.moved = np.zeros_like(self.moved)


def _no_drift() -> list[tuple[Any, ...]]:
    return [
        (initial_filter, "SKEW_SIGMA", _HARDLY * initial_filter.SKEW_SIGMA),
        (clock_drift, "_evidence", _is(0.0)),
    ]


def _always_drift() -> list[tuple[Any, ...]]:
    return [
        (clock_drift, "apart", _is(1.0)),
        (clock_drift, "_evidence", _is(0.0)),
        (change_watch, "surely_apart", _is(False)),
    ]


def _always_free(f: CalibrationFilter) -> dict[tuple[str, ...], float]:
    held = tuple(name for name, block in model_selection.blocks(f).items() if block.held)
    return {held: 1.0}


def _sift(_self: Any, _six: Any, item: Any) -> list[Any]:
    return [item]


def _same_filter(_self: Any, f: CalibrationFilter) -> CalibrationFilter:
    return deepcopy(f)


def _unsteady(self: Any, verdict: Any, _now_s: float) -> Any:
    self.reset(verdict.status)
    return verdict


def _own_factor(self: TargetFreeStatus) -> float:
    return self.factor()


def _agreed() -> list[tuple[Any, ...]]:
    agrees = TargetFreeStatus.agrees

    def always(self: Any, *args: Any, **kwargs: Any) -> bool:
        agrees(self, *args, **kwargs)
        return True

    return [(TargetFreeStatus, "agrees", always)]


def _compared() -> list[tuple[Any, ...]]:
    weighed = TargetFreeDoubts.weighed
    return [
        (
            TargetFreeDoubts,
            "weighed",
            lambda self, carry, factor, _compared: weighed(self, carry, factor, True),
        )
    ]


def _no_free_drift(self: Any) -> None:
    self.active[DRIFT] = False


def _both_blocks(*_args: Any) -> tuple[int, ...]:
    return target_free.BOTH


BOARD: dict[str, Mechanism] = {
    # ------------------------------------------------------------------ the delay moved
    "clock drift": Mechanism(
        MOVED,
        "a state for the drift of the time shift",
        _no_drift,
        faults=("skew 100 ppm", "drift 20 ppm"),
        disturbances=("nothing", _DRIFTS, "5 ms"),
    ),
    "clock drift: mixture": Mechanism(
        MOVED,
        "no drift and drift as two hypotheses; without: always a drift",
        _always_drift,
        faults=("skew 100 ppm", "drift 20 ppm"),
        disturbances=("nothing", _DRIFTS),
    ),
    "clock drift: driver's sigma": Mechanism(
        MOVED,
        "the imu driver's own uncertainty of its clock counts in the test for a drift",
        lambda: [(clock_drift, "stamps_variance", _is(0.0))],
    ),
    "DriftWatch": Mechanism(
        MOVED,
        "a delay that was constant begins to move",
        lambda: [(DriftWatch, "drifts", _is(False))],
        faults=("drift 20 ppm",),
        disturbances=("nothing", _DRIFTS, "5 ms", "imu stamps +3 ms"),
    ),
    "step of the delay found": Mechanism(
        MOVED,
        "images that do not fit are tried with another delay, all else kept",
        lambda: [(Calibrator, "_shift_stepped", _is(False))],
        disturbances=("5 ms", "20 ms", "camera clock +0.5 s", "imu clock +0.5 s", "2 deg, 10 mm, 5 ms"),
    ),
    "camera clock set": Mechanism(
        MOVED,
        "the order of arrival shows steps of seconds",
        lambda: [(ImageIntake, "_in_step", _is(True))],
        disturbances=("camera clock +0.5 s", "camera clock +1 h", "imu clock -1 h"),
    ),
    "imu stamps remapped": Mechanism(
        MOVED,
        "steps of even imu stamps are taken off (StampSteps)",
        lambda: [(StampSteps, "even", lambda _self, t_s: t_s)],
        disturbances=("imu stamps +3 ms",),
    ),
    # ------------------------------------------------------------------ rig or data wrong
    "gate of corners": Mechanism(
        WRONG,
        "corners far from where they are expected",
        lambda: [(image_update, "_CORNER_GATE", np.inf)],
        faults=("5 % outliers, 30 % half-hidden",),
        disturbances=_JUNK,
    ),
    "gate of residuals": Mechanism(
        WRONG,
        "corners that do not fit after the correction",
        lambda: [(image_update, "_RESIDUAL_GATE", np.inf)],
        faults=("5 % outliers, 30 % half-hidden",),
        disturbances=_JUNK,
    ),
    "gate of images": Mechanism(
        WRONG,
        "whole images far from where they are expected",
        lambda: [(CalibrationFilter, "_surprising", _is(False))],
        disturbances=(*_STEPS, *_JUNK[1:3]),
    ),
    "gate of images: level": Mechanism(
        WRONG,
        "the limit of that gate follows the usual level (nis_level)",
        lambda: [(CalibrationFilter, "nis_level", _held_at(1.0))],
        disturbances=(*_STEPS, *_JUNK[1:3]),
    ),
    "refused images counted": Mechanism(
        WRONG,
        "ten refused in a row: pose anew, then calibration anew",
        lambda: [(change_watch, "_REFUSED_POSE", _NEVER), (change_watch, "_REFUSED_CHANGED", _NEVER)],
        disturbances=(*_STEPS, "bump in a gap of 5 s"),
    ),
    "CUSUM of innovations": Mechanism(
        WRONG,
        "innovations that are larger than usual for some images",
        lambda: [(Consistency, "alarmed", property(_is(False)))],
        disturbances=_STEPS,
    ),
    "filter of before a change": Mechanism(
        WRONG,
        "what is kept over a change is the filter of 3 s ago",
        lambda: [(RecentPast, "filter", _same_filter)],
        disturbances=(*_KEPT, "20 ms"),
    ),
    "kept over a change": Mechanism(
        WRONG,
        "lens, imu, target and noise stay known when the mounting has changed",
        lambda: [_first(Calibrator, "_restart", _put(_kept_until_s=np.inf))],
        disturbances=_KEPT,
    ),
    "kept, until proven": Mechanism(
        WRONG,
        "what was kept is given up if images contradict it within 10 s",
        lambda: [(calibrator, "_PROVEN_S", 0.0)],
        disturbances=_KEPT,
    ),
    "plausible state": Mechanism(
        WRONG,
        "a state no rig can have: start anew",
        lambda: [(CalibrationFilter, "plausible", _is(True))],
        disturbances=_STEPS,
    ),
    "status: refused or large innovations": Mechanism(
        WRONG,
        "inconsistent while a third is refused, or innovations four times too large",
        lambda: [(StatusEvaluator, "_trouble", _is(""))],
        disturbances=(*_JUNK, "gyro clips"),
    ),
    "held-back check": Mechanism(
        WRONG,
        "a copy of the filter predicts an image by the imu alone",
        lambda: [(Calibrator, "_ask_held_back", _is(None)), (StatusEvaluator, "_held_back_fine", _is(True))],
        faults=("imu noise told 10 times too small",),
        disturbances=("nothing", "2 deg"),
    ),
    "steady status": Mechanism(
        WRONG,
        "converged stays so over a doubt of 2 s and twice the sigma",
        lambda: [
            (SteadyStatus, "follow", _unsteady),
            (SteadyStatus, "counted", lambda _self, weak: weak),
        ],
        disturbances=("nothing", "30 % junk corners for 3 s"),
    ),
    "status: what may be off": Mechanism(
        WRONG,
        "not converged while data speak for a drift, an imu or a target that is off",
        lambda: [(Calibrator, "_in_doubt", _is(""))],
        faults=("imu 0.3 % off", "crooked board", "drift 20 ppm"),
        disturbances=("nothing", _DRIFTS),
    ),
    "imu clipped": Mechanism(
        WRONG,
        "readings at the end of the range",
        lambda: [(RangeLimits, "clipped", _is(False))],
        disturbances=("gyro clips",),
    ),
    "imu spikes": Mechanism(
        WRONG,
        "single readings that are wrong",
        lambda: [(SpikeFilter, "sift", _sift)],
        disturbances=("spikes of the gyro",),
    ),
    "imu repeated": Mechanism(
        WRONG,
        "a device that hangs repeats its reading",
        lambda: [(ImuIntake, "_last", _held_at(()), True)],
        disturbances=("imu frozen for 1 s",),
    ),
    "images repeated": Mechanism(
        WRONG,
        "a camera that hangs repeats its image",
        lambda: [(image_intake, "_same", _is(False))],
        disturbances=("camera frozen for 3 s",),
    ),
    # ------------------------------------------------------------------ sigmas too small
    "corner noise measured": Mechanism(
        SMALL,
        "noise of the corners from residuals that no state explains",
        lambda: [(CornerNoise, "learn", _is(None))],
    ),
    "noise scale": Mechanism(
        SMALL,
        "corners weigh less while innovations are larger than they should be",
        lambda: [(Consistency, "_move_scale", _is(None))],
        faults=("lens model misses",),
    ),
    "autocorrelation": Mechanism(
        SMALL,
        "innovations that last for images: variances times the long-run ratio",
        lambda: [_then(Consistency, "_remember", _put(factor=1.0))],
        faults=("lens model misses",),
    ),
    "lens agreement": Mechanism(
        SMALL,
        "variances of the lens by how much stretches disagree",
        lambda: [_then(LensAgreement, "learn", _ones)],
        faults=("lens model misses",),
    ),
    "lens term missing": Mechanism(
        SMALL,
        "sigmas of the lens by what one more power of the radius would move",
        lambda: [_then(LensAgreement, "learn", _not_moved)],
        faults=("lens model misses",),
    ),
    "lens floor": Mechanism(
        SMALL,
        "no lens is known better than detectors allow",
        lambda: [(board_snapshot, "lens_limit", _is(0.0))],
        faults=("detector's own error",),
    ),
    "shape of the target": Mechanism(
        SMALL,
        "bent and skew boards as states",
        _no_state(model_selection.TARGET),
        faults=("crooked board", "lens held, not this camera's"),
    ),
    "size of the target": Mechanism(
        SMALL,
        "boards that are not as large as stated",
        _no_state(model_selection.SIZE),
        faults=("board 3 % smaller than stated",),
    ),
    "imu matrices": Mechanism(
        SMALL, "scale and alignment as states", _no_state(model_selection.IMU), faults=("imu 0.3 % off",)
    ),
    "lag of the accelerometer": Mechanism(
        SMALL,
        "the delay between gyro and accelerometer as a state",
        _no_state(model_selection.LAG),
        faults=("accelerometer 0.3 ms late",),
    ),
    "what is off: mixture": Mechanism(
        SMALL,
        "as stated and not as hypotheses; without: imu, lag, size and shape always unknown",
        lambda: [
            (model_selection, "weights", _always_free),
            (model_selection, "in_doubt", _is("")),
            (ModelAcceptance, "look", _is({})),
        ],
        faults=("imu 0.3 % off", "crooked board", "board 3 % smaller than stated"),
    ),
    "what is off: misfit": Mechanism(
        SMALL,
        "data speak less for it where images do not fit",
        lambda: [(model_selection, "misfit", _is(1.0))],
        faults=("lens held, not this camera's", "lens model misses"),
    ),
    "what is off: accepted": Mechanism(
        SMALL,
        "beyond doubt: announced, and its prior taken back",
        lambda: [(ModelAcceptance, "look", _is({}))],
        faults=("imu 0.3 % off", "crooked board", "board 3 % smaller than stated"),
    ),
    "held lens": Mechanism(
        SMALL,
        "errors of a lens that is held as states",
        lambda: [(FixedLens, "of", staticmethod(_is(None)))],
        faults=("lens held, not this camera's",),
    ),
    "held lens: as the data say": Mechanism(
        SMALL,
        "a lens that is held counts as wrong only as far as data speak for it",
        lambda: [(model_selection, "_beyond_prior", lambda shares, _name: shares)],
        faults=("lens held, not this camera's",),
    ),
    "stamp jitter": Mechanism(
        SMALL,
        "late and early images as noise common to all corners",
        lambda: [_then(SharedErrors, "_look", _put(jitter_s=0.0))],
        faults=("stamp jitter 1 ms",),
    ),
    "shifts of images": Mechanism(
        SMALL,
        "whole images that are off, likewise",
        lambda: [_then(SharedErrors, "_look", _put(shift_px=0.0))],
        faults=("whole images off by 0.3 px",),
    ),
    "stamp jitter: paid back": Mechanism(
        SMALL,
        "images used before their jitter was known weighed too much",
        lambda: [(SharedErrors, "owed", _is(0.0))],
        faults=("stamp jitter 1 ms",),
    ),
}

FREE: dict[str, Mechanism] = {
    "free: clock drift": Mechanism(
        MOVED,
        "a state for the drift of the time shift",
        lambda: [_then(TargetFreeCalibrator, "__init__", _no_free_drift)],
        free=True,
        faults=("free: skew 100 ppm",),
        disturbances=("nothing", _DRIFTS),
    ),
    "free: walk of the delay": Mechanism(
        MOVED,
        "the time shift may wander from window to window",
        lambda: [(handover, "_SHIFT_WALK", 0.0)],
        free=True,
        disturbances=("nothing", _DRIFTS),
    ),
    "free: lasting jitter": Mechanism(
        MOVED,
        "late stamps that follow each other: the clock stepped",
        lambda: [(StampOffsets, "lasts", _is(False))],
        free=True,
        disturbances=("5 ms", "20 ms", "camera clock +0.5 s"),
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
            (judge, "_MOST_SIGMA_PX", np.inf),
            (judge, "_MOST_INERTIAL", np.inf),
            (judge, "_MOST_REFUSED", np.inf),
        ],
        free=True,
        faults=("free: 3 % outliers",),
        disturbances=("20 ms", "2 deg", "30 % junk corners for 3 s"),
    ),
    "free: windows fit, links": Mechanism(
        WRONG, "only the links", lambda: [(judge, "_MOST_INERTIAL", np.inf)], free=True
    ),
    "free: windows agree": Mechanism(
        WRONG,
        "a window that contradicts what is known is given up",
        _agreed,
        free=True,
        disturbances=("5 ms", "0.5 deg", "10 mm"),
    ),
    "free: small changes": Mechanism(
        WRONG,
        "where the model fits poorly, a small contradiction is no change",
        lambda: [(judge, "_matters", _is(True))],
        free=True,
        disturbances=("nothing", "5 ms"),
    ),
    "free: tolerant at first": Mechanism(
        WRONG,
        "fifty times the limit in the first four windows",
        lambda: [(judge, "_LEARNING", 0)],
        free=True,
        disturbances=("nothing",),
    ),
    "free: outliers refused": Mechanism(
        WRONG,
        "observations beyond 4.5 sigma",
        lambda: [(Bundle, "_refuse", _is(0))],
        free=True,
        faults=("free: 3 % outliers",),
    ),
    "free: Huber": Mechanism(
        WRONG,
        "large errors weigh less",
        lambda: [(normal, "HUBER", 1e9), (quality, "HUBER", 1e9)],
        free=True,
        faults=("free: 3 % outliers",),
    ),
    "free: windows' scatter": Mechanism(
        SMALL,
        "variances by how much windows disagree",
        lambda: [(TargetFreeStatus, "factor", _is(1.0))],
        free=True,
    ),
    "free: scatter before two windows": Mechanism(
        SMALL,
        "until confirmed, disagreement counts at once and in full",
        lambda: [(TargetFreeStatus, "_reported_factor", _own_factor)],
        free=True,
    ),
    "free: withdrawn answers": Mechanism(
        SMALL,
        "what contradicted answers given up counts, too",
        lambda: [(TargetFreeStatus, "_withdrawn", _held_at([]), True)],
        free=True,
    ),
    "free: pixel errors last": Mechanism(
        SMALL,
        "errors that stay with a feature count once",
        lambda: [(bundle, "correlation", _is(1.0))],
        free=True,
    ),
    "free: stamp jitter": Mechanism(
        SMALL,
        "late and early images as unknowns",
        lambda: [(Bundle, "_doubts_stamps", _is(False))],
        free=True,
        faults=("free: stamp jitter 1 ms",),
    ),
    "free: lag of the accelerometer": Mechanism(
        SMALL,
        "the delay between gyro and accelerometer as an unknown",
        lambda: [(starter, "LAG_SIGMA_S", _HARDLY * starter.LAG_SIGMA_S)],
        free=True,
        faults=("free: accelerometer 0.3 ms late",),
    ),
    "free: imu before comparison": Mechanism(
        SMALL,
        "before windows can be compared the imu is doubted at least by half",
        _compared,
        free=True,
        faults=("free: imu 0.3 % off",),
    ),
}
MECHANISMS: dict[str, Mechanism] = BOARD | FREE
