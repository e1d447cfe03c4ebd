"""Moving the nominal state by a correction, and the covariance with it (reset of an error-state filter).

Errors are small turns and steps about the nominal state. A correction changes what they mean. Two changes
matter here: rotations do not add, and a camera's position depends on the product of a turn and a lever arm.

Images show where a camera is to a few hundredths of a millimetre, while in slow motion lever arm and attitude
may be uncertain by centimetres and milliradians. Attitude, position and lever arm are then strongly
correlated. Had a correction of the attitude not changed their covariance, the next image would contradict it
by the product of both uncertainties, and the filter would take that for information on the lever arm. So
errors are defined such that the position of the camera is linear in them. [docs/math/filter.md, eq. (22)]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model import unscented
from vical_daemon.estimation.model.retract import retract
from vical_daemon.estimation.model.state import ATTITUDE, GRAVITY, POSITION, Layout, State

_TURNED_RAD = 5e-5  # half a turn below which the covariance of a rotation stays
_MOVED = 1e-3  # change of how errors move a camera, over how far they move it, below which it stays


class Reset(NamedTuple):
    """A state after a correction.

    Attributes:
        state: The state.
        S: Upper-triangular square root of its covariance, shape (n, n).
        before: The same by errors of before, but for turns.
        carried: The errors that its columns have become, shape (n, n).
    """

    state: State
    S: FloatArray
    before: FloatArray
    carried: FloatArray


def move(
    state: State, layout: Layout, S: FloatArray, dx: FloatArray, camera: str, jumps: FloatArray | None = None
) -> Reset:
    """Move a state by a correction, and the square root of its covariance with it.

    Args:
        state: Nominal state; not changed.
        layout: Where the errors live.
        S: Square root of the covariance after the correction, by errors of `state`, shape (n, n); used up.
        dx: The correction, shape (n,).
        camera: Whose position is linear in the errors: the one whose image it was.
        jumps: Other columns of errors, changed likewise in place, shape (n, k).
    """
    columns = [S] if jumps is None else [S, jumps]
    before = CameraMoves.of(state, layout, camera)
    for where, T in _turns(state, layout, dx):
        unscented.turn_rows(S, where, T)  # turns the columns, too
        for X in columns[1:]:
            X[where] = T @ X[where]
        if where is ATTITUDE:
            before = before._replace(by_turn=before.by_turn @ np.linalg.inv(T))
    moved = displaced(state, layout, dx, camera)
    after = CameraMoves.of(moved, layout, camera)
    seen = before.by(S)
    more = seen - after.by(S)
    if (np.vecdot(more, more) <= _MOVED**2 * np.vecdot(seen, seen)).all():
        return Reset(moved, S, S, S)
    carried = S.copy()
    columns[0] = carried
    for X in columns:
        X[POSITION] += before.by(X) - after.by(X)
    triangular = carried.copy()
    unscented.grow(triangular, np.zeros((POSITION.stop, 0)))
    return Reset(moved, triangular, S, carried)


def displaced(state: State, layout: Layout, dx: FloatArray, camera: str) -> State:
    """The state moved by errors, shape (n,), of which the position of a camera is linear."""
    before, moved = CameraMoves.of(state, layout, camera), retract(state, layout, dx)
    p_cam = state.p_world_imu + before.arm + before.by(dx)
    moved.p_world_imu = p_cam - moved.R_world_imu @ moved.cameras[camera].p_imu_cam
    return moved


class CameraMoves(NamedTuple):
    """How errors move a camera in the world.

    Attributes:
        arm: Lever arm in the world, m, shape (3,).
        by_turn: Derivative by the attitude, m, shape (3, 3).
        by_arm: Derivative by the lever arm, shape (3, 3).
        where: The errors of the lever arm; None: it is given.
    """

    arm: FloatArray
    by_turn: FloatArray
    by_arm: FloatArray
    where: slice | None

    @classmethod
    def of(cls, state: State, layout: Layout, camera: str) -> CameraMoves:
        """Those about a state."""
        R, arm = state.R_world_imu, state.cameras[camera].p_imu_cam
        return cls(R @ arm, -R @ so3.hat(arm), R, layout.cameras[camera].position)

    def by(self, errors: FloatArray) -> FloatArray:
        """Moves, m, shape (3,) or (3, k), by errors of shape (n,) or (n, k)."""
        out: FloatArray = errors[POSITION] + self.by_turn @ errors[ATTITUDE]
        return out if self.where is None else out + self.by_arm @ errors[self.where]


def _turns(state: State, layout: Layout, dx: FloatArray) -> list[tuple[slice, FloatArray]]:
    """Reset Jacobians of the rotations and of gravity that turn noticeably."""
    turned = [ATTITUDE] + [c.rotation for c in layout.cameras.values() if c.rotation is not None]
    out = []
    for where in turned:
        x, y, z = (0.5 * dx[where]).tolist()
        if max(abs(x), abs(y), abs(z)) > _TURNED_RAD:
            out.append((where, np.array([[1.0, z, -y], [-z, 1.0, x], [y, -x, 1.0]])))
    g = state.gravity
    turn = so3.hat(g) @ dx[GRAVITY] / (g @ g)
    if max(abs(turn)) > 2.0 * _TURNED_RAD:
        out.append((GRAVITY, so3.exp_one(turn)))
    return out
