"""Options that `vical allan` and `vical imu-calibrate` share; imports nothing heavy."""

from __future__ import annotations

import argparse

from vical_daemon.cli.options import add_stretch

COLUMNS = "timestamp [ns], gyro x y z [rad/s], accel x y z [m/s^2] (the ASL/EuRoC order)"


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add INPUT, --imu, --skip and --seconds."""
    parser.add_argument("input", metavar="INPUT", help=f"MCAP, bag, ASL folder, or CSV with {COLUMNS}")
    parser.add_argument("--imu", metavar="NAME", help="which IMU, if the recording has several")
    add_stretch(parser)
