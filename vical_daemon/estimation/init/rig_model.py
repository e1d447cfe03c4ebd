"""The model of a rig with a target: what is assumed and what is estimated; contradicting data change it."""

from __future__ import annotations

from dataclasses import replace

from vical_daemon.estimation.init.numbering import HalfTurns
from vical_daemon.estimation.init.spacing_ratio import stretched
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, FloatArray
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.state import Layout, State, make_layout
from vical_daemon.estimation.selection import model_selection

_ALWAYS = frozenset(
    {model_selection.IMU, model_selection.LAG, model_selection.SIZE, model_selection.SIZE_EFFECT}
)
"""Always states, whether asked for or not: see `model_selection`."""


class RigModel:
    """Cameras, target and error state.

    Args:
        options: Switches.
        cameras: What is known about each camera.
        target_points_m: Points of the target as in its file, m, shape (n, 3).

    Attributes:
        priors: What is known about each camera.
        target: Points of the target as far as its size is known, m, shape (n, 3).
        size: Of the target over the stated one, where that is far off.
        ratio: Likewise of the distance of its columns over that of its rows.
        layout: Where the errors live.
        silent: Cameras from which nothing comes now: they are not waited for.
        turns: Numbers the points of a target that looks the same upside down.
    """

    def __init__(
        self, options: CalibrationOptions, cameras: dict[str, CameraPrior], target_points_m: FloatArray
    ) -> None:
        self.priors = {name: prior.with_next_term() for name, prior in cameras.items()}
        self.target = target_points_m
        self.size = self.ratio = 1.0
        self.silent: frozenset[str] = frozenset()
        self._stated = target_points_m
        self._options = options
        self.turns = HalfTurns(target_points_m, alike=options.target_alike)
        self._held = self._held_lenses()
        self._states = options.estimate | _ALWAYS
        if "intrinsics" not in options.fix or self._held:  # else a wrong lens would look like a bent target
            self._states |= {model_selection.TARGET}
        self.layout = self._lay_out()

    def _held_lenses(self) -> dict[str, FixedLens]:
        """Lenses whose errors matter to something that is estimated, by camera."""
        fix = self._options.fix
        lenses = {name: FixedLens.considered(prior, fix) for name, prior in self.priors.items()}
        return {name: lens for name, lens in lenses.items() if lens is not None}

    def _lay_out(self) -> Layout:
        models = {name: prior.distortion_model for name, prior in self.priors.items()}
        return make_layout(
            models, fix=self._options.fix, estimate=self._states, target_m=self.target, held=self._held
        )

    def estimate_readout(self, camera: str, axis: str) -> None:
        """A shutter turned out to roll along `axis`: its readout is one more unknown."""
        self._states |= {"readout"}
        self.priors[camera] = replace(self.priors[camera], readout_axis=axis)
        self.layout = self._lay_out()

    def resize(self, size: float) -> None:
        """The target is now taken to be `size` times as large as its file says."""
        self.target, self.size = stretched(self._stated, self.ratio) * size, size
        self.layout = self._lay_out()

    def stretch(self, ratio: float) -> None:
        """Its columns are now taken to be `ratio` times as far apart, compared with its rows, as till now."""
        self.ratio *= ratio
        self.resize(self.size)

    def start_from_lenses_of(self, state: State) -> None:
        """Take the lenses that were estimated as what is known about them."""
        for name, camera in state.cameras.items():
            if self.layout.lens_free(name):
                self.priors[name] = replace(
                    self.priors[name],
                    intrinsics=tuple(camera.intrinsics.tolist()),
                    distortion=tuple(camera.distortion.tolist()),
                )
