"""Films and readings for `live_load`, and the process that plays them through the roles of `acquire`."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from vical_drivers.camera.statistics import FrameStatistics
from vical_drivers.closing import Closing
from vical_drivers.samples import DeviceInfo, Frame, ImuSample, SourceStats

if TYPE_CHECKING:
    from benchmarks.live_load import Case

EXPOSURE_S, READOUT_S = 0.001, 0.008
"""Of the simulated cameras; a picture is there this long after its exposure."""
SEED = 7
IMU_RATE_HZ = 200.0


def make_film(case: Case, folder: Path) -> None:
    """Write pictures (n, height, width), their stamps (ns), and readings [ns, 6] into `folder`."""
    from vical_mocks.camera import CameraSettings, SimulatedCamera
    from vical_mocks.harness.boards import APRILGRID, DISTORTION, rig_before
    from vical_mocks.lens import Lens
    from vical_mocks.points import simulate
    from vical_mocks.rig import reference_rig
    from vical_mocks.room import RoomCamera

    width, height = case.size
    focal = 520.0 * width / 640
    lens = Lens((focal, focal, width / 2, height / 2), DISTORTION, case.size)
    rig = rig_before(APRILGRID, 0.8, SEED) if case.board else reference_rig(SEED, lens=lens)
    run = simulate(
        SEED, case.seconds, rig=rig, points_m=APRILGRID.points_m, camera_rate_hz=case.rate_hz,
        imu_rate_hz=IMU_RATE_HZ, epoch_ns=0,
    )  # fmt: skip
    settings = CameraSettings(exposure_s=EXPOSURE_S, max_subframes=4)
    film: Any = (
        SimulatedCamera(APRILGRID, lens, rig.camera_pose_target, settings, SEED)
        if case.board
        else RoomCamera(lens, rig.camera_pose_target, exposure_s=EXPOSURE_S, seed=SEED)
    )
    pictures = np.lib.format.open_memmap(
        folder / "film.npy", mode="w+", dtype=np.uint8, shape=(len(run.frames), height, width)
    )
    for k, frame in enumerate(run.frames):
        pictures[k] = film.render(frame.t_s)
    pictures.flush()
    np.save(folder / "stamps.npy", np.array([f.t_cam_ns for f in run.frames]))
    np.savez(folder / "imu.npz", t_ns=run.t_imu_ns, gyro=run.gyro_rps, force=run.specific_force_mps2)
    (folder / "target.yaml").write_text(APRILGRID.to_yaml())


class _Player(Closing):
    """Base of the stand-ins: waits for the film to begin, and for each sample's time.

    Args:
        go: Exists once the film may begin.
        t_ns: Stamps, ns.
        start: When it began, CLOCK_MONOTONIC ns; shared by all stand-ins.
    """

    def __init__(self, go: Path, t_ns: np.ndarray, start: list[int]) -> None:
        self._go, self._t_ns, self._start, self._next = go, t_ns, start, 0
        self._statistics = FrameStatistics()
        self.info = DeviceInfo("stand-in", "film", "SIM-1")

    def _due(self, timeout_s: float, late_ns: int) -> int | None:
        """Wait for the next sample; its stamp on CLOCK_MONOTONIC, ns."""
        end_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        if not self._start or self._next >= len(self._t_ns):
            time.sleep(min(timeout_s, 0.05))
            if not self._start and self._go.exists():
                self._start.append(time.monotonic_ns() - int(self._t_ns[0]))
            return None
        stamp_ns = self._start[0] + int(self._t_ns[self._next])
        time.sleep(max(0, min(stamp_ns + late_ns, end_ns) - time.monotonic_ns()) * 1e-9)
        if stamp_ns + late_ns > end_ns:
            return None
        self._next += 1
        self._statistics.add(stamp_ns, 0)
        return stamp_ns

    def stats(self) -> SourceStats:
        """See `Source.stats`."""
        return self._statistics.snapshot()

    def close(self) -> None:
        """Nothing is open."""


class FilmImu(_Player):
    """An `ImuSource`."""

    def __init__(self, go: Path, readings: Any, start: list[int]) -> None:
        super().__init__(go, readings["t_ns"], start)
        self._gyro, self._force = readings["gyro"].tolist(), readings["force"].tolist()

    def read(self, timeout_s: float) -> list[ImuSample]:
        """See `ImuSource.read`."""
        stamp_ns = self._due(timeout_s, 0)
        if stamp_ns is None:
            return []
        k = self._next - 1
        return [
            ImuSample(
                stamp_ns, time.monotonic_ns(), stamp_ns // 1000, tuple(self._gyro[k]), tuple(self._force[k])
            )
        ]


class FilmCamera(_Player):
    """A `FrameSource`; each picture is copied, as a driver copies it."""

    def __init__(self, go: Path, film: np.ndarray, t_ns: np.ndarray, start: list[int]) -> None:
        super().__init__(go, t_ns, start)
        self._film = film

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`."""
        stamp_ns = self._due(timeout_s, round((EXPOSURE_S / 2 + READOUT_S) * 1e9))
        if stamp_ns is None:
            return None
        return Frame(
            t_exposure_mid_ns=stamp_ns, t_arrival_ns=time.monotonic_ns(), sequence=self._next - 1,
            image=np.array(self._film[self._next - 1]), encoding="mono8", stamp_rule="simulated",
        )  # fmt: skip


def main(argv: list[str]) -> int:
    """Host the bus and run the roles `imu` and `camera` on the stand-ins, until SIGTERM; no study."""
    from vical_daemon.acquire import camera as camera_role
    from vical_daemon.acquire import imu as imu_role
    from vical_daemon.bus.zenoh_bus import open_bus
    from vical_daemon.config.model import load
    from vical_daemon.config.paths import runtime_directory
    from vical_daemon.service.wall_clock import service_clock

    parser = argparse.ArgumentParser(prog="benchmarks live_film", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, help="with film and readings")
    args = parser.parse_args(argv)
    if args.folder is None:
        print("used by `python -m benchmarks live_load`")
        return 0
    folder, clock, stop = args.folder, service_clock(), threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    config = load(folder / "vical.yaml")
    bus = open_bus(mode="router", socket=runtime_directory() / "zenoh.sock")
    film, t_ns = np.load(folder / "film.npy", mmap_mode="r"), np.load(folder / "stamps.npy")
    readings, start, go = np.load(folder / "imu.npz"), list[int](), folder / "go"
    roles = [
        threading.Thread(
            target=imu_role.run, args=(config, bus, stop),
            kwargs={"clock": clock, "open_source": lambda _: FilmImu(go, readings, start)},
        ),
        threading.Thread(
            target=camera_role.run, args=(config, bus, stop),
            kwargs={"clock": clock, "open_source": lambda _: FilmCamera(go, film, t_ns, start)},
        ),
    ]  # fmt: skip
    for role in roles:
        role.start()
    while not stop.wait(0.2):
        pass
    for role in roles:
        role.join()
    bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
