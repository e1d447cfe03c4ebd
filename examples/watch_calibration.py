"""Waits for the calibration of a robot, prints it, then shows every change.

python examples/watch_calibration.py                        # the robot on this machine
python examples/watch_calibration.py tls/robot7:7447        # another one; certificates beside this file
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from vical_daemon import client
from vical_daemon.bus.zenoh_bus import BusError


def main(endpoint: str | None = None) -> int:
    """Show what there is, wait until it has converged, then follow it."""
    here = Path(__file__).parent
    security = {}
    if endpoint and endpoint.startswith("tls/"):
        security = {
            "tls_ca": str(here / "ca.pem"),
            "tls_certificate": str(here / "client.pem"),
            "tls_key": str(here / "client.key"),
        }
    try:
        with client.connect(endpoint, **security) as robot:
            for update in robot.latest():
                print(f"{update.rig}/{update.camera}: {update.estimate.status} {update.estimate.guidance}")
            update = robot.wait_converged(timeout_s=300)
            known = update.known
            print(f"{update.camera}: p_imu_cam {known.T_imu_cam.p_m} m, q_imu_cam {known.T_imu_cam.q_wxyz}")
            print(
                f"t_imu = t_cam + {known.timeshift_cam_imu_s:.6f} s (sigma {known.timeshift_sigma_s:.1e} s)"
            )
            for update in robot.updates():
                print(update.camera, update.estimate.status, *update.announcements, flush=True)
    except (BusError, client.ClientError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(*sys.argv[1:2]))
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # nobody reads any more, as after `| head -3`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
