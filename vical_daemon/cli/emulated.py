"""The emulated rig behind `port: emulated` and `uri: emulated`, and behind `vical demo`.

The one place where the daemon meets the mocks: what is emulated comes to the roles as a port and a frame
source, as from hardware. IMU and camera are moved by one hand, so both belong into one process.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.config.model import EMULATED

if TYPE_CHECKING:
    from vical_drivers.samples import FrameSource, ImuSource
    from vical_mocks.live_rig import LiveRig

    from vical_daemon.config.model import CameraConfig, Config, ImuConfig
    from vical_daemon.vision.target import Target

    EmulatedRig = LiveRig

RoleOptions = dict[str, dict[str, Any]]


def make_rig(
    board: Target, camera_rate_hz: float, *, seed: int = 1, devices: tuple[str, ...] = ("imu", "camera")
) -> EmulatedRig:
    """Return a rig that is waved before a board; a context manager, running inside its block.

    Args:
        board: What the camera sees.
        camera_rate_hz: Frames per second.
        seed: Chooses motion, noise and biases.
        devices: Of imu and camera, those that are to run.
    """
    from vical_mocks.live_rig import LiveRig, LiveRigSettings

    attributes = {"kind": board.kind} | asdict(board)
    side = -1 if board.kind == "checkerboard" else 1  # where the printed side is, see `vision.target`
    settings = LiveRigSettings(attributes, board_side=side, seed=seed, camera_rate_hz=camera_rate_hz)
    return LiveRig(settings, devices)


@contextmanager
def emulated_devices(config: Config, roles: Collection[str]) -> Iterator[RoleOptions]:
    """Run what the config wants emulated, and yield how the roles open it (`open_source` of imu and camera).

    Nothing is started and nothing yielded for a config with real devices only.

    Raises:
        CliError: The config asks for what the emulated rig has not.
    """
    imus = [name for name, imu in config.imus.items() if imu.port == EMULATED]
    cameras = [name for name, camera in config.cameras.items() if camera.uri == EMULATED]
    running = tuple(role for role, names in (("imu", imus), ("camera", cameras)) if names and role in roles)
    if not running:
        yield {}
        return
    if len(imus) > 1 or len(cameras) > 1:
        raise CliError(f"there is one emulated IMU and one emulated camera, not {imus + cameras}", EXIT_USAGE)
    if imus and cameras and len(running) == 1:
        raise CliError(
            "the emulated IMU and camera are moved together: run both in one process (`vical run acquire`)",
            EXIT_USAGE,
        )
    with make_rig(_board(config), _frame_rate_hz(config, cameras), devices=running) as rig:
        for name in cameras:
            _check_size(name, config.cameras[name], rig.rig.lens.resolution)
        yield {"imu": {"open_source": _imu_opener(rig)}, "camera": {"open_source": _camera_opener(rig)}}


def _imu_opener(rig: EmulatedRig) -> Callable[[ImuConfig], ImuSource]:
    from vical_daemon.acquire.imu import open_imu

    return lambda imu: open_imu(replace(imu, port=rig.port) if imu.port == EMULATED else imu)


def _camera_opener(rig: EmulatedRig) -> Callable[[CameraConfig], FrameSource]:
    from vical_daemon.acquire.camera import open_camera

    return lambda camera: rig.camera() if camera.uri == EMULATED else open_camera(camera)


def _board(config: Config) -> Target:
    from vical_daemon.vision.target import load_target

    if config.target_path is None:
        raise CliError("emulated devices need `target: FILE`, the board that the camera sees", EXIT_USAGE)
    return load_target(config.target_path)


def _frame_rate_hz(config: Config, cameras: list[str]) -> float:
    return config.cameras[cameras[0]].rate_hz if cameras else 1.0


def _check_size(name: str, camera: CameraConfig, resolution: tuple[int, int]) -> None:
    if camera.size != resolution:
        raise CliError(
            f"cameras.{name}.size: the emulated camera has {resolution[0]} x {resolution[1]} pixels",
            EXIT_USAGE,
        )
