"""A filter after linear measurements of all its states, and the same in dense matrices."""

from dataclasses import dataclass

import numpy as np
from vical_mocks.points import board_points

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import ImuNoise
from vical_daemon.estimation.model.priors import ENTRY_SIGMA, LAG_SIGMA_S, SIZE_SIGMA
from vical_daemon.estimation.model.retract import retract
from vical_daemon.estimation.model.state import GRAVITY, LOWER, CameraState, State, make_layout
from vical_daemon.estimation.model.unscented import upper_root
from vical_daemon.estimation.noise.consistency import Consistency
from vical_daemon.estimation.noise.corner_noise import CornerNoise
from vical_daemon.estimation.noise.lens_agreement import LensAgreement
from vical_daemon.estimation.selection.model_mixture import not_zero
from vical_daemon.estimation.selection.model_selection import (
    IMU,
    LAG,
    SIZE,
    TARGET,
    weights,
)

NAME = "cam0"


@dataclass
class Dense:
    """Measurements z = H x + noise of states of `prior` sigmas, what they tell, and where the blocks are."""

    H: np.ndarray
    z: np.ndarray
    noise: float
    prior: np.ndarray
    where: dict[str, np.ndarray]

    def posterior(self, prior=None):
        P = np.linalg.inv(np.diag((self.prior if prior is None else prior) ** -2.0) + self.information())
        return P @ self.H.T @ self.z / self.noise**2, P

    def information(self):
        return self.H.T @ self.H / self.noise**2


def off(f, name):
    """Probability that a block of alternative models is not zero."""
    return not_zero(weights(f), name)


def some_filter(imu=1.0, target=0.0, lag=0.0, size=0.0, factor=1.0, scale=1.0):
    """A filter whose imu, target's shape and size, and lag lie so many times half their prior's sigma off."""
    rng = np.random.default_rng(5)
    layout = make_layout(
        {NAME: "radtan"},
        fix=frozenset(),
        estimate=frozenset({IMU, LAG, SIZE, TARGET}),
        target_m=board_points(8, 6, 0.05),
    )
    n = layout.size
    where = {
        IMU: np.arange(layout.gyro_matrix.start, layout.accel_matrix.stop),
        LAG: np.array([layout.accel_lag]),
        SIZE: np.array([layout.target_scale]),
        TARGET: np.arange(layout.target_shape.start, layout.target_shape.stop),
    }
    sigma = np.full(n, 1e-2)
    sigmas = {IMU: ENTRY_SIGMA, LAG: LAG_SIGMA_S, SIZE: SIZE_SIGMA, TARGET: layout.target_modes.sigma_m}
    for name, of_prior in sigmas.items():
        sigma[where[name]] = of_prior
    H, truth, noise = rng.normal(size=(2 * n - 2, n - 1)), np.zeros(n), 8e-3
    by_gravity = np.random.default_rng(6).normal(size=len(H))  # apart: sizes in tests are for the other draws
    H = np.insert(H, GRAVITY.stop - 1, by_gravity, axis=1)
    truth[where[IMU]] = imu * 0.5 * ENTRY_SIGMA * rng.normal(size=15)
    truth[where[TARGET]] = target * 0.5 * layout.target_modes.sigma_m * rng.normal(size=11)
    truth[where[LAG]] = lag * 0.5 * LAG_SIGMA_S
    truth[where[SIZE]] = size * 0.5 * SIZE_SIGMA
    for name in (TARGET, LAG, SIZE):
        H[:, where[name]] *= ENTRY_SIGMA / sigma[where[name][0]]
    dense = Dense(H, H @ truth + noise * rng.normal(size=len(H)), noise, sigma, where)
    x, P = dense.posterior()
    camera = CameraState(
        so3.exp(np.array([0.3, -0.2, 0.9])), np.array([0.03, -0.05, 0.02]), 0.004,
        np.array([460.0, 455.0, 325.0, 238.0]), np.zeros(4), "radtan", (640, 480),
    )  # fmt: skip
    zero = np.zeros(3)
    start = State(1.0, np.eye(3), zero, zero, zero, zero, np.array([0.0, 0, -9.8]), {NAME: camera})
    consistency = Consistency()
    consistency.factor, consistency.scale = factor, scale
    f = CalibrationFilter(
        retract(start, layout, x), layout, upper_root(np.linalg.cholesky(P)), ImuNoise(),
        {NAME: CornerNoise(0.5)}, np.zeros(n), {NAME: consistency}, {NAME: LensAgreement()},
    )  # fmt: skip
    return f, x, P, dense


def imu_entries(state):
    return np.concatenate(
        [(state.gyro_matrix - np.eye(3)).ravel(), (state.accel_matrix - np.eye(3))[*LOWER.T]]
    )
