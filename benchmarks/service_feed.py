"""A rig for the service study: an IMU on a terminal, and on the bus the corners that a camera sees."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from vical_mocks.live_rig import LiveRig, LiveRigSettings
from vical_mocks.points import board_points

from vical_daemon.bus import topics
from vical_daemon.bus.messages import DiagnosticStatus, Level, encode_diagnostics, encode_points
from vical_daemon.bus.zenoh_bus import BusError, ZenohBus, open_bus
from vical_daemon.service.wall_clock import shared_clock

BOARD = {"kind": "checkerboard", "cols": 8, "rows": 6, "row_spacing_m": 0.05, "col_spacing_m": 0.05}
RATE_HZ = 15.0
CORNER_SIGMA_PX = 0.15


def main(argv: list[str]) -> int:
    """Feed until killed; not a study of its own."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks service_feed", description=__doc__)
    parser.add_argument("--runtime", type=Path, help="runtime directory of the service")
    parser.add_argument("--port", type=Path, help="link to make to the IMU's terminal")
    args = parser.parse_args(argv)
    if args.runtime is None or args.port is None:
        print("used by `python -m benchmarks service`")
        return 0
    with LiveRig(LiveRigSettings(board=BOARD), devices=("imu",)) as rig:
        terminal = Path(rig.port).resolve()
        terminal.chmod(0o666)
        args.port.unlink(missing_ok=True)
        args.port.symlink_to(terminal)
        while True:
            try:
                bus = open_bus(mode="client", socket=args.runtime / "zenoh.sock")
            except BusError:
                time.sleep(0.2)
                continue
            _feed(rig, bus, args.runtime)
            bus.close()


def _feed(rig: LiveRig, bus: ZenohBus, runtime: Path) -> None:
    """Publish corners, and a camera's status, until the router is gone."""
    truth, clock = rig.rig, shared_clock(runtime)
    points = board_points()
    rng = np.random.default_rng(5)
    key, status_key = topics.POINTS.key("rig0", "cam0"), topics.STATUS.key("rig0", "camera")
    number = int((time.monotonic() - rig.t_start_s) * RATE_HZ) + 1
    lonely_s = 0.0
    while lonely_s < 3.0:
        number += 1
        t_s = number / RATE_HZ
        time.sleep(max(0.0, rig.t_start_s + t_s + 0.02 - time.monotonic()))
        uv, seen = truth.lens.project(truth.points_in_camera(t_s, points))
        uv = uv + CORNER_SIGMA_PX * rng.standard_normal(uv.shape)
        stamp_ns = clock.unix_ns(round((rig.t_start_s + float(truth.t_cam(t_s))) * 1e9))
        ids = np.nonzero(seen)[0].astype(np.int64)
        bus.publish(key, encode_points(stamp_ns, "cam0", ids, uv[seen], None, truth.lens.resolution))
        if number % int(RATE_HZ) == 0:
            alive = DiagnosticStatus(Level.OK, "camera/cam0", "simulated", "SIM-1")
            bus.publish(status_key, encode_diagnostics(stamp_ns, "camera_mock", [alive]))
        lonely_s = 0.0 if bus.connected else lonely_s + 1 / RATE_HZ


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
