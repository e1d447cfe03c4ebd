"""`vical command WORD`: what the buttons of the page do, from a terminal."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING

from vical_daemon.cli.errors import EXIT_USAGE, CliError
from vical_daemon.cli.options import add_config, add_json

if TYPE_CHECKING:
    from vical_daemon.bus.interface import Bus, Sample

WORDS = {  # role and word on the bus
    "accept": ("estimate", "accept"),
    "discard": ("estimate", "discard"),
    "reset": ("estimate", "reset"),
    "check": ("estimate", "check"),
    "calibrate": ("estimate", "calibrate"),
    "verify": ("estimate", "verify"),
    "record-start": ("record", "start"),
    "record-stop": ("record", "stop"),
}
_ANSWERED = {"accept": ("accepted", "not accepted"), "discard": ("discarded", "not discarded")}
_OF_VERIFY = ("check", "calibrate", "verify")  # have an effect only with `mode: verify`
_BUS_S = 3.0
_ANSWER_S = 5.0  # estimates come five times a second
_STATUS_S = 2.0  # within this time a role has said how it is
_BUSY_S = 60.0  # the longest step of an estimator, see `calibrate.worker`
_EPILOG = """\
examples:
  vical command accept            store the present result as the calibration of these devices
  vical command discard           forget it, and put back what was stored when it began
  vical command reset             forget it and start over; the store stays as it is
  vical command check             with `mode: verify`: check the stored calibration now, without a pause
  vical command calibrate         with `mode: verify`: calibrate, store the result, and verify it from then on
  vical command verify            with `mode: verify`: end such a calibration
  vical command record-start      begin a recording (record-stop ends it)

exit code: 0 done; 1 no answer, the result was refused, or the command has no effect in this mode; 2 bad usage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the word, and which bus."""
    parser.add_argument("word", choices=WORDS, metavar="WORD", help=", ".join(WORDS))
    add_config(parser, required=False)
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        help="router to connect to, e.g. tcp/127.0.0.1:7447 (default: the local bus)",
    )
    parser.add_argument("--rig", metavar="NAME", help="which rig, if the bus has several")
    parser.epilog = _EPILOG
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Send the command; wait for the answer of those that have one."""
    from vical_daemon.cli.bus_wait import wait_for_bus

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    end_s = time.monotonic() + _BUS_S
    bus = wait_for_bus(args.config, args.connect, end_s=end_s, stop=stop, quiet=args.quiet)
    if bus is None:
        return 0
    try:
        rig = _rig(bus, args.rig or _rig_of(args.config))
        rights = _rights(bus, rig)
        try:
            answer = send(bus, rig, args.word)
        except CliError as error:
            raise CliError(f"{error}{f'; {rights}' if rights else ''}", error.exit_code) from None
    finally:
        bus.close()
    if answer.startswith("not "):
        raise CliError(answer)
    if rights and args.word not in _ANSWERED:
        print(f"vical: whether it was obeyed is not known: {rights}", file=sys.stderr)
    print(json.dumps({"rig": rig, "sent": args.word, "answer": answer}) if args.json else answer)
    return 0


def _rights(bus: Bus, rig: str) -> str:
    """Say who may command where the bus drops the commands of others without a word; empty: on its socket."""
    protocol = getattr(bus, "protocol", "")
    if not protocol or protocol.startswith("unixsock"):
        return ""
    return f"over {protocol}, {rig} obeys those whom its bus.commanders names"


def send(bus: Bus, rig: str, word: str, answer_s: float = _ANSWER_S) -> str:
    """Send a command, and return the answer; of a command that has none, what was sent.

    Args:
        bus: The bus of the rig.
        rig: Its name.
        word: One of `WORDS`.
        answer_s: How long to wait for an answer, s.

    Raises:
        CliError: No answer came, or the command has no effect on what the rig does now.
    """
    from vical_daemon.bus import topics
    from vical_daemon.bus.messages import encode_string

    _check_effect(bus, rig, word)
    answers: list[str] = []
    came = threading.Event()

    def listen(sample: Sample) -> None:
        found = _answer(sample, word)
        if found:
            answers.append(found)
            came.set()

    role, said = WORDS[word]
    subscription = bus.subscribe(topics.CALIBRATION.key(rig, "x").replace("/x", "/*"), listen)
    try:
        bus.publish(topics.COMMAND.key(rig, role), encode_string(said))
        if word not in _ANSWERED:
            return _sent(bus, rig, word)
        if not came.wait(answer_s):
            if not bus.latest(topics.STATUS.key(rig, role)):
                raise CliError(f"no answer from {rig}: is the role estimate (vical-calibrate) running?")
            print(f"vical: {rig} is busy: waiting for its answer", file=sys.stderr)
            if not came.wait(_BUSY_S):
                raise CliError(f"no answer from {rig}: it may still {word}, see `vical watch`")
    finally:
        subscription.close()
    return answers[0]


def _sent(bus: Bus, rig: str, word: str) -> str:
    """Return that a command which has no answer was sent, after a look at who it is for.

    Raises:
        CliError: The role does not run, or it says that it cannot.
    """
    from vical_daemon.bus import topics
    from vical_daemon.bus.messages import Level, decode_diagnostics

    role, _ = WORDS[word]
    if word == "record-start":
        time.sleep(_STATUS_S)
    statuses = bus.latest(topics.STATUS.key(rig, role))
    if not statuses:
        raise CliError(f"no answer from {rig}: is the role {role} running?")
    for status in decode_diagnostics(statuses[-1].payload).statuses:
        if word == "record-start" and status.level == Level.ERROR:
            raise CliError(f"not recording: {status.message}")
    return f"sent: {word} to {rig}"


def _check_effect(bus: Bus, rig: str, word: str) -> None:
    """Refuse a command that the role estimate ignores: each mode has its own.

    Raises:
        CliError: The command has no effect now.
    """
    from vical_daemon.bus import topics
    from vical_daemon.bus.messages import CheckState, decode_verification

    role, _ = WORDS[word]
    if role != "estimate" or not bus.latest(topics.STATUS.key(rig, role)):
        return
    samples = bus.latest(topics.VERIFY.key(rig, "x").replace("/x/", "/*/"))
    if word in _OF_VERIFY:
        if not samples:
            raise CliError(f"`{word}` has no effect on {rig}: it needs `mode: verify` in the config")
    elif any(decode_verification(sample.payload).state is not CheckState.CALIBRATING for sample in samples):
        raise CliError(
            f"`{word}` has no effect on {rig}, which verifies its calibration (`mode: verify`): "
            "first `vical command calibrate`"
        )


def _answer(sample: Sample, word: str) -> str:
    """Return the answer to a command in an estimate; empty: it has none."""
    from vical_daemon.bus.messages import MessageError, decode_calibration
    from vical_daemon.estimation.wording import event_text

    try:
        events = decode_calibration(sample.payload).estimate.events
    except MessageError:
        return ""
    texts = [event_text(event) for event in events]
    return next((text for text in texts if text.startswith(_ANSWERED[word])), "")


def _rig_of(config_path: str | None) -> str:
    """Return the rig of a config, "" without one."""
    from vical_daemon.config.model import load

    return load(config_path).rig if config_path else ""


def _rig(bus: Bus, wanted: str) -> str:
    """Return the rig to command: the wanted one, or else the only one on the bus.

    A bus may be that of another rig: the service's where one's own does not run, or a site's router.

    Raises:
        CliError: There is none, not the wanted one, or several.
    """
    from vical_daemon.bus import topics

    parsed = [topics.parse_key(sample.key) for sample in bus.latest(f"{topics.ROOT}/**", 2.0)]
    rigs = sorted({entry.rig for entry in parsed if entry is not None})
    if not rigs:
        raise CliError("nothing on the bus yet; is `vical run` (vical.target) running?")
    if wanted and wanted not in rigs:
        raise CliError(f"rig {wanted} is not on this bus, only {', '.join(rigs)}")
    if wanted:
        return wanted
    if len(rigs) > 1:
        raise CliError(f"several rigs are on this bus ({', '.join(rigs)}): choose one with --rig", EXIT_USAGE)
    return rigs[0]
