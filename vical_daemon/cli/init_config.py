"""The text of a config made from devices: what was found out stands there, what was not as a comment."""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vical_drivers.errors import DriverError
from vical_drivers.samples import DeviceInfo

from vical_daemon.config.model import NAME

_GUESSED_EXPOSURE_S = 0.01  # a camera indoors; half of it goes into the stamps

_HEAD = """\
# Made by `vical init`; `vical check -c` of this file says whether it works. Keys: docs/reference/config.md
# Units are in the names; others are SI. What is left out has the value that the comment shows.

rig: {rig}                      # its name on the bus: vical/{rig}/...
"""
_IMU = """\
  {name}:                          # {model} serial {serial}, firmware {firmware}
    port: {port}
    protocol: {protocol}
    rate_hz: 500                 # 1000/n; 100 is enough for slow motion, 500 for a rig in the hand
    # noise: {{gyro_density: 5.2e-4, gyro_walk: 2.0e-5, accel_density: 8.0e-4, accel_walk: 2.0e-4}}
    #                            # SI, continuous time: `vical allan` measures yours
"""
_NO_IMU = """\
  # imu0:                        # none was found: plug it in, then vical init --force
  #   port: /dev/serial/by-id/...
"""
_CAMERA = """\
  {name}:                          # {model} {serial}
    uri: {uri}
    size: [{width}, {height}]              # {offers}
    rate_hz: {rate:g}
{exposure}    # lens:                      # estimated from the images unless given; a start helps
    #   intrinsics: [{focal}, {focal}, {cx:g}, {cy:g}]   # fx fy cx cy, px: a guess, 60 degrees across
    #   readout_s: 0.02          # rolling shutter, first to last row; 0: global shutter
"""
_EXPOSURE = """\
    # exposure_s: 0.005          # now: {exposure}; short is good: blur shifts corners
"""
_NO_EXPOSURE = """\
    assume_exposure_s: {guess}      # a guess: not reported; half its error is in the time shift
"""
_AUTOMATIC_EXPOSURE = """\
    exposure_s: {guess}             # it was automatic; fixed, stamps are exact. Raise it if images are dark
"""
_NO_CAMERA = """\
  # cam0:                        # none was found: plug it in, then vical init --force
  #   uri: v4l2:/dev/video0
"""
_TARGET = """\
target: {target}              # the board, Kalibr's format: put the size there that you measure
"""
_NO_TARGET = """\
calibration:
  mode: target_free              # no board: anything with texture that stands still will do
# target: target.yaml            # a board is quicker and more accurate (vical init --target aprilgrid);
                                 # then take mode: target_free away
"""
_REST = """
record: {{enabled: {record}}}         # MCAP, IMU and images; `vical info` and `vical calibrate` read it
web: {{enabled: true}}             # the page at http://127.0.0.1:8080/
"""
_EMULATED = """
imus:
  imu0:
    port: emulated               # a 3DM-GX3-25 that answers byte by byte; yours: see `vical devices`
    rate_hz: 100                 # 1000/n
    noise: {{gyro_density: 3.8e-4, accel_density: 1.2e-3}}    # SI, continuous time

cameras:
  cam0:
    uri: emulated                # rendered, before the board below, moved together with the imu
    size: [640, 480]
    rate_hz: 12.5
    lens:
      intrinsics: [510, 510, 320, 240]    # fx fy cx cy, px: a data sheet's focal length, to be improved

target: {target}              # the board that the camera sees, Kalibr's format
"""


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera as it is now.

    Attributes:
        uri: For the config.
        model: Of the camera.
        serial_number: Or what stands for it.
        size: width, height, px.
        rate_hz: Frames per second.
        exposure: As the camera reports it, s; "automatic": the camera sets it; "unknown": it does not
            report it; "": it could not be asked.
        offers: Formats and sizes it has.
        problem: Why it could not be asked; empty: it could.
    """

    uri: str
    model: str
    serial_number: str
    size: tuple[int, int] = (640, 480)
    rate_hz: float = 30.0
    exposure: str = ""
    offers: str = "width, height"
    problem: str = ""


def look_at(camera: DeviceInfo) -> FoundCamera:
    """Open a listed camera without asking it for anything, and see what it does."""
    from vical_drivers.camera.opening import open_camera

    from vical_daemon.vision.image_codec import decode_image

    uri = camera.details.get("uri", f"{camera.protocol}:{camera.path}")
    found = FoundCamera(uri, camera.model, camera.serial_number, offers=camera.details.get("formats", ""))
    try:
        with open_camera(uri, decoder=decode_image) as source:
            details = source.info.details
    except DriverError as error:
        return FoundCamera(uri, camera.model, camera.serial_number, problem=str(error))
    size, rate_hz = found.size, 0.0
    with suppress(ValueError):
        width, height = (int(word) for word in details.get("size", "").split("x"))
        size = width, height
    with suppress(ValueError):
        rate_hz = float(details.get("rate_hz", ""))
    return FoundCamera(
        uri,
        camera.model,
        camera.serial_number,
        size,
        rate_hz or found.rate_hz,
        details.get("exposure_s", ""),
        found.offers or "width, height",
    )


def rig_name() -> str:
    """This computer's name, as far as it can be one of a rig."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", platform.node().split(".")[0])[:40]
    return name if re.fullmatch(NAME, name) else "rig0"


def target_beside(config: Path) -> str | None:
    """The only target file in the folder of a config; None: there is none, or several."""
    from vical_daemon.vision.target import TargetError, load_target

    found = []
    for path in sorted(config.absolute().parent.glob("*.yaml")):
        with suppress(TargetError, OSError):
            load_target(path)
            found.append(path.name)
    return found[0] if len(found) == 1 else None


def config_of(
    rig: str, imus: Sequence[dict[str, Any]], cameras: Sequence[FoundCamera], target: str | None
) -> str:
    """Return the config of what was found.

    Args:
        rig: Its name.
        imus: As `vical devices --json` lists them.
        cameras: As they are.
        target: Target file; None: without a board.
    """
    parts = [_head(rig), "\nimus:\n" if imus else "\n# imus:\n"]
    parts += [_imu(f"imu{k}", imu) for k, imu in enumerate(imus)] or [_NO_IMU]
    parts += ["\ncameras:\n" if cameras else "\n# cameras:\n"]
    parts += [_camera(f"cam{k}", camera) for k, camera in enumerate(cameras)] or [_NO_CAMERA]
    parts.append("\n")
    parts.append(_NO_TARGET if target is None else _TARGET.format(target=json.dumps(target)))
    if len(imus) > 1:
        choice = (
            f"  imu: imu0                      # of {len(imus)}: cameras are calibrated against this one\n"
        )
        parts.append(choice if target is None else f"calibration:\n{choice}")
    return _aligned("".join([*parts, _REST.format(record="true")]))


def emulated_config(rig: str, target: str) -> str:
    """Return the config of the emulated rig, which needs no hardware."""
    record = _REST.format(record="false").replace("# MCAP", "# true: MCAP")
    return _aligned("".join([_head(rig), _EMULATED.format(target=json.dumps(target)), record]))


def _aligned(text: str) -> str:
    """Put the comments behind values into one column."""
    return re.sub(
        r"^( *[^\s#].*?|    # \S+: .*?) {2,}# ", lambda m: f"{m[1]:<32} # ", text, flags=re.MULTILINE
    )


def _head(rig: str) -> str:
    return _HEAD.format(rig=rig)


def _imu(name: str, imu: dict[str, Any]) -> str:
    return _IMU.format(
        name=name,
        model=_comment(imu["model"]),
        serial=_comment(imu["serial_number"]),
        firmware=_comment(imu["firmware"]),
        port=json.dumps(imu["port"]),
        protocol=imu["protocol"],
    )


def _camera(name: str, camera: FoundCamera) -> str:
    width, height = camera.size
    exposure = _NO_EXPOSURE.format(guess=_GUESSED_EXPOSURE_S)
    if camera.exposure == "automatic":
        exposure = _AUTOMATIC_EXPOSURE.format(guess=_GUESSED_EXPOSURE_S)
    elif camera.exposure != "unknown":
        exposure = _EXPOSURE.format(exposure=f"{camera.exposure} s" if camera.exposure else "as it is")
    text = _CAMERA.format(
        name=name,
        model=_comment(camera.model),
        serial=_comment(camera.serial_number),
        uri=json.dumps(camera.uri),
        width=width,
        height=height,
        offers=_comment(camera.offers),
        rate=camera.rate_hz,
        exposure=exposure,
        focal=round(0.87 * width),
        cx=0.5 * (width - 1),
        cy=0.5 * (height - 1),
    )
    if camera.problem:
        text += f"    # could not be opened, so size and rate are guesses: {_comment(camera.problem)}\n"
    return text


def _comment(text: object) -> str:
    """What a device says of itself, on one line: it must not become a key of the config."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
