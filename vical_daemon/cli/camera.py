"""`vical camera`: a camera by hand: what there is, its frames with stamps, one picture, its controls."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_drivers.samples import Frame, FrameSource

_READ_S = 0.5
_WARM_UP_FRAMES = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the nested commands."""
    commands = parser.add_subparsers(dest="camera_command", metavar="ACTION", required=True)

    def leaf(name: str, text: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        child = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        child.set_defaults(camera_run=run)
        add_json(child)
        return child

    leaf("list", "list cameras of every kind, with their names for the config", _list)
    stream = leaf("stream", "print one line per frame with its stamp, then a summary", _stream)
    _add_device(stream)
    stream.add_argument(
        "--frames", type=int, default=None, metavar="N", help="end after N frames (default: at ^C)"
    )
    stream.add_argument("--seconds", type=float, default=None, metavar="S", help="end after S seconds")
    stream.add_argument(
        "--timeout",
        type=float,
        default=5.0,
        metavar="S",
        help="fail after S seconds without a frame (default 5)",
    )
    snapshot = leaf("snapshot", "save one image to a file", _snapshot)
    _add_device(snapshot)
    snapshot.add_argument("-o", "--output", metavar="F.png", required=True, help=".png, .jpg or .jpeg")
    snapshot.add_argument(
        "--skip",
        type=int,
        default=_WARM_UP_FRAMES,
        metavar="N",
        help=f"discard N frames first, for the automatic exposure (default {_WARM_UP_FRAMES})",
    )
    _add_device(leaf("controls", "list the controls of a V4L2 camera, with ranges", _controls))


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("device", metavar="DEVICE", help="/dev/video0, iidc:GUID, aravis:ID, folder:PATH")
    parser.add_argument(
        "--size", metavar="WxH", default=None, help="image size in px, e.g. 640x480 (default: the camera's)"
    )
    parser.add_argument(
        "--rate", type=float, default=None, metavar="HZ", help="frames per second (default: the camera's)"
    )
    parser.add_argument(
        "--format",
        default=None,
        metavar="NAME",
        help="pixel format, e.g. GREY, YUYV, MJPG (default: the cheapest)",
    )
    parser.add_argument(
        "--encoding",
        choices=("mono8", "mono16", "bgr8"),
        default="mono8",
        help="encoding of the frames (default mono8)",
    )
    _add_exposure(parser)
    parser.add_argument("--gain", type=float, default=None, help="in the camera's own unit")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="set another control; may be repeated",
    )
    _add_shutter(parser)
    parser.add_argument(
        "--buffers",
        type=int,
        default=None,
        metavar="N",
        help="number of kernel buffers (default: the driver's)",
    )


def _add_exposure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--exposure",
        type=float,
        default=None,
        metavar="S",
        help="exposure time, s (default: as the camera is set)",
    )
    parser.add_argument(
        "--assume-exposure",
        type=float,
        default=None,
        metavar="S",
        help="exposure time of a camera that does not report it, s",
    )


def _add_shutter(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--readout",
        type=float,
        default=0.0,
        metavar="S",
        help="readout time from first to last row, s (default 0)",
    )
    parser.add_argument("--rolling", action="store_true", help="the camera has a rolling shutter")
    parser.add_argument(
        "--stamp",
        choices=("auto", "raw", "soe", "eof", "first-packet", "shutter-closed"),
        default="auto",
        help="what the driver's stamp marks, if the driver reports it wrongly (default auto)",
    )


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    action: Callable[[argparse.Namespace], int] = args.camera_run
    return action(args)


def _list(args: argparse.Namespace) -> int:
    from vical_drivers.camera import list_cameras

    cameras = list_cameras()
    if args.json:
        print(json.dumps([asdict(camera) for camera in cameras]))
        return 0
    for camera in cameras:
        print(f"{camera.details.get('uri', camera.path)}")
        print(f"    {camera.model}, serial {camera.serial_number}, {camera.path}")
        for name in ("driver", "bus", "formats", "problem"):
            if name in camera.details:
                print(f"    {name}: {camera.details[name]}")
    if not cameras:
        print("no camera found; is it plugged in, and may you read /dev/video* (group video)?")
    return 0


def _open(args: argparse.Namespace) -> FrameSource:
    from vical_drivers.camera import open_camera

    from vical_daemon.vision.image_codec import decode_image

    width, height = _size(args.size)
    return open_camera(
        args.device,
        width=width,
        height=height,
        rate_hz=args.rate,
        pixel_format=args.format,
        encoding=args.encoding,
        exposure_s=args.exposure,
        gain=args.gain,
        controls=dict(_control(text) for text in args.set),
        decoder=decode_image,
        assume_exposure_s=args.assume_exposure,
        readout_s=args.readout,
        rolling_shutter=args.rolling,
        stamp=args.stamp,
        buffers=args.buffers,
    )


def _size(text: str | None) -> tuple[int, int] | tuple[None, None]:
    if text is None:
        return None, None
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise CliError(f"--size {text}: give it like 640x480", EXIT_USAGE) from None
    return width, height


def _control(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise CliError(f"--set {text}: give it like focus_absolute=0", EXIT_USAGE) from None


def _frames(source: FrameSource, args: argparse.Namespace) -> Iterator[Frame]:
    """Yield frames until one of the limits; Ctrl-C ends it in good order."""
    from vical_drivers.errors import DataEndedError

    started = silent_since = time.monotonic()
    taken = 0
    with contextlib.suppress(KeyboardInterrupt):
        while args.frames is None or taken < args.frames:
            now = time.monotonic()
            if args.seconds is not None and now - started >= args.seconds:
                return
            try:
                frame = _read(source)
            except DataEndedError as error:
                print(error, file=sys.stderr)
                return
            if frame is not None:
                taken += 1
                silent_since = time.monotonic()
                yield frame
            elif now - silent_since > args.timeout:
                name = source.info.path or source.info.model
                raise CliError(f"{name}: no frame for {args.timeout:g} s; is it triggered from outside?")


def _read(source: FrameSource) -> Frame | None:
    """Return the next frame; a camera that went away is waited for, as the daemon does."""
    from vical_drivers.errors import DeviceLostError

    try:
        return source.read(_READ_S)
    except DeviceLostError as error:
        print(error, file=sys.stderr)
        time.sleep(0.1)
        return None


def _stream(args: argparse.Namespace) -> int:
    with _open(args) as source:
        if not args.json:
            _print_info(source)
        for frame in _frames(source, args):
            print(json.dumps(_facts(frame)) if args.json else _line(frame))
        stats = source.stats()
    summary: dict[str, Any] = {
        "frames": stats.samples,
        "dropped": stats.lost,
        "corrupt": stats.checksum_errors,
        "reconnects": stats.reconnects,
        "rate_hz": stats.rate_hz,
        "jitter_us": stats.jitter_us,
        "clock_skew_ppm": stats.clock_skew_ppm,
        "extra": stats.extra,
        "device": asdict(source.info),
    }
    if args.json:
        print(json.dumps({"summary": summary}))
    else:
        jitter = "" if stats.jitter_us is None else f", jitter {stats.jitter_us:.0f} us"
        print(
            f"{stats.samples} frames, {stats.lost} dropped, {stats.checksum_errors} corrupt, "
            f"{stats.rate_hz:.3f} Hz{jitter}"
        )
    return 0


def _facts(frame: Frame) -> dict[str, object]:
    height, width = frame.image.shape[:2]
    return {
        "t_exposure_mid_ns": frame.t_exposure_mid_ns,
        "t_arrival_ns": frame.t_arrival_ns,
        "sequence": frame.sequence,
        "width": width,
        "height": height,
        "encoding": frame.encoding,
        "stamp_rule": frame.stamp_rule,
        "exposure_ns": frame.exposure_ns,
        "readout_ns": frame.readout_ns,
        "t_sigma_ns": frame.t_sigma_ns,
        "dropped_before": frame.dropped_before,
    }


def _line(frame: Frame) -> str:
    height, width = frame.image.shape[:2]
    age_ms = (frame.t_arrival_ns - frame.t_exposure_mid_ns) * 1e-6
    exposure = "unknown" if frame.exposure_ns is None else f"{frame.exposure_ns * 1e-6:.2f} ms"
    lost = f"  {frame.dropped_before} lost before" if frame.dropped_before else ""
    return (
        f"{frame.sequence:>8}  {frame.t_exposure_mid_ns * 1e-9:.6f} s  {width}x{height} {frame.encoding}  "
        f"exposure {exposure}  age {age_ms:6.2f} ms  {frame.stamp_rule}{lost}"
    )


def _print_info(source: FrameSource) -> None:
    info = source.info
    details = ", ".join(f"{name} {value}" for name, value in info.details.items() if name != "uri")
    print(f"{info.model}, serial {info.serial_number}: {details}", file=sys.stderr)


def _snapshot(args: argparse.Namespace) -> int:
    from vical_daemon.vision.image_codec import encode_image

    path = Path(args.output)
    kinds = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
    if path.suffix.lower() not in kinds:
        raise CliError(f"{path}: the name must end in .png, .jpg or .jpeg", EXIT_USAGE)
    args.frames, args.seconds, args.timeout = args.skip + 1, None, 5.0
    with _open(args) as source:
        frame = None
        for frame in _frames(source, args):  # noqa: B007 - the last one is wanted
            pass
    if frame is None:
        raise CliError(f"{args.device}: no frame; is it triggered from outside?")
    write_output(path, encode_image(frame.image, kinds[path.suffix.lower()]))
    if args.json:
        print(json.dumps({"file": str(path), **_facts(frame)}))
    else:
        print(f"{path}: {_line(frame).strip()}")
    return 0


def _controls(args: argparse.Namespace) -> int:
    from vical_drivers.camera.v4l2.camera import V4l2Camera

    with _open(args) as source:
        if not isinstance(source, V4l2Camera):
            raise CliError(f"{args.device}: only V4L2 cameras list their controls")
        controls = [(c, source.controls.get(c.name) if c.readable else None) for c in source.controls.all()]
    if args.json:
        print(json.dumps([{**asdict(control), "value": value} for control, value in controls]))
        return 0
    for control, value in controls:
        if control.kind == "button":
            print(f"{control.name:<36}   button")
        else:
            shown = "-" if value is None else value
            print(f"{control.name:<36} {shown:>8}  (default {control.default}; {control.range_text})")
    return 0
