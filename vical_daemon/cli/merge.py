"""`vical merge INPUT INPUT ...`: one calibration from several recordings of one rig, if they agree."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli import calibrate
from vical_daemon.cli.errors import EXIT_NOT_CONVERGED, EXIT_USAGE, CliError
from vical_daemon.cli.options import warn

if TYPE_CHECKING:
    from vical_daemon.offline.calibration_job import Job
    from vical_daemon.offline.merge import MergeOutcome

DISAGREEING = "disagreeing"
_EXAMPLES = """\
examples:
  vical merge monday.mcap tuesday.mcap wednesday.mcap --target target.yaml -o result.json
  vical merge *.mcap --target target.yaml --clock apart

Each recording is calibrated alone and compared with the others. Those that agree make one calibration.
A recording that disagrees is named, with what differs, and is left out.

exit code: 0 converged, all recordings agree; 3 there is a result, but it is not converged (--accept
converging, degenerate) or a recording disagrees (--accept disagreeing); 1 no result; 2 bad usage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    calibrate.add_arguments(parser, accept=(*calibrate.ACCEPT, DISAGREEING))
    parser.epilog = _EXAMPLES


def run(args: argparse.Namespace) -> int:
    """Merge and print; 1 if there is no usable result, 3 if it is not converged or a recording disagrees."""
    if len(args.inputs) < 2:
        raise CliError("give at least two recordings (one: `vical calibrate`)", EXIT_USAGE)
    job, accepted = calibrate.job_of(args, accept=(*calibrate.ACCEPT, DISAGREEING))
    from vical_daemon.offline.merge import merge, merge_document

    bar = calibrate.ProgressBar(hidden=args.quiet or not sys.stderr.isatty())
    merged = merge(job, bar.show, keep_frames=bool(args.report))
    bar.close()
    result = merge_document(job, merged)
    calibrate.write(args, result, describe_inputs)
    disagree = 0 if DISAGREEING in accepted else _report_disagreement(job, merged, result)
    if not merged.used:
        return EXIT_NOT_CONVERGED
    return max(calibrate.conclude(args, job, merged.outcome, result, accepted), disagree)


def _report_disagreement(job: Job, merged: MergeOutcome, result: dict[str, Any]) -> int:
    """One line on stderr for each recording that disagrees; the exit code."""
    from vical_daemon.offline.merge import changed_since

    for entry in result["inputs"]:
        if entry["verdict"] == "disagrees":
            what = "; ".join(difference_text(d) for d in _largest(entry)) or "a change within it was reported"
            warn(f"{entry['path']} disagrees with the other recordings: {what}")
    if not merged.used:
        warn(result["reason"])
    elif changed_since(job, merged):
        warn("all that disagree are the latest: has the rig changed since? Calibrate from them alone")
    if merged.disagreeing and job.common_clock and _only_time_shifts(result):
        warn("only time shifts differ: if each recording has its own, merge with --clock apart")
    return EXIT_NOT_CONVERGED if merged.disagreeing else 0


def _only_time_shifts(result: dict[str, Any]) -> bool:
    wrong = [entry for entry in result["inputs"] if entry["verdict"] == "disagrees"]
    return all(d["what"] == "time shift" for entry in wrong for d in _largest(entry))


def _largest(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """Differences that chance does not explain, most improbable first."""
    count = max(len(entry["differences"]), 1)
    found = sorted(entry["differences"], key=lambda d: d["probability"])
    return [d for d in found if d["probability"] * count < 1e-3]


def describe_inputs(result: dict[str, Any]) -> str:
    """One line for each recording: verdict, and what differs most."""
    width = max(len(Path(entry["path"]).name) for entry in result["inputs"])
    lines = ["recordings"]
    for entry in result["inputs"]:
        line = f"  {Path(entry['path']).name:<{width}}  {entry['duration_s']:6.1f} s  {entry['verdict']:<11}"
        poses = [d for d in entry["differences"] if not d["what"].startswith("lens")]
        line += "  " + ", ".join(difference_text(d) for d in poses)
        lines.append(line.rstrip())
    lines.append("  (differences are from the mean of the other recordings)")
    return "\n".join(lines)


def difference_text(difference: dict[str, Any]) -> str:
    """A difference as its length, with the sigma along it."""
    scale, unit = _UNITS.get(difference["what"], (1.0, ""))
    value, sigma = difference["value"], difference["sigma"]
    length = sum(v * v for v in value) ** 0.5
    along = (
        (sum((v * s) ** 2 for v, s in zip(value, sigma, strict=True)) ** 0.5) / length if length else sigma[0]
    )
    return f"{difference['what']} {scale * length:.3g} ± {scale * along:.2g} {unit}".rstrip()


_UNITS = {"lever arm": (1e3, "mm"), "rotation": (57.29578, "deg"), "time shift": (1e3, "ms")}
