"""Mechanisms of the calibration with a board, for `benchmarks ablation`."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np

from benchmarks.ablation_patches import (
    DRIFTS,
    HARDLY,
    JUNK,
    KEPT,
    MOVED,
    SMALL,
    STEPS,
    WRONG,
    Mechanism,
    first,
    gives,
    held_at,
    put,
    then,
)
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.filter import calibration_filter, image_update, sensor_intake
from vical_daemon.estimation.filter import snapshot as board_snapshot
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.sensor_intake import ImageIntake
from vical_daemon.estimation.inertial import clipped_readings
from vical_daemon.estimation.inertial.faulty_readings import RangeLimits, SpikeFilter
from vical_daemon.estimation.inertial.imu_intake import ImuIntake
from vical_daemon.estimation.inertial.stamp_steps import StampSteps
from vical_daemon.estimation.init import board_window
from vical_daemon.estimation.init.rig_model import RigModel
from vical_daemon.estimation.model import start_sigmas
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.noise import variance_components
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.noise.lens_agreement import LensAgreement
from vical_daemon.estimation.noise.shared_errors import SharedErrors
from vical_daemon.estimation.selection import clock_drift, model_selection
from vical_daemon.estimation.selection.model_acceptance import ModelAcceptance
from vical_daemon.estimation.status import change_watch
from vical_daemon.estimation.status.change_watch import ChangeWatch, DriftWatch
from vical_daemon.estimation.status.evaluator import SteadyStatus
from vical_daemon.estimation.status.recent_past import RecentPast
from vical_daemon.estimation.status.status_evaluator import StatusEvaluator


def _no_state(block: str) -> Callable[[], list[tuple[Any, ...]]]:
    def drop(self: Any) -> None:
        self._states = (self._states - {block}) | (self._options.estimate & {block})

    return lambda: [first(RigModel, "_lay_out", drop)]


def _ones(self: Any) -> None:
    self.factors = np.ones_like(self.factors)


def _not_moved(self: Any) -> None:
    self.moved = np.zeros_like(self.moved)


def _no_drift() -> list[tuple[Any, ...]]:
    return [
        (start_sigmas, "SKEW_SIGMA", HARDLY * start_sigmas.SKEW_SIGMA),
        (clock_drift, "probability", gives(0.0)),
    ]


def _same(f: CalibrationFilter) -> CalibrationFilter:
    return f


def _always_drift() -> list[tuple[Any, ...]]:
    return [
        (clock_drift, "apart", gives(1.0)),
        (clock_drift, "in_doubt", gives(False)),
        (change_watch, "apart", gives(0.0)),
        (clock_drift, "averaged", _same),
    ]


def _no_watch() -> list[tuple[Any, ...]]:
    drifts = DriftWatch.drifts

    def nothing_seen(self: Any, *args: Any) -> bool:
        drifts(self, *args)  # so that it goes on to ask once a second
        self.doubtful = False
        return False

    return [(DriftWatch, "drifts", nothing_seen)]


def _always_free(f: CalibrationFilter) -> dict[tuple[str, ...], float]:
    held = tuple(name for name, block in model_selection.blocks(f).items() if block.held)
    return {held: 1.0}


def _no_arm_score(self: CalibrationFilter, *_args: Any) -> Any:
    return np.zeros(3 * len(self.layout.cameras))


def _sift(_self: Any, _six: Any, item: Any) -> list[Any]:
    return [item]


def _same_filter(_self: Any, f: CalibrationFilter) -> CalibrationFilter:
    return deepcopy(f)


def _unsteady(self: Any, verdict: Any, _now_s: float) -> Any:
    self.reset(verdict.status)
    return verdict


BOARD: dict[str, Mechanism] = {
    # ------------------------------------------------------------------ the delay moved
    "clock drift": Mechanism(
        MOVED,
        "a state for the drift of the time shift",
        _no_drift,
        faults=("skew 100 ppm", "drift 20 ppm"),
        disturbances=("nothing", DRIFTS, "5 ms"),
    ),
    "clock drift: mixture": Mechanism(
        MOVED,
        "no drift and drift as two hypotheses; without: always a drift",
        _always_drift,
        faults=("skew 100 ppm", "drift 20 ppm"),
        disturbances=("nothing", DRIFTS),
    ),
    "clock drift: driver's sigma": Mechanism(
        MOVED,
        "the imu driver's own uncertainty of its clock counts in the test for a drift",
        lambda: [(clock_drift, "stamps_variance", gives(0.0))],
    ),
    "DriftWatch": Mechanism(
        MOVED,
        "a drift that was constant changes",
        _no_watch,
        faults=("drift 20 ppm",),
        disturbances=("nothing", DRIFTS, "5 ms", "imu stamps +3 ms"),
    ),
    "step of the delay found": Mechanism(
        MOVED,
        "images that do not fit are tried with another delay, all else kept",
        lambda: [(Calibrator, "_part_changed", gives(False))],
        disturbances=("5 ms", "20 ms", "camera clock +0.5 s", "imu clock +0.5 s", "2 deg, 10 mm, 5 ms"),
    ),
    "likelihood of a jump": Mechanism(
        MOVED,
        "what jumped is judged by the innovations of the filter, not by orientations of single images alone",
        lambda: [(Calibrator, "_part_jumped", gives(False))],
        disturbances=("5 ms", "2 deg, 10 mm, 5 ms"),
    ),
    "camera clock set": Mechanism(
        MOVED,
        "the order of arrival shows steps of seconds",
        lambda: [(ImageIntake, "_in_step", gives(True))],
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
        disturbances=JUNK,
    ),
    "gate of residuals": Mechanism(
        WRONG,
        "corners that do not fit after the correction",
        lambda: [(image_update, "_RESIDUAL_GATE", np.inf)],
        faults=("5 % outliers, 30 % half-hidden",),
        disturbances=JUNK,
    ),
    "gate of images": Mechanism(
        WRONG,
        "whole images far from where they are expected",
        lambda: [(CalibrationFilter, "_misses_gate", gives(False))],
        disturbances=(*STEPS, *JUNK[1:3]),
    ),
    "gate of images: level": Mechanism(
        WRONG,
        "the limit of that gate follows the usual level (nis_level)",
        lambda: [(CalibrationFilter, "nis_level", held_at(1.0))],
        disturbances=(*STEPS, *JUNK[1:3]),
    ),
    "refused images counted": Mechanism(
        WRONG,
        "ten refused in a row: pose anew, then calibration anew",
        lambda: [(ChangeWatch, "_refused", held_at({}), True)],
        disturbances=(*STEPS, "bump in a gap of 5 s"),
    ),
    "CUSUM of innovations": Mechanism(
        WRONG,
        "innovations that are larger than usual for some images",
        lambda: [(Consistency, "alarmed", property(gives(False)))],
        disturbances=STEPS,
    ),
    "asked early": Mechanism(
        WRONG,
        "what jumped is asked before images are surely wrong, and again after twice as many",
        lambda: [(ChangeWatch, "_asks", gives(False))],
        disturbances=STEPS,
    ),
    "filter of before a change": Mechanism(
        WRONG,
        "what is kept over a change is the filter of 3 s ago",
        lambda: [(RecentPast, "filter", _same_filter)],
        disturbances=(*KEPT, "20 ms"),
    ),
    "finite state": Mechanism(
        WRONG,
        "numbers that are not finite: start anew",
        lambda: [(CalibrationFilter, "finite", gives(True))],
        disturbances=STEPS,
    ),
    "status: refused or large innovations": Mechanism(
        WRONG,
        "inconsistent while a third is refused, or innovations four times too large",
        lambda: [(StatusEvaluator, "_trouble", gives(""))],
        disturbances=JUNK,
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
        lambda: [(StatusEvaluator, "_doubt", gives(""))],
        faults=("imu 0.3 % off", "crooked board", "drift 20 ppm"),
        disturbances=("nothing", DRIFTS),
    ),
    "imu clipped": Mechanism(
        WRONG,
        "readings at the end of the range",
        lambda: [(RangeLimits, "at_range", gives(()))],
        faults=("gyro clips",),
    ),
    "imu clipped: beyond the range": Mechanism(
        WRONG,
        "a bridged reading may be anything up to twice as far beyond the range",
        lambda: [(clipped_readings, "_EVEN", 0.0)],
        faults=("gyro clips",),
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
        lambda: [(ImuIntake, "_last", held_at(()), True)],
        disturbances=("imu frozen for 1 s",),
    ),
    "images repeated": Mechanism(
        WRONG,
        "a camera that hangs repeats its image",
        lambda: [(sensor_intake, "_same", gives(False))],
        disturbances=("camera frozen for 3 s",),
    ),
    # ------------------------------------------------------------------ sigmas too small
    "corner noise measured": Mechanism(
        SMALL,
        "noise of the corners from residuals that no state explains",
        lambda: [(CornerNoise, "learn", gives(None))],
    ),
    "noise scale": Mechanism(
        SMALL,
        "corners weigh less while innovations are larger than they should be",
        lambda: [(Consistency, "_move_scale", gives(None))],
        faults=("lens model misses",),
    ),
    "noise of each image": Mechanism(
        SMALL,
        "images that motion blurs count less than sharp ones; without: the usual noise of the camera for all",
        lambda: [
            (image_update, "noise_of_image", gives(1.0)),
            (board_window, "noise_of_image", gives(1.0)),
            (calibration_filter, "blurred", gives(1.0)),
        ],
        faults=("corner noise changes",),
    ),
    "blurred images pass the gate": Mechanism(
        SMALL,
        "an image in which most corners fail the gate is asked whether it is blurred",
        lambda: [(calibration_filter, "blurred", gives(1.0))],
        faults=("corner noise changes",),
    ),
    "autocorrelation": Mechanism(
        SMALL,
        "innovations that last for images: variances times the long-run ratio",
        lambda: [then(Consistency, "_remember", put(factor=1.0))],
        faults=("lens model misses",),
    ),
    "lens agreement": Mechanism(
        SMALL,
        "variances of the lens by how much stretches disagree",
        lambda: [then(LensAgreement, "learn", _ones)],
        faults=("lens model misses",),
    ),
    "lens term missing": Mechanism(
        SMALL,
        "sigmas of the lens by what one more power of the radius would move",
        lambda: [then(LensAgreement, "learn", _not_moved)],
        faults=("lens model misses",),
    ),
    "lens floor": Mechanism(
        SMALL,
        "no lens is known better than detectors allow",
        lambda: [(board_snapshot, "lens_limit", gives(0.0))],
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
        "boards that have not the size in their file",
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
        "as specified and not as hypotheses; without: imu, lag, size and shape always unknown",
        lambda: [
            (model_selection, "weights", _always_free),
            (model_selection, "in_doubt", gives("")),
            (ModelAcceptance, "look", gives({})),
        ],
        faults=("imu 0.3 % off", "crooked board", "board 3 % smaller than stated"),
    ),
    "what is off: misfit": Mechanism(
        SMALL,
        "data speak less for it where images do not fit",
        lambda: [(model_selection, "misfit", gives(1.0))],
        faults=("lens held, not this camera's", "lens model misses"),
    ),
    "what is off: accepted": Mechanism(
        SMALL,
        "beyond doubt: announced, and its prior taken back",
        lambda: [(ModelAcceptance, "look", gives({}))],
        faults=("imu 0.3 % off", "crooked board", "board 3 % smaller than stated"),
    ),
    "held lens": Mechanism(
        SMALL,
        "errors of a lens that is held as states",
        lambda: [(FixedLens, "of", staticmethod(gives(None)))],
        faults=("lens held, not this camera's",),
    ),
    "stamp jitter": Mechanism(
        SMALL,
        "late and early images as noise common to all corners",
        lambda: [then(SharedErrors, "_look", put(jitter_s=0.0))],
        faults=("stamp jitter 1 ms",),
    ),
    "shifts of images": Mechanism(
        SMALL,
        "whole images that are off, likewise",
        lambda: [then(SharedErrors, "_look", put(shift_px=0.0))],
        faults=("whole images off by 0.3 px",),
    ),
    "jitter and shifts: may be absent": Mechanism(
        SMALL,
        "half of the prior is on no such error; without: all sizes on the grid are alike, none among them",
        lambda: [(variance_components, "PRESENT", 1.0 - 1.0 / variance_components.SIZE)],
        faults=("stamp jitter 1 ms", "whole images off by 0.3 px", "slow motion"),
    ),
    "lever arms: bias by the gyro": Mechanism(
        SMALL,
        "what noise of the gyro does to lever arms is subtracted",
        lambda: [(CalibrationFilter, "_arm_score", _no_arm_score)],
        faults=("slow motion",),
    ),
    "lever arms: uncertain bias": Mechanism(
        SMALL,
        "sigmas include half of what is subtracted",
        lambda: [(CalibrationFilter, "allowing_for_arm_bias", lambda self: self)],
        faults=("slow motion",),
    ),
}
