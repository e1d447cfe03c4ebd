"""`vical allan INPUT`: noise densities of an IMU from a recording at rest."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.cli.imu_data import EvenSamples
    from vical_daemon.estimation.tools.noise_densities import AllanCurve, NoiseFit

_EPILOG = """\
Leave the IMU alone on a heavy table, warmed up, for two hours or more (four is good), then:

  vical allan still.mcap -o imu.yaml --plots plots

imu.yaml is Kalibr's; `vical calibrate --initial imu.yaml` and the config's imus.NAME.noise take its numbers.
"""
AXES = ("x", "y", "z")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add INPUT and where results go."""
    from vical_daemon.cli.imu_options import add_input

    add_input(parser)
    parser.add_argument("-o", "--output", metavar="F.yaml", help="write Kalibr's imu.yaml to this file")
    parser.add_argument("--plots", metavar="DIR", help="write gyro.png and accel.png to this folder")
    parser.add_argument(
        "--tau-min", type=float, metavar="S",
        help="shortest averaging time used, longer than the sensor's filter (default: 0.1 to 1)",
    )  # fmt: skip
    parser.epilog = _EPILOG
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Analyse and print."""
    from vical_daemon.cli import imu_data
    from vical_daemon.estimation.tools import noise_densities as noise

    if args.tau_min is not None and args.tau_min <= 0:
        raise CliError("--tau-min must be above 0", EXIT_USAGE)
    samples, remark = imu_data.at_rest(imu_data.load(args))
    if remark:
        print(f"vical: warning: {remark}", file=sys.stderr)
    _refuse_constant(args.input, samples)
    curves: dict[str, list[AllanCurve]] = {"gyro": [], "accel": []}
    fits: dict[str, list[NoiseFit]] = {"gyro": [], "accel": []}
    for sensor, signal in (("gyro", samples.gyro_rps), ("accel", samples.accel_mps2)):
        for axis in range(3):
            _progress(args, f"{sensor} {AXES[axis]}")
            curve = noise.allan_curve(signal[:, axis], samples.rate_hz)
            curves[sensor].append(curve)
            fits[sensor].append(noise.fit_noise(curve, args.tau_min))
    _progress(args, "")
    combined = noise.imu_noise(fits["gyro"], fits["accel"], samples.rate_hz)
    if args.output:
        from vical_daemon.results.export.kalibr import write_imu

        length = _length(samples.duration_s)
        note = f"vical allan {Path(args.input).name}: {length} at {samples.rate_hz:.2f} Hz"
        write_output(Path(args.output), write_imu(combined, note=note))
    if args.plots:
        from vical_daemon.cli.allan_plots import write_plots

        write_plots(Path(args.plots), curves, fits)
    if args.json:
        print(json.dumps(_document(samples, fits, curves)))
    else:
        _print_tables(samples, fits)
    return 0


def _progress(args: argparse.Namespace, what: str) -> None:
    if sys.stderr.isatty() and not args.quiet:
        print(f"\r{what:<20}", end="\r" if not what else "", file=sys.stderr, flush=True)


def _refuse_constant(path: str, samples: EvenSamples) -> None:
    """Refuse readings without noise: they have no Allan deviation.

    Raises:
        CliError: A channel never changes.
    """
    import numpy as np

    from vical_daemon.estimation.inertial.units import ImuArrays, constant_channels

    t_ns = np.arange(len(samples.gyro_rps))
    still = constant_channels(ImuArrays(t_ns, samples.gyro_rps, samples.accel_mps2))
    if still:
        raise CliError(f"{path}: {still}")


def _document(
    samples: EvenSamples, fits: dict[str, list[NoiseFit]], curves: dict[str, list[AllanCurve]]
) -> dict[str, Any]:
    """Return the result with SI units in the keys' documentation: see docs/math/allan.md."""
    from dataclasses import asdict

    from vical_daemon.estimation.tools.noise_densities import imu_noise

    axes: dict[str, Any] = {}
    for sensor, sensor_fits in fits.items():
        axes[sensor] = {
            axis: asdict(fit) | {"tau_s": curve.tau_s.tolist(), "adev": curve.adev.tolist(),
                                 "adev_sigma": curve.sigma().tolist()}
            for axis, fit, curve in zip(AXES, sensor_fits, curves[sensor], strict=True)
        }  # fmt: skip
    return {
        "duration_s": samples.duration_s,
        "rate_hz": samples.rate_hz,
        "samples": len(samples.gyro_rps),
        "interpolated": samples.filled,
        "imu_noise": asdict(imu_noise(fits["gyro"], fits["accel"], samples.rate_hz)),
        "axes": axes,
    }


# What a person reads: name, attribute of the fit, then factor and unit for gyro and accelerometer.
_ROWS = (
    (
        "random walk (white noise)",
        "density",
        {"gyro": (3437.74677, "deg/sqrt(h)"), "accel": (60.0, "m/s/sqrt(h)")},
    ),
    ("noise density", "density", {"gyro": (1e6, "urad/s/sqrt(Hz)"), "accel": (101971.621, "ug/sqrt(Hz)")}),
    ("bias instability", "instability", {"gyro": (206264.806, "deg/h"), "accel": (101.971621, "mg")}),
    ("rate random walk", "walk", {"gyro": (1e6, "urad/s^2/sqrt(Hz)"), "accel": (1e6, "um/s^3/sqrt(Hz)")}),
)


def _length(duration_s: float) -> str:
    """Return the length of a recording for people.

    >>> _length(46.1), _length(14400.0)
    ('46 s', '4.00 h')
    """
    return f"{duration_s:.0f} s" if duration_s < 600.0 else f"{duration_s / 3600.0:.2f} h"


def _print_tables(samples: EvenSamples, fits: dict[str, list[NoiseFit]]) -> None:
    print(
        f"{samples.name}: {_length(samples.duration_s)} at {samples.rate_hz:.3f} Hz, "
        f"{len(samples.gyro_rps)} samples"
    )
    for sensor, title in (("gyro", "Gyroscope"), ("accel", "Accelerometer")):
        print(f"\n{title:<27} {'x':>20} {'y':>20} {'z':>20}  unit")
        for name, attribute, units in _ROWS:
            factor, unit = units[sensor]
            cells = [_cell(getattr(f, attribute), factor) for f in fits[sensor]]
            print(f"{name:<27} {cells[0]:>20} {cells[1]:>20} {cells[2]:>20}  {unit}")
        taus = [_where(f) for f in fits[sensor]]
        print(f"{'  lowest point':<27} {taus[0]:>20} {taus[1]:>20} {taus[2]:>20}")
    every = [f for sensor_fits in fits.values() for f in sensor_fits]
    if not all(f.instability_reached for f in every):
        print("\n(end): the curve still falls at its end; bias instability is an upper bound. Record longer.")
    if any(f.walk.value <= f.walk.sigma for f in every):
        print("\n<: too short to show; a one-sigma upper bound.")


def _where(fit: NoiseFit) -> str:
    return f"at {fit.instability_tau_s:.3g} s{'' if fit.instability_reached else ' (end)'}"


def _cell(coefficient: Any, factor: float) -> str:
    value, sigma = factor * coefficient.value, factor * coefficient.sigma
    if value <= sigma:
        return f"< {value + sigma:.3g}"
    return f"{value:.4g} ± {sigma:.2g}"
