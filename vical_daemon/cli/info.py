"""`vical info LOG`: topics, rates, gaps, drops, jitter, duration of a recording."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_json

if TYPE_CHECKING:
    from vical_daemon.logs.summary import Summary, TopicSummary


_EPILOG = """\
examples:
  vical info log.mcap
  vical info bag_folder/ mav0/            several recordings, of any kind

exit code: 0 done; 1 a file cannot be read
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "logs", metavar="LOG", nargs="+", help="an MCAP or bag file, a bag folder or an ASL folder"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print what each recording holds, and whether `vical calibrate` takes it; 1 if one is unreadable."""
    from vical_daemon.logs import RecordingError
    from vical_daemon.logs.mcap import LogError

    found: list[dict[str, object]] = []
    broken: list[str] = []
    for number, name in enumerate(args.logs):
        try:
            summary, problem = _summarise(Path(name))
        except (RecordingError, LogError) as error:
            text = str(error) if name in str(error) else f"{name}: {error}"
            broken.append(text)
            found.append({"path": name, "problem": text})
            continue
        found.append(_as_json(summary, problem))
        if not args.json:
            print(("\n" if number else "") + _as_text(summary, problem), flush=True)
    if args.json and not (len(args.logs) == 1 and broken):
        print(json.dumps(found[0] if len(args.logs) == 1 else {"logs": found}))
    if broken:
        for line in broken[:-1]:
            print(f"vical: error: {line}", file=sys.stderr)
        raise CliError(broken[-1])
    return 0


def _summarise(path: Path) -> tuple[Summary, str]:
    """Return what a recording holds, and why `vical calibrate` would not take it (empty: it would)."""
    from vical_daemon.logs import LEFT_OUT, RecordingError, check_recording, mcap_files, open_recording
    from vical_daemon.logs.summary import summarise_logs, summarise_recording

    problem = ""
    files = mcap_files(path)
    summary = summarise_logs(path, files) if files and path.exists() else None
    recording = None
    try:
        recording = open_recording(path, check=False, as_recorded=summary is None)
        check_recording(recording)
    except RecordingError as error:
        if summary is None and recording is None:
            raise
        problem = str(error)
    if summary is None:
        assert recording is not None
        return summarise_recording(recording), problem
    found = recording.warnings if recording is not None else []
    summary.warnings.extend(warning for warning in found if warning.startswith(LEFT_OUT))
    return summary, problem


def _as_json(summary: Summary, problem: str) -> dict[str, object]:
    values = dataclasses.asdict(summary)
    values["path"] = str(summary.path)
    values["problem"] = problem
    return values


def _as_text(summary: Summary, problem: str) -> str:
    begin = datetime.fromtimestamp(summary.begin_ns * 1e-9, UTC) if summary.begin_ns > 0 else None
    lines = [
        f"{summary.path}  {summary.bytes / 1e6:.1f} MB  {summary.duration_s:.2f} s  "
        + f"{summary.messages} messages"
        + ("" if summary.complete else "  UNFINISHED (`vical recover` makes it whole)"),
        f"begins {begin:%Y-%m-%d %H:%M:%S} UTC" if begin else "without date",
        "",
        f"{'topic':<40} {'count':>8} {'Hz':>8} {'missing':>8} {'max gap':>9} {'jitter':>9} "
        f"{'latency p50 / p99':>19}",
    ]
    lines += [_row(topic) for topic in summary.topics]
    for name, values in summary.metadata.items():
        lines.append(f"metadata {name}: " + ", ".join(f"{k}={_short(v)}" for k, v in values.items()))
    for name, size in summary.attachments.items():
        lines.append(f"attachment {name}: {size} bytes")
    lines += [f"warning: {warning}" for warning in summary.warnings]
    if problem:
        lines.append(f"not fit for calibration: {problem}")
    return "\n".join(lines)


def _short(value: str) -> str:
    """Return a value, or the size of a text: ROS 2 stores the whole metadata.yaml of a bag as one."""
    return f"({len(value)} characters)" if "\n" in value else value


def _row(topic: TopicSummary) -> str:
    latency = (
        "" if topic.latency_ms is None else "{} / {}".format(*(_time(1e-3 * v) for v in topic.latency_ms))
    )
    return (
        f"{topic.topic:<40} {topic.count:>8} {topic.rate_hz:>8.2f} {topic.missing:>8} "
        f"{topic.largest_gap_s:>7.3f} s {_time(1e-6 * topic.jitter_us):>9} {latency:>19}"
    )


def _time(seconds: float) -> str:
    """Return a duration in the unit that suits it.

    >>> _time(0.000174), _time(0.2227), _time(9.1), _time(-0.0028)
    ('174 us', '223 ms', '9.1 s', '-2.8 ms')
    """
    size = abs(seconds)  # a latency is negative where stamps run ahead of the clock that received them
    if size >= 1.0:
        return f"{seconds:.3g} s" if size < 1000 else f"{seconds:.0f} s"
    return f"{1e3 * seconds:.3g} ms" if size >= 1e-3 else f"{1e6 * seconds:.0f} us"
