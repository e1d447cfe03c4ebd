"""`vical imu`: the inertial sensor by hand: who it is, its samples, raw captures, bias, self test."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_json

if TYPE_CHECKING:
    from vical_drivers.microstrain.session import Session

_CAPTURE_LIMIT = 2**29  # bytes; three hours of 40-byte packets at 1 kHz
_LINKS = ("auto", "usb", "ftdi", "uart")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the nested commands."""
    commands = parser.add_subparsers(dest="imu_command", metavar="ACTION", required=True)

    def leaf(name: str, text: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        child = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        child.set_defaults(imu_run=run)
        add_json(child)
        return child

    info = leaf("info", "show model, serial number, firmware and settings", _info)
    _add_port(info)
    stream = leaf("stream", "print stamped samples, one JSON line each, then a summary", _stream)
    _add_port(stream)
    _add_stream(stream)
    decode = leaf("decode", "decode a raw byte capture to JSON lines, then a summary", _decode)
    decode.add_argument("file", metavar="FILE", help="raw bytes as received")
    _add_protocol(decode)
    decode.add_argument(
        "--little-endian-floats",
        action="store_true",
        help="floats are little-endian (bit 4 of the GX3's sampling settings)",
    )
    bias = leaf(
        "capture-gyro-bias", "let the device measure its gyro bias at rest (lost at power-off)", _capture_bias
    )
    _add_port(bias)
    bias.add_argument(
        "--seconds", type=float, default=10.0, metavar="S", help="how long to measure, 1 to 30 s (default 10)"
    )
    bias.add_argument(
        "--store-in-eeprom", action="store_true", help="keep the bias after power-off (the EEPROM wears out)"
    )
    poll = leaf("poll", "read one record of any kind, in SI units", _poll)
    _add_port(poll)
    poll.add_argument(
        "kind", metavar="KIND", help="data command (0xCC: everything) or MIP inertial field (0x04), as hex"
    )
    _add_port(leaf("selftest", "run the device's built-in test; exit 1 if a part fails", _selftest))


def _add_protocol(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--protocol",
        choices=("auto", "single-byte", "mip"),
        default="auto",
        help="protocol of the device (default: find out)",
    )


def _add_port(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="serial port, preferably /dev/serial/by-id/...")
    _add_protocol(parser)
    parser.add_argument(
        "--link",
        choices=_LINKS,
        default="auto",
        help="kind of link (default: find out); on a UART the wire time is subtracted from stamps",
    )


def _add_stream(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rate", type=float, default=100.0, metavar="HZ", help="samples per second (default 100)"
    )
    parser.add_argument(
        "--samples", type=int, default=None, metavar="N", help="end after N samples (default: at ^C)"
    )
    parser.add_argument("--seconds", type=float, default=None, metavar="S", help="end after S seconds")
    parser.add_argument(
        "--filter-width",
        type=int,
        metavar="M",
        help="moving average of a GX3, 1 to 32 ms (default: one sample interval)",
    )
    parser.add_argument(
        "--baud", type=int, default=None, help="baud while streaming (default: as the rate needs it)"
    )
    parser.add_argument(
        "--plot",
        metavar="F.png",
        default=None,
        help="plot the intervals before and after clock mapping",
    )


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    action: Callable[[argparse.Namespace], int] = args.imu_run
    return action(args)


def _stream(args: argparse.Namespace) -> int:
    from vical_daemon.cli import imu_stream

    return imu_stream.run(args)


def _with_session(args: argparse.Namespace, work: Callable[[Session, int], int]) -> int:
    """Find the device, hand over its session and baud, stop and close whatever happens."""
    from vical_drivers.microstrain.probe import connect

    session, port = connect(args.port, args.protocol, args.link)
    try:
        return work(session, port.baud)
    finally:
        session.stop()
        port.close()


def _info(args: argparse.Namespace) -> int:
    def work(session: Session, baud: int) -> int:
        info, settings = session.identify(), session.settings()
        facts: dict[str, object] = {
            "model": info.model,
            "serial_number": info.serial_number,
            "firmware": info.firmware,
            "protocol": info.protocol,
            "port": args.port,
            "baud": baud,
            **info.details,
            "settings": settings,
        }
        if args.json:
            print(json.dumps(facts))
            return 0
        for name, value in {**facts, **settings}.items():
            if name != "settings":
                print(f"{name.replace('_', ' '):<20} {value}")
        return 0

    return _with_session(args, work)


def _decode(args: argparse.Namespace) -> int:
    from vical_drivers.microstrain.capture import Capture
    from vical_drivers.user_files import read_file

    data = read_file(Path(args.file), _CAPTURE_LIMIT)
    capture = Capture(data, args.protocol, little_endian_floats=args.little_endian_floats)
    for record in capture:
        print(json.dumps({key: _finite(value) for key, value in record.items()}))
    s = capture.summary
    summary = {
        "records": s.records,
        "checksum_errors": s.checksum_errors,
        "skipped_bytes": s.skipped_bytes,
        "kinds": dict(s.kinds),
        "protocol": s.protocol,
        "tail_bytes": s.tail_bytes,
    }
    if args.json:
        print(json.dumps({"summary": summary}))
    else:
        kinds = ", ".join(f"{n} x {kind}" for kind, n in s.kinds.items()) or "none"
        print(
            f"# {s.records} records ({kinds}), {s.checksum_errors} checksum errors, {s.skipped_bytes} bytes "
            f"skipped, {s.tail_bytes} in a cut-off last record; protocol {s.protocol}"
        )
    if not s.records:
        raise CliError(
            f"{args.file}: no MicroStrain record in {len(data)} bytes; it must be the raw bytes of the wire, "
            "captured at the right baud"
        )
    return 0


def _finite(value: object) -> object:
    """JSON has no NaN; the device sends it for what it does not measure."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return value


def _capture_bias(args: argparse.Namespace) -> int:
    if not 1.0 <= args.seconds <= 30.0:
        raise CliError(f"--seconds {args.seconds:g} is outside 1 .. 30", 2)

    def work(session: Session, _baud: int) -> int:
        session.identify()
        if not args.quiet:
            print(f"Keep the device still for {args.seconds:g} s ...", file=sys.stderr)
        bias = session.capture_gyro_bias(args.seconds)
        if args.store_in_eeprom:
            session.store_gyro_bias()
        if math.hypot(*bias) > _LARGE_BIAS_RPS:
            print("vical: this bias is large; did the device move?", file=sys.stderr)
        if args.json:
            print(json.dumps({"gyro_bias_rps": list(bias), "stored": bool(args.store_in_eeprom)}))
        else:
            kept = "stored in the EEPROM" if args.store_in_eeprom else "kept until power-off"
            print(f"gyro bias {bias[0]:+.6f} {bias[1]:+.6f} {bias[2]:+.6f} rad/s, {kept}")
        return 0

    return _with_session(args, work)


def _poll(args: argparse.Namespace) -> int:
    try:
        kind = int(args.kind, 16)
    except ValueError:
        raise CliError(f"{args.kind!r} is not a hexadecimal number such as 0xCC", 2) from None

    def work(session: Session, _baud: int) -> int:
        session.identify()
        print(json.dumps({key: _finite(value) for key, value in session.poll(kind & 0xFF).items()}))
        return 0

    return _with_session(args, work)


_LARGE_BIAS_RPS = 0.03


def _selftest(args: argparse.Namespace) -> int:
    def work(session: Session, _baud: int) -> int:
        parts = session.self_test()
        passed = all(parts.values())
        if args.json:
            print(json.dumps({"passed": passed, "parts": parts}))
        else:
            for name, good in parts.items():
                print(f"{'ok    ' if good else 'FAILED'} {name}")
        if not passed:
            failed = ", ".join(name for name, good in parts.items() if not good)
            raise CliError(f"{args.port}: self test failed: {failed}")
        return 0

    return _with_session(args, work)
