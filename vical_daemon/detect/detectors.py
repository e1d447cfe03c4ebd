"""Creates the detector of a config: for the board, or a tracker of natural features."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from vical_daemon.config.model import Config
from vical_daemon.estimation.measurements import FloatArray, IntArray

if TYPE_CHECKING:
    from vical_daemon.vision.flow_prediction import FlowPredictor

Detect = Callable[[Any, int], "Found | None"]
"""Image and its stamp (ns) -> the points, or None if there are none."""


class Found(Protocol):
    """Points of one image; see `vision.detection.Detection`."""

    @property
    def ids(self) -> IntArray:
        """Point or feature ids, shape (n,)."""
        ...

    @property
    def uv_px(self) -> FloatArray:
        """Pixel coordinates, shape (n, 2)."""
        ...

    @property
    def sigma_px(self) -> FloatArray | None:
        """One-sigma per axis, shape (n,), or None."""
        ...


def make_detector(config: Config, predictor: FlowPredictor | None, report: Callable[[str], None]) -> Detect:
    """Make the detector of one camera; it may keep the last image.

    Args:
        config: The rig.
        predictor: Predicts the flow of natural features; not used with a board.
        report: Called with what images contradict in the target file, one line.

    Raises:
        ConfigError: The target file is missing or wrong.
    """
    if config.calibration.mode == "target_free":
        from vical_daemon.vision.tracks import FeatureTracker

        return FeatureTracker(predictor=predictor).detect
    from vical_daemon.vision.detector import BoardDetector
    from vical_daemon.vision.target import load_target
    from vical_daemon.vision.target_check import TargetCheck

    assert config.target_path is not None  # checked by `config.load`
    target = load_target(config.target_path)
    return BoardDetector(target, check=TargetCheck(target, report)).detect


def board_words(config: Config) -> str:
    """Say which board is looked for; empty: natural features are followed, or the target file is gone."""
    if config.calibration.mode == "target_free" or config.target_path is None:
        return ""
    from vical_daemon.vision.target import AprilGrid, TargetError, load_target

    try:
        target = load_target(config.target_path)
    except TargetError:
        return ""
    if isinstance(target, AprilGrid):
        return f"an AprilGrid with {target.tag_cols} x {target.tag_rows} tags"
    return f"a checkerboard with {target.cols} x {target.rows} inner corners"
