"""Reads a recording with vical: rates, the first inertial samples, points per image."""

from __future__ import annotations

import sys

from vical_daemon.logs import RecordingError, open_recording


def main(path: str) -> None:
    """Print what a recording holds (MCAP, ROS 1 or 2 bag, ASL folder)."""
    recording = open_recording(path)
    for stream in recording.streams:
        print(f"{stream.name}: {stream.kind}, {stream.count} messages, {stream.rate_hz:.1f} Hz")
    name = next(iter(recording.imus))
    samples = recording.imu_arrays(name)
    print(
        f"{name}: first rate {samples.gyro_rps[0]} rad/s, first force {samples.specific_force_mps2[0]} m/s^2"
    )
    for camera, stream in recording.cameras.items():
        if stream.kind in ("points", "tracks"):
            counts = [len(frame.ids) for frame in recording.points_frames(camera)]
            print(f"{camera}: {sum(counts) / len(counts):.1f} points per image")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: read_recording.py RECORDING")
    try:
        main(sys.argv[1])
    except RecordingError as error:
        sys.exit(str(error))
