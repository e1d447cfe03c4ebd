"""How much of an error is chance: what the best estimator would have made of the same noise.

The bound says how large errors are on average. A hundred recordings have an average of their own, by chance
up to a quarter larger. Here the very noise of each recording goes through the linear equations of the bound:
out comes, to first order, the error of weighted least squares over all data, linearised at the truth, which
reaches the bound: no unbiased estimator is better on average. What vical adds to it is vical's.

    python -m benchmarks luck --case "reference, lens known" --trials 100
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from vical_mocks.cramer_rao.bound import Draw, bounds, frames_of
from vical_mocks.cramer_rao.error_model import STATE, error_slopes, steps_in
from vical_mocks.harness.feed import PARAMETERS
from vical_mocks.points import SimulatedRun, project_points

from benchmarks import runner, scores
from benchmarks.montecarlo import (
    CASES,
    TIMES_S,
    Case,
    bound_options,
    code_under_test,
    make_run,
    results_of,
    vector_of,
)

FloatArray = npt.NDArray[np.float64]


def draw_of(run: SimulatedRun) -> Draw:
    """The noise that a recording was made with, in the form that `bound.bounds` takes it.

    Raises:
        ValueError: It has errors that are no noise of readings or corners.
    """
    options = run.options
    for what in ("stamp_jitter_s", "imu_stamp_jitter_s", "imu_average_s", "accel_lag_s"):
        if getattr(options, what):
            raise ValueError(f"{what} moves what is measured; there is no best estimate to follow with it")
    frames = frames_of(run)
    pixels = []
    for frame in frames:
        points = run.points_m[[run.landmark_of.get(int(i), int(i)) for i in frame.ids]]
        true_px = project_points(run.rig, np.array([frame.t_s]), points)[0][0]
        pixels.append((frame.uv_px - true_px)[~frame.outlier].ravel())
    return Draw(_pushes(run, np.array([frame.t_s for frame in frames])), pixels)


def _pushes(run: SimulatedRun, t_s: FloatArray) -> FloatArray:
    """How far the readings, integrated from the true state of each frame, miss that of the next one."""
    missed, steps = Missed(run), [steps_in(gap_s) for gap_s in np.diff(t_s)]
    middles_s = [begin + h * (np.arange(n) + 0.5) for begin, (h, n) in zip(t_s[:-1], steps, strict=True)]
    slopes = error_slopes(run.rig, np.concatenate(middles_s))[:, :STATE, :STATE]
    each = np.split(slopes, np.cumsum([count for _, count in steps])[:-1])
    return np.array([_push(run, missed, *ends, F) for ends, F in zip(pairwise(t_s), each, strict=True)])


def _push(run: SimulatedRun, missed: Missed, begin_s: float, end_s: float, slopes: FloatArray) -> FloatArray:
    rig, step_s, count = run.rig, *steps_in(end_s - begin_s)
    gathered = np.diff(missed.until(begin_s + step_s * np.arange(count + 1)), axis=0)
    biases = [np.concatenate([b.value(t) for b in (rig.gyro_bias, rig.accel_bias)]) for t in (begin_s, end_s)]
    gathered -= biases[0] * step_s  # the estimator takes them as constant from frame to frame
    off = np.zeros(STATE)
    for F, e in zip(slopes, gathered, strict=True):
        a = F * step_s
        # readings that are too large act as biases that are too small
        off = off + a @ (off + a @ off / 2) - (np.eye(STATE) + a / 2) @ F[:, 9:15] @ e
    off[9:15] = biases[0] - biases[1]
    return off


class Missed:
    """Noise and biases of the readings [gyro 3, accelerometer 3], linear in between."""

    def __init__(self, run: SimulatedRun) -> None:
        self._step_s = 1.0 / run.options.imu_rate_hz
        rig, t_s = run.rig, self._step_s * np.arange(len(run.gyro_rps))
        noise = np.hstack([run.gyro_rps, run.specific_force_mps2]) - np.hstack(rig.imu_reading(t_s))
        self._wrong = noise + np.hstack([rig.gyro_bias.value(t_s), rig.accel_bias.value(t_s)])
        gained = (self._wrong[:-1] + self._wrong[1:]) * (self._step_s / 2)
        self._sums = np.vstack([np.zeros(6), np.cumsum(gained, axis=0)])

    def until(self, t_s: FloatArray) -> FloatArray:
        """Its integral from the start, shape (n, 6)."""
        h, wrong = self._step_s, self._wrong
        i = np.clip((t_s / h).astype(np.int64), 0, len(wrong) - 2)
        u = (t_s - h * i)[:, None]
        return np.asarray(self._sums[i] + u * wrong[i] + (u * u) * (wrong[i + 1] - wrong[i]) / (2 * h))


def luck_trial(case: Case, seconds: float, seed: int) -> runner.Result:
    """Errors of the best estimator at the times of interest."""
    run = make_run(case, seed, seconds)
    times = [t for t in TIMES_S if t <= seconds]
    found = bounds(run, bound_options(case, run), times, draw_of(run))
    return {f"{b.t_s:g}": vector_of(b, b.error) for b in found}


def table(case: Case, key: str, ours: list[runner.Result], best: list[runner.Result]) -> None:
    """Rows of one time: RMSE over the bound, of the best estimator and of vical, and how alike they are."""
    both = [(o["at"][key], b[key]) for o, b in zip(ours, best, strict=True) if o["at"][key] is not None]
    x, y, limit = (
        np.array(rows)[:, : case.dof]
        for rows in zip(*((o["error"], b, o["bound"]) for o, b in both), strict=True)
    )
    best_ratio, ratio, added = (scores.rms(e / limit) for e in (y, x, x - y))
    for i, name in enumerate(PARAMETERS[: case.dof]):
        correlation = np.corrcoef(x[:, i], y[:, i])[0, 1]
        cells = f"{best_ratio[i]:.2f} | {ratio[i]:.2f} | {ratio[i] / best_ratio[i]:.2f} | {added[i]:.2f}"
        print(f"| {key} | {name} | {cells} | {correlation:.3f} |", flush=True)


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks luck", description=__doc__)
    runner.add_arguments(parser, trials=100, seconds=60.0)
    parser.add_argument("--subject", choices=("vical", "ekf"), default="vical")
    args = parser.parse_args(argv)
    code_under_test(args.subject)
    for name in args.case or ["reference, lens known"]:
        if name not in CASES:
            parser.error(f"no case {name!r}; there are: {', '.join(CASES)}")
        case = CASES[name]
        try:
            draw_of(make_run(case, args.first_seed, 1.0))
        except ValueError as error:
            parser.error(f"{name}: {error}")
        ours = results_of(name, case, args.subject, args)
        code = runner.fingerprint("benchmarks/luck.py", "mocks/vical_mocks")
        best = runner.run_trials(
            f"luck_{runner.slug(name)}_{args.seconds:g}s",
            partial(luck_trial, case, args.seconds),
            runner.seeds_of(args),
            args,
            code,
        )
        print(f"\n{name}: RMSE over the bound\n")
        both = f"{args.subject} | {args.subject} over best"
        print(f"| t s | of | best | {both} | their difference over the bound | correlation |")
        print("|---|---|---|---|---|---|---|")
        for t_s in (t for t in TIMES_S if t <= args.seconds):
            table(case, f"{t_s:g}", ours, best)
    return 0
