"""`vical observability INPUT`: what the motion of a recording can determine, and what motion is missing."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import RECORDING, add_json, warn

if TYPE_CHECKING:
    from vical_daemon.estimation.guidance import WeakDirection
    from vical_daemon.estimation.measurements import FloatArray
    from vical_daemon.estimation.tools.observability import Motion, Observability, Setup

BLOCKS = ("intrinsics", "imu_matrix", "target_scale", "readout")


_EPILOG = """\
example:
  vical observability log.mcap --target target.yaml
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument("input", metavar="INPUT", help=RECORDING)
    parser.add_argument("--target", metavar="FILE", help="target file of the board, Kalibr's format")
    parser.add_argument("--initial", metavar="FILE", help="Kalibr's files with prior values")
    parser.add_argument("--camera", metavar="NAME", help="which camera, if there are several")
    parser.add_argument("--imu", metavar="NAME", help="which IMU, if there are several")
    parser.add_argument(
        "--estimate",
        metavar="WHAT",
        default="",
        help=f"comma-separated, further unknowns: {', '.join(BLOCKS)}",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Judge and print."""
    blocks = [word.strip() for word in args.estimate.split(",") if word.strip()]
    for word in blocks:
        if word not in BLOCKS:
            raise CliError(f"--estimate: {word!r} is not known (known: {', '.join(BLOCKS)})", EXIT_USAGE)
    if not Path(args.input).exists():
        raise CliError(f"{args.input} does not exist; check the path")
    from vical_daemon.config.priors import Initial, read_initial
    from vical_daemon.estimation.tools.observability import gramian
    from vical_daemon.offline.observability_motion import motion_of

    motion, setup, frames = motion_of(
        args.input,
        frozenset(blocks),
        target=args.target,
        initial=read_initial(args.initial) if args.initial else Initial(),
        camera=args.camera,
        imu=args.imu,
        warn=warn,
    )
    result = gramian(motion, setup, frames)
    missing = _missing(result, motion, setup)
    document = _document(result, motion, missing, _allowed(result, blocks), len(frames))
    if args.json:
        print(json.dumps(document))
    else:
        _print(document, missing)
    if missing:
        from vical_daemon.estimation.wording import direction_line

        print(f"vical: warning: {'; '.join(direction_line(m) for m in missing)}", file=sys.stderr)
    return 0


def _missing(result: Observability, motion: Motion, setup: Setup) -> list[WeakDirection]:
    """What is missing, from the bound with next to no prior."""
    import numpy as np

    from vical_daemon.estimation.status.excitation import RunningMotion, weak_directions
    from vical_daemon.estimation.tools.observability import covariance_of

    covariance = covariance_of(result, _PRIOR)
    order = [result.blocks[name] for name in ("lever_arm", "rotation", "timeshift")]
    index = np.concatenate([np.arange(s.start, s.stop) for s in order])
    turning = RunningMotion(memory_s=1e6)  # all of it
    for t, rate in zip(motion.t_s, motion.rate_rps, strict=True):
        turning.add(float(t), rate)
    part = covariance[np.ix_(index, index)]
    sigma_s = float(np.sqrt(part[6, 6]))
    return weak_directions(part[:6, :6], setup.R_imu_cam, sigma_s, turning)


_PRIOR = 1e3  # of `covariance_of`: ten metres, a radian, a second: next to no knowledge
_LOST_SHARE = 0.1  # of the prior: an unknown that keeps so much of it was not determined


def sigmas(result: Observability) -> FloatArray:
    """Bound on the standard deviation of each unknown, infinite for what the motion did not determine.

    A lost direction has a trace of every unknown in it, of rounding and of noise. So what counts is how much
    of a prior of next to nothing is left, not whether an unknown has any part in such a direction.
    """
    import numpy as np

    from vical_daemon.estimation.tools.observability import covariance_of

    sigma = np.sqrt(np.diag(covariance_of(result, _PRIOR)))
    return np.where(sigma > _LOST_SHARE * _PRIOR * result.units, np.inf, sigma)


def _allowed(result: Observability, blocks: Sequence[str]) -> int:
    """How many of the unknowns any motion can determine: the rank of the model's Lie derivatives.

    All of them, but for one where the scale of the accelerometer and the size of the board may both be off.
    [docs/math/observability.md; `tests/unit/benchmarks/test_observability_model.py`]
    """
    return result.unknowns - ({"imu_matrix", "target_scale"} <= set(blocks))


def _document(
    result: Observability, motion: Motion, missing: list[WeakDirection], allowed: int, frames: int
) -> dict[str, Any]:
    import numpy as np

    from vical_daemon.estimation.wording import axis_name, guidance_document, guidance_text

    bounds = sigmas(result)

    def sigma(block: str) -> list[float | None]:
        return [float(v) if np.isfinite(v) else None for v in bounds[result.blocks[block]]]

    rates = np.sqrt(np.mean(motion.rate_rps**2, axis=0))
    return {
        "rank": result.rank,
        "unknowns": result.unknowns,
        "observable": result.rank == result.unknowns and not missing,
        "sigma": {
            name: sigma(name) for name in result.blocks if name not in ("attitude", "position", "velocity")
        },
        "lost": [{"parts": dict(d.parts), "strength": d.strength} for d in result.lost],
        "missing": [
            {
                "block": str(m.block),
                "direction": axis_name(m.axis_cam) if any(m.axis_cam) else "",
                "axis_cam": list(m.axis_cam),
                "sigma": m.sigma,
                "advice": guidance_text(m.guidance),
                "guidance": guidance_document(m.guidance),
            }
            for m in missing
        ],
        "rate_rms_rps": rates.tolist(),
        "seconds": float(motion.t_s[-1] - motion.t_s[0]),
        "frames": frames,
        "model": {"rank": allowed, "unknowns": result.unknowns},
    }


def _print(document: dict[str, Any], missing: list[WeakDirection]) -> None:
    from vical_daemon.estimation.wording import direction_line

    print(
        f"{document['rank']} of {document['unknowns']} unknowns observable in {document['seconds']:.0f} s, "
        f"{document['frames']} frames (best motion: {document['model']['rank']} "
        f"of {document['model']['unknowns']})"
    )
    units = {
        "lever_arm": (1e3, "mm"),
        "rotation": (57.29578, "deg"),
        "timeshift": (1e3, "ms"),
        "gyro_bias": (57.29578, "deg/s"),
        "accel_bias": (1.0, "m/s^2"),
        "gravity": (1.0, "m/s^2"),
        "intrinsics": (1.0, "px"),
        "readout": (1e3, "ms"),
    }
    print("lower bound on sigmas, for a perfect IMU:")
    for name, values in document["sigma"].items():
        factor, unit = units.get(name, (1.0, ""))
        words = "  ".join("lost" if v is None else f"{factor * v:.2g}" for v in values)
        print(f"  {name:13s} {words} {unit}")
    for lost in document["lost"]:
        parts = ", ".join(f"{name} {share:.2f}" for name, share in lost["parts"].items())
        print(f"  lost direction: {parts}")
    for item in missing:
        print(f"missing: {direction_line(item)}")
