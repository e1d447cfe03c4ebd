"""Model selection: do the clocks of camera and IMU drift apart?

Most cameras are stamped by the imu's clock; estimating a drift doubles the sigma of their time shift. Others
have their own crystal, 100 ppm off; without a drift they are ten sigmas wrong after ten seconds.
So the drift is always a state of the filter. No drift is the alternative model: its Gaussian is the filter's
own, conditioned on no drift. Its odds follow from how far the estimated drift lies from zero (Savage-Dickey
density ratio). The published mean and covariance are those of the mixture. [docs/math/filter.md, eq. (16)]
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.priors import OFF, SKEW_SIGMA, SKEW_WALK
from vical_daemon.estimation.model.retract import retract
from vical_daemon.estimation.selection.model_mixture import joined, parts
from vical_daemon.estimation.selection.model_selection import factor, lenses_known
from vical_daemon.estimation.significance import EVERY_S

CLOCKS_IN_DOUBT = "the time shift still moves: waiting to see whether the clocks drift"


def apart(f: CalibrationFilter, camera: str) -> float:
    """Probability that this camera's clock drifts against the imu's; 1 where that was announced."""
    index = f.layout.cameras[camera].skew
    if camera in f.drifting or index is None:
        return float(camera in f.drifting)
    variance = f.consistency[camera].factor * float(f.S[index] @ f.S[index]) + _stamps(f)
    return probability(f.state.cameras[camera].skew, variance)


def probability(skew: float, variance: float) -> float:
    """Return the probability of a drift, by the Bayes factor of a drift against none.

    Args:
        skew: Drift as estimated with a prior of `SKEW_SIGMA`, s/s.
        variance: Of that estimate.
    """
    bayes_factor = float(np.sqrt(variance) / SKEW_SIGMA * np.exp(0.5 * min(skew**2 / variance, 200.0)))
    odds = OFF / (1.0 - OFF) * bayes_factor
    return odds / (1.0 + odds)


def _stamps(f: CalibrationFilter) -> float:
    return stamps_variance(f.stamp_sigma_s, f.state.t_s - f.began_s)


def stamps_variance(stamp_sigma_s: float, elapsed_s: float) -> float:
    """Variance of the drift that errors of the imu's stamps look like, (s/s)^2.

    An error that changes once by one sigma, about halfway, has a slope of two sigmas over the whole time.

    Args:
        stamp_sigma_s: How well the driver knows its device's clock, s.
        elapsed_s: Length of the data, s.
    """
    return (2.0 * stamp_sigma_s / max(elapsed_s, EVERY_S)) ** 2


def in_doubt(f: CalibrationFilter, camera: str, *, believed: bool) -> bool:
    """Whether data speak for a drift that was not announced: nothing to call converged.

    A result that was believed stays so until a drift is more likely than none, as in
    `model_selection.in_doubt`.
    """
    return camera not in f.drifting and apart(f, camera) > (0.5 if believed else OFF)


def let_drift(f: CalibrationFilter, camera: str, *, anew: bool) -> Event:
    """From now on the clock of this camera drifts (`anew`: and not as it did before); the announcement."""
    where = f.layout.cameras[camera]
    assert where.timeshift is not None
    assert where.skew is not None
    f.drifting.add(camera)
    f.walk[where.skew] = max(f.walk[where.skew], SKEW_WALK**2)
    if anew:
        t_s, skew = f.state.t_s, f.state.cameras[camera].skew
        earlier = f.wandered.setdefault(camera, [])  # any: no crystal, but auto-exposure or a network
        walks = [(skew - before) ** 2 / (t_s - before_s) for before_s, before in earlier]
        f.walk[where.skew] = max(f.walk[where.skew], *walks, 0.0)
        earlier.append((t_s, skew))
        f.reopen(where.skew, SKEW_SIGMA)
        f.reopen(where.timeshift, SKEW_SIGMA * 10.0)
    kind = EventKind.CLOCK_WANDER if anew else EventKind.CLOCK_DRIFT
    return Event(kind, camera, float(f.state.cameras[camera].skew), float(np.linalg.norm(f.S[where.skew])))


def averaged(f: CalibrationFilter) -> CalibrationFilter:
    """Return the filter to be reported: mean and covariance over both models, for each camera.

    Args:
        f: As `model_selection.averaged` returns it.
    """
    for name, where in f.layout.cameras.items():
        if where.skew is None or name in f.drifting:
            continue
        over, spread, skew = factor(f), f.consistency[name].factor, f.state.cameras[name].skew
        S, off = parts(f.S, over) if f.layout.held else (f.S, np.zeros(len(f.S)))
        variance = spread * float(S[where.skew] @ S[where.skew]) + _stamps(f)
        p = probability(skew + off[where.skew], variance)
        given = lenses_known(replace(f, S=S))
        step, S, off = mixture(S, off, given, where.skew, skew, p, spread)
        S = joined(S, off, over) if f.layout.held else S
        f = replace(f, state=retract(f.state, f.layout, step), S=S)
    return f


def mixture(
    S: FloatArray, off: FloatArray, given: FloatArray, at: int, skew: float, p: float, factor: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The mixture: with probability `p` what the estimator says, else that conditioned on no drift.

    With k = P e / sigma the column of the drift and z = drift / sigma, conditioning moves the mean by -k z
    and takes k k' off P; the mixture goes (1 - p) of that way, and its covariance is
    P - (1 - p)(1 - p z^2) k k'. What is reported for a fixed lens moves likewise, with k and sigma of the
    covariance given the lens.

    Args:
        S: Square root of the covariance about the mean over all models, shape (n, m).
        off: That mean minus what is reported, shape (n,); zeros where no lens is fixed.
        given: As `S`, where errors of fixed lenses are known.
        at: Place of the drift among the errors.
        skew: Drift as reported, s/s.
        p: Probability of a drift.
        factor: Reported covariance over that of `S`.

    Returns:
        What the reported values move by, shape (n,), and new values of `S` and `off`.
    """
    variance, skew_mean = float(S[at] @ S[at]), skew + off[at]
    gain = S @ S[at] / variance
    less = (1.0 - p) * (1.0 - p * skew_mean**2 / variance / factor)
    mixed: FloatArray = S - (1.0 - np.sqrt(1.0 - less)) * np.outer(gain, S[at])
    step = -(1.0 - p) * skew * (given @ given[at]) / float(given[at] @ given[at])
    return step, mixed, off - (1.0 - p) * skew_mean * gain - step
