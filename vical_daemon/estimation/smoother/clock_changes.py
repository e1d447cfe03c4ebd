"""Whether, when and how the relation of the clocks changed: hypotheses about a prior, and their mixture.

At the start of a window the time shift may step and its drift may change: two unknowns, a jump. Jumps are
part of the marginal prior and are estimated as if all had happened. That none happened, or one of them, or
only a step, are conditions on that Gaussian. Their odds follow from how far the jumps lie from zero
(Savage-Dickey density ratio). [Willsky and Jones, "A generalized likelihood ratio approach to the detection
and estimation of jumps in linear systems", 1976; docs/math/target_free.md, (4)]
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.so3 import tangents
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import CLOCK_CHANGES_HZ, OFF, SKEW_SIGMA, STEP_SIGMA_S
from vical_daemon.estimation.model.retract import moved_camera
from vical_daemon.estimation.selection.clock_drift import stamps_variance
from vical_daemon.estimation.smoother.marginal_prior import BIASES, CORE, SPEED, TILT, MarginalPrior, root_of

REMEMBERED = 8
"""Jumps that a carry holds: with ages that double, enough for ten minutes."""
_KINDS = (
    (True, False, False, 0.25 * (1.0 - OFF)),
    (True, False, True, 0.25 * (1.0 - OFF)),
    (False, True, False, 0.5 * (1.0 - OFF)),
    (True, True, False, OFF),
)
"""The time shift steps, its drift changes, within the stretch after the jump; how often."""

Free = Sequence[tuple[int, ...]]
"""Which of the clock's unknowns are not zero, by number; a pair: the second is minus the first."""
Weighed = Sequence[tuple[float, Free]]
"""Hypotheses with probabilities."""


class Clock(NamedTuple):
    """One hypothesis about the clocks.

    The unknowns are the drift before all jumps, then step of the time shift and of its drift at each jump.

    Attributes:
        probability: Of it.
        drifted: There was a drift before all jumps.
        jump: Which jump happened; -1: none.
        step: The time shift stepped then.
        rate: The drift changed then.
        within: The time shift stepped between this jump and the next: that stretch fits no line.
    """

    probability: float
    drifted: bool
    jump: int
    step: bool
    rate: bool
    within: bool

    @property
    def drifts(self) -> bool:
        """The clocks run apart now."""
        return self.drifted or self.rate

    @property
    def changes(self) -> list[tuple[int, ...]]:
        """Unknowns of jumps that are not zero."""
        at = 1 + 2 * self.jump
        if self.within:
            return [(at,), (at + 1, at + 3), (at + 2,)]
        return [(k,) for k, happened in ((at, self.step), (at + 1, self.rate)) if happened]

    @property
    def free(self) -> list[tuple[int, ...]]:
        """All unknowns that are not zero."""
        return [(0,)] * self.drifted + self.changes


def opened(carry: MarginalPrior) -> MarginalPrior:
    """The same for a window before which the relation of the clocks may have changed."""
    shift, skew = carry.layout.camera.timeshift, carry.layout.camera.skew
    if shift is None or skew is None:
        return carry
    P = carry.covariance()
    n = len(P)
    at, new = [shift, skew], [n, n + 1]
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n] = P
    for rows in (at, new):
        for columns in (at, new):
            whole[rows, columns] += np.array([STEP_SIGMA_S, SKEW_SIGMA]) ** 2
    return replace(
        carry,
        root=root_of(whole),
        jumps=np.concatenate([carry.jumps, np.zeros(2)]),
        jump_t_s=(*carry.jump_t_s, carry.t_cam_s),
    )


def what_happened(
    carry: MarginalPrior, factor: float, stamp_sigma_s: float, elapsed_s: float, *, drifting: bool
) -> list[Clock]:
    """What may have happened to the clocks; of all jumps at most one is taken to have happened.

    Args:
        carry: What is known.
        factor: Measured variance over the stated one: by as much the data say less.
        stamp_sigma_s: How well the imu's driver knows its device's clock, s.
        elapsed_s: Length of the data, s.
        drifting: It is known that the clocks run apart.

    Returns:
        With probabilities; empty: the drift is not estimated.
    """
    if carry.layout.camera.skew is None:
        return []
    (u, P), sigma = _unknowns(carry)[1:], _sigmas(carry)
    noise = [stamps_variance(stamp_sigma_s, elapsed_s)]
    for t_s in carry.jump_t_s:
        noise += [stamp_sigma_s**2, stamps_variance(stamp_sigma_s, carry.t_cam_s - t_s)]
    # in units of the prior; information of the data alone, with the noise of the stamps in them
    known, one = np.linalg.inv(P / np.outer(sigma, sigma)), np.eye(len(u))
    data = np.column_stack([known - one, known @ (u / sigma)]) / factor
    data = np.asarray(np.linalg.solve(one + data[:, :-1] * (np.array(noise) / sigma**2), data), np.float64)
    found = [
        Clock(share * either, drifted, jump, step, rate, within)
        for drifted, share in ((False, 1.0 - OFF), (True, OFF))[int(drifting) :]
        for jump, step, rate, within, either in _changes(carry)
    ]
    # likelihood of the data, integrated over what is not zero
    B, C, m = _conditioned(one + data[:, :-1], data[:, -1], [c.free for c in found])
    logs = np.log([c.probability for c in found]) + 0.5 * np.linalg.slogdet(C)[1]
    pairs = np.maximum((B**2).sum(axis=1), 1.0)  # a pair is known to half a variance
    logs += 0.5 * np.log(pairs).sum(axis=1)
    logs += 0.5 * np.einsum("hi,hij,hj->h", m, np.linalg.inv(C), m)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    return [c._replace(probability=float(p)) for c, p in zip(found, weights, strict=True)]


def _sigmas(carry: MarginalPrior) -> FloatArray:
    """Of the clock's unknowns, before all data."""
    return np.array([SKEW_SIGMA, *[STEP_SIGMA_S, SKEW_SIGMA] * len(carry.jump_t_s)])


def _changes(carry: MarginalPrior) -> list[tuple[int, bool, bool, bool, float]]:
    """Jump, what of `_KINDS` happened, and prior probability: the longer the time, the larger."""
    t_s = np.array(carry.jump_t_s)
    times_s = np.diff(t_s, append=carry.t_cam_s)
    shares = np.minimum(CLOCK_CHANGES_HZ * np.maximum(times_s, 1.0), 1.0)
    last = len(shares) - 1
    either = [
        (k, step, rate, within, share * float(p))
        for k, p in enumerate(shares)
        for step, rate, within, share in _KINDS
        if not (within and k == last)
    ]
    return [(-1, False, False, False, 1.0), *either]


def _unknowns(carry: MarginalPrior) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariance of a carry's errors with the clock's unknowns, (d, n); these, (n,); their own, (n, n)."""
    P, m2 = carry.covariance(), len(carry.jumps)
    rows = np.zeros((1 + m2, len(P)))
    rows[0, carry.layout.camera.skew] = 1.0
    rows[0, len(P) - m2 + 1 :: 2] = -1.0  # before all jumps
    rows[1:, len(P) - m2 :] = np.eye(m2)
    u = np.concatenate([[carry.camera.skew - carry.jumps[1::2].sum()], carry.jumps])
    return P @ rows.T, u, rows @ P @ rows.T


def _conditioned(
    information: FloatArray, weighted: FloatArray, free: Sequence[Free]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unknowns if all but a few are zero, for H choices of at most s.

    Args:
        information: Of the unknowns in units of their prior sigmas, shape (n, n).
        weighted: It times their values, shape (n,).
        free: By choice, what is not zero.

    Returns:
        Unknowns by what is not zero (H, n, s), covariances (H, s, s) and values (H, s) of that. Choices of
        fewer than s are filled with numbers that move no unknown: variance one, value zero.
    """
    size = max(1, *(len(x) for x in free))
    B = np.zeros((len(free), len(weighted), size))
    for h, columns in enumerate(free):
        for column, (first, *minus) in enumerate(columns):
            B[h, first, column] = 1.0
            B[h, minus, column] = -1.0
    Bt = np.swapaxes(B, 1, 2)
    filled = np.eye(size) * (np.abs(B).sum(axis=1) == 0.0)[:, None, :]
    C = np.asarray(np.linalg.inv(Bt @ information @ B + filled), dtype=np.float64)
    return B, C, np.asarray(np.matvec(C, Bt @ weighted), dtype=np.float64)


def mixed(carry: MarginalPrior, weighed: Weighed, factor: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Change of the mean (d,) of a carry, and covariance times `factor` (d, d), over hypotheses."""
    (by, u, S), scale = _unknowns(carry), _sigmas(carry)
    information = np.asarray(np.linalg.inv(S / np.outer(scale, scale)), dtype=np.float64)
    B, C, m = _conditioned(information, information @ (u / scale), [free for _, free in weighed])
    p, values = np.array([p for p, _ in weighed]), np.matvec(B, m)
    mean = p @ values
    P = np.tensordot(p, factor * (B @ C @ np.swapaxes(B, 1, 2)), axes=1)
    P += (p[:, None] * values).T @ values - np.outer(mean, mean)
    gain = (by / scale) @ information
    whole = factor * (carry.covariance() - gain @ (by / scale).T) + gain @ P @ gain.T
    return gain @ (mean - u / scale), whole


def over_clocks(
    carry: MarginalPrior, clocks: Sequence[Clock], factor: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """What `mixed` says of all errors but the jumps, shapes (n,) and (n, n)."""
    dx, P = mixed(carry, [(c.probability, c.free) for c in clocks], factor)
    n = carry.layout.size
    return dx[:n], P[:n, :n]


def _without_jumps(carry: MarginalPrior, weighed: Weighed, out: Collection[int]) -> MarginalPrior:
    """A carry without some of its jumps, as the mixture over hypotheses about them."""
    dx, P = mixed(carry, weighed)
    n, layout = carry.layout.size, carry.layout
    left = [k for k in range(len(carry.jump_t_s)) if k not in out]
    own = np.array([2 * k + which for k in left for which in (0, 1)], np.intp)
    keep = np.concatenate([np.arange(n), n + own])
    return replace(
        carry,
        R=carry.R @ so3.exp(tangents(carry.R[2][None])[0] @ dx[TILT]),
        speed=carry.speed + dx[SPEED],
        bias=carry.bias + dx[BIASES],
        camera=moved_camera(carry.camera, layout.camera, dx),
        imu=carry.imu + dx[layout.inertial],
        jumps=(carry.jumps + dx[n:])[own],
        jump_t_s=tuple(carry.jump_t_s[k] for k in left),
        root=root_of(P[np.ix_(keep, keep)]),
    )


def settled(carry: MarginalPrior, clocks: Sequence[Clock]) -> MarginalPrior:
    """A carry without any jumps; whether there was a drift before them is left open."""
    if not carry.jump_t_s:
        return carry
    weighed = [(c.probability, [(0,), *c.changes]) for c in clocks]
    return _without_jumps(carry, weighed, range(len(carry.jump_t_s)))


def stepped_s(carry: MarginalPrior, clock: Clock) -> float:
    """By how much the time shift stepped, s, if a hypothesis is true by which it did."""
    dx, _ = mixed(carry, [(1.0, clock.free)])
    steps_s, drifts = (carry.jumps + dx[carry.layout.size :]).reshape(-1, 2).T
    whole_s = float(steps_s[clock.jump])
    if clock.within:
        t0_s, t1_s = carry.jump_t_s[clock.jump : clock.jump + 2]
        whole_s += float(drifts[clock.jump] * (t1_s - t0_s) + steps_s[clock.jump + 1])
    return whole_s


def forgotten(carry: MarginalPrior, clocks: Sequence[Clock]) -> MarginalPrior:
    """A carry that has room for another jump.

    Of the jumps between the first and the last, the one whose neighbours are nearest for its age is taken
    not to have happened: what speaks for it speaks for its neighbours as well. The most likely jump stays.
    """
    if len(carry.jump_t_s) < REMEMBERED:
        return carry
    t_s = np.array(carry.jump_t_s)
    apart = (t_s[2:] - t_s[:-2]) / (carry.t_cam_s - t_s[1:-1])
    each = np.bincount([c.jump + 1 for c in clocks], [c.probability for c in clocks])[1:]
    likely = int(np.argmax(each)) - 1
    if 0 <= likely < len(apart):
        apart[likely] = np.inf
    out = 1 + int(np.argmin(apart))
    free = [(k,) for k in range(1 + len(carry.jumps)) if k not in (1 + 2 * out, 2 + 2 * out)]
    return _without_jumps(carry, [(1.0, free)], [out])


def compared_by(
    before: MarginalPrior, after: MarginalPrior, change: FloatArray, clocks: Sequence[Clock]
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Change of the calibration by a window, if what most likely happened to the clocks is true.

    Args:
        before: Carried into the window.
        after: Out of it, at the same image.
        change: See `Fit`; with all jumps open.
        clocks: Hypotheses with probabilities, after the window.

    Returns:
        The change of those errors that are not zero then, shape (n,), and their covariances before and after.
    """
    free = [(0,), *max(clocks, key=lambda c: c.probability).changes] if clocks else [(0,)]
    if not len(before.jumps):
        (dx, P), (dy, Q) = ((np.zeros(len(x.root)), x.covariance()) for x in (before, after))
    else:
        (dx, P), (dy, Q) = (mixed(x, [(1.0, free)]) for x in (before, after))
    n = before.layout.size
    kept = np.array([*range(CORE, n), *(n + at - 1 for at, *_ in free if at)], np.intp)
    moved = (change + dy - dx)[kept]
    return moved, (P[np.ix_(kept, kept)], Q[np.ix_(kept, kept)])
