"""`vical imu-calibrate INPUT`: scale, misalignment and biases of the IMU itself."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.imu_options import add_input
from vical_daemon.cli.options import add_json
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.estimation.tools.imu_static import ImuCalibration, SensorCalibration

_EPILOG = """\
Record 20 or more rests of 3 s, each in another position (all six faces, edges, corners), turned by hand in
between, about all axes; wait until the IMU is warm. Then:

  vical imu-calibrate turns.mcap --gravity 9.8067 -o imu_calibration.yaml

corrected = matrix @ (measured - bias). The accelerometer's matrix is lower triangular: imu x is the x
accelerometer's own axis, imu y lies in the plane of its x and y.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add INPUT, gravity and where the result goes."""
    add_input(parser)
    parser.add_argument(
        "--gravity", type=float, default=9.80665, metavar="G",
        help="local gravity, m/s^2 (default 9.80665 +- 0.015); an error becomes accelerometer scale",
    )  # fmt: skip
    parser.add_argument(
        "--min-rest",
        type=float,
        default=1.0,
        metavar="S",
        help="ignore rests shorter than S seconds (default 1)",
    )
    parser.add_argument("-o", "--output", metavar="F.yaml", help="write matrices and biases to this file")
    parser.epilog = _EPILOG
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate and print."""
    if not 9.7 <= args.gravity <= 9.9:
        raise CliError(f"--gravity {args.gravity:g}: between 9.7 and 9.9 m/s^2 on Earth", EXIT_USAGE)
    if args.min_rest <= 0:
        raise CliError("--min-rest must be above 0", EXIT_USAGE)
    from vical_daemon.cli import imu_data
    from vical_daemon.estimation.measurements import gravity_sigma_mps2
    from vical_daemon.estimation.tools.imu_static import calibrate_imu

    samples = imu_data.load(args)
    known = args.gravity, args.min_rest, gravity_sigma_mps2(args.gravity)
    found = calibrate_imu(samples.gyro_rps, samples.accel_mps2, samples.rate_hz, *known)
    document = to_document(found)
    if args.output:
        write_output(Path(args.output), to_yaml(document, f"vical imu-calibrate {Path(args.input).name}"))
    if args.json:
        print(json.dumps(document))
    else:
        print(f"{samples.name}: {found.positions} rests, {found.motions} turns, {samples.duration_s:.0f} s")
        _print_sensor("Accelerometer", found.accel, "mm/s^2")
        _print_sensor("Gyroscope", found.gyro, "mrad/s")
        if not found.gyro_matrix_found:
            print("  scale and misalignment not found: turn it more often, by 60 deg or more, about all axes")
    return 0


def to_document(found: ImuCalibration) -> dict[str, Any]:
    """Return the result as `--json` prints it: SI units, matrices row by row."""
    sensors: dict[str, Any] = {}
    for name, sensor in (("accel", found.accel), ("gyro", found.gyro)):
        sensors[name] = {
            "matrix": sensor.matrix.tolist(),
            "matrix_sigma": sensor.matrix_sigma.tolist(),
            "bias": sensor.bias.tolist(),
            "bias_sigma": sensor.bias_sigma.tolist(),
            "residual_rms": sensor.residual_rms if sensor.residual_rms == sensor.residual_rms else None,
        }
    return {
        "positions": found.positions,
        "motions": found.motions,
        "gyro_matrix_found": found.gyro_matrix_found,
        **sensors,
    }


def to_yaml(document: dict[str, Any], note: str) -> str:
    """Write the result for people and programs; numbers as in `to_document`."""
    from vical_daemon.results.export.text import comment, number, row

    lines = [comment(note), "# corrected = matrix @ (measured - bias); SI units\n"]
    for name in ("accel", "gyro"):
        lines.append(f"{name}:\n")
        for key in ("matrix", "matrix_sigma"):
            lines += [f"  {key}:\n", *(f"    - {row(r)}\n" for r in document[name][key])]
        lines += [f"  {key}: {row(document[name][key])}\n" for key in ("bias", "bias_sigma")]
        if document[name]["residual_rms"] is not None:
            lines.append(f"  residual_rms: {number(document[name]['residual_rms'])}\n")
    return "".join(lines)


def _print_sensor(title: str, sensor: SensorCalibration, unit: str) -> None:
    print(f"\n{title:<16} {'x':>20} {'y':>20} {'z':>20}  unit")
    bias = [f"{1e3 * b:.3f} ± {1e3 * s:.2g}" for b, s in zip(sensor.bias, sensor.bias_sigma, strict=True)]
    print(f"{'bias':<16} {bias[0]:>20} {bias[1]:>20} {bias[2]:>20}  {unit}")
    for i, axis in enumerate("xyz"):
        cells = []
        for j in range(3):
            value = 1e6 * (sensor.matrix[i, j] - (i == j))
            sigma = 1e6 * sensor.matrix_sigma[i, j]
            cells.append(f"{value:+.0f} ± {sigma:.2g}" if sigma else "fixed")
        label = f"matrix - 1, {axis}"
        print(f"{label:<16} {cells[0]:>20} {cells[1]:>20} {cells[2]:>20}  ppm, urad")
    if sensor.residual_rms == sensor.residual_rms:
        print(f"{'residuals':<16} {sensor.residual_rms:>20.2f}{'':>42}  of the noise")
