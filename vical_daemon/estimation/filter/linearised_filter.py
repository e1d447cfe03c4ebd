"""The filter over its first seconds, linearised about a motion and a calibration that are known roughly.

A linearised Kalman filter: it estimates the errors of a reference, so that its own mean may be as far from
the truth as the prior is wide, and nothing is lost to curvature. [docs/math/filter.md, eq. (21)]
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.image_update import ImageFit, corner_gate
from vical_daemon.estimation.filter.linearise import Image, Linear, by_derivatives, by_small_steps, is_rolling
from vical_daemon.estimation.filter.propagate import Propagated, move_by_derivatives
from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.rates import rates_after
from vical_daemon.estimation.model.retract import difference, orthonormal, retract
from vical_daemon.estimation.model.state import ATTITUDE, POSITION, VELOCITY, State, grp_from_rotation

_SAME_S = 1e-5  # instants less apart are the same


class Instant(NamedTuple):
    """Motion of the reference at one instant.

    Attributes:
        t_s: Instant in the imu's clock, s.
        R: R_world_imu, shape (3, 3).
        p: p_world_imu, m, shape (3,).
        v: v_world_imu, m/s, shape (3,).
    """

    t_s: float
    R: FloatArray
    p: FloatArray
    v: FloatArray


@dataclass(slots=True)
class Derivatives:
    """Those about one reference: a second filter about it has the same.

    Attributes:
        moved: Of the motion over segments, by their end (s).
        views: Of images, by camera and stamp (ns).
    """

    moved: dict[float, Propagated] = field(default_factory=dict)
    views: dict[tuple[str, int], Linear] = field(default_factory=dict)


@dataclass(slots=True)
class LinearisedFilter(CalibrationFilter):
    """A filter whose `state` is the reference about which it is linearised; its mean is stored apart.

    Attributes:
        offset: The mean, as errors of `state`, shape (n,).
        instants: Motion of the reference from here on, in order; between them inertial data carry it.
        known: Derivatives about the reference, as far as they have been worked out.
    """

    offset: FloatArray = field(default_factory=lambda: np.zeros(0))
    instants: list[Instant] = field(default_factory=list)
    known: Derivatives = field(default_factory=Derivatives)

    @classmethod
    def about(
        cls, calibration: State, instants: list[Instant], known: CalibrationFilter, derivatives: Derivatives
    ) -> LinearisedFilter:
        """What `known` knows, linearised about a reference.

        Args:
            calibration: Of the reference; its motion does not count.
            instants: Its motion; the filter begins at the first of them.
            known: A filter with mean and covariance there; is used up.
            derivatives: About this reference, as far as they are known.
        """
        begin, *later = instants
        cameras = {name: replace(camera) for name, camera in calibration.cameras.items()}
        state = replace(
            calibration,
            t_s=begin.t_s,
            R_world_imu=begin.R,
            p_world_imu=begin.p,
            v_world_imu=begin.v,
            cameras=cameras,
        )
        fields_of = {x.name: getattr(known, x.name) for x in fields(known)} | {"state": state}
        offset = difference(known.state, state, known.layout)
        return cls(**fields_of, offset=offset, instants=later, known=derivatives)

    @property
    def mean(self) -> State:
        """The most likely state."""
        return retract(self.state, self.layout, self.offset)

    def plain(self) -> CalibrationFilter:
        """The filter that goes on from the mean."""
        known = {x.name: getattr(self, x.name) for x in fields(CalibrationFilter)}
        out = CalibrationFilter(**known)
        out.step(self.offset)
        return out

    def predict(self, segment: ImuSegment) -> None:
        """Propagate to the end of a segment; the reference goes on from its own instant where it has one."""
        state, d = self.state, self.layout.dynamic
        if len(segment.t_s) < 2 or segment.t_s[-1] <= segment.t_s[0]:
            self.rates = rates_after(state, segment, self.rates)
            return
        end_s = float(segment.t_s[-1])
        if end_s not in self.known.moved:
            self.known.moved[end_s] = move_by_derivatives(state, self.layout, np.eye(d), segment)
        moved = self.known.moved[end_s]
        self.offset[:9] = moved.linear @ self.offset[:d]
        for where in self.layout.cameras.values():
            if where.timeshift is not None and where.skew is not None:
                self.offset[where.timeshift] += moved.seconds * self.offset[where.skew]
        Q = moved.influence.noise(self.imu_noise)
        self._grow(moved._replace(linear=moved.linear @ self.S[:d, :d]), Q)
        self._predict_score(moved, Q)
        state.t_s = end_s
        state.R_world_imu, state.p_world_imu, state.v_world_imu = orthonormal(moved.R), moved.p, moved.v
        while self.instants and self.instants[0].t_s < state.t_s + _SAME_S:
            there = self.instants.pop(0)
            if there.t_s > state.t_s - _SAME_S:
                self._go_on_from(there)
        self.rates = rates_after(state, segment, self.rates)

    def _go_on_from(self, there: Instant) -> None:
        """Take another motion for reference; the mean stays where it is."""
        state = self.state
        self.offset[ATTITUDE] += grp_from_rotation(there.R.T @ state.R_world_imu)
        self.offset[POSITION] += state.p_world_imu - there.p
        self.offset[VELOCITY] += state.v_world_imu - there.v
        state.R_world_imu, state.p_world_imu, state.v_world_imu = there.R, there.p, there.v

    def _linearise(self, image: Image) -> Linear:
        """About the reference; the pixels are those of the mean."""
        views, key = self.known.views, (image.camera, image.t_ns)
        if key not in views:
            rolling = is_rolling(self.state, self.layout, image.camera)
            derive = by_small_steps if rolling else by_derivatives
            views[key] = derive(self.state, self.layout, self.rates, image, self.S)
        lin = views[key]
        z = lin.z + (lin.ways @ (lin.by_error @ self.offset)).reshape(-1, 2)
        return self._with_shared(image, replace(lin, z=z, spread=lin.by_error @ self.S))

    def _belonging(self, image: Image, innovation: FloatArray, lin: Linear) -> BoolArray:  # noqa: ARG002
        """By the reference: it has been adjusted to all images, while the mean may have lost its way."""
        return corner_gate(image, image.uv - self.known.views[image.camera, image.t_ns].z, lin)

    def _misses_gate(self, fit: ImageFit) -> bool:  # noqa: ARG002
        """Corners have been compared with the reference; errors over a hole in the images are no news."""
        return False

    def _arm_score(self, image: Image, lin: Linear, fit: ImageFit) -> FloatArray:
        """See `CalibrationFilter._arm_score`; about an adjusted motion the target's size has no bias.

        The motion fits images and readings alike (total least squares).
        """
        score = CalibrationFilter._arm_score(self, image, lin, fit)
        score[-1] = 0.0
        return score

    def _accept(self, S: FloatArray, dx: FloatArray, camera: str) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002
        """Move the mean; the reference stays."""
        self.S, self.offset = S, self.offset + dx
        return S, S
