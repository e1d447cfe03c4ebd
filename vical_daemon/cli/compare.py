"""`vical compare A B`: how two calibrations differ, in joint sigmas and in pixels."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.cli.calibrate import finite
from vical_daemon.cli.errors import EXIT_CANNOT_TELL, EXIT_CHANGED, EXIT_USAGE, CliError
from vical_daemon.cli.options import add_json

if TYPE_CHECKING:
    from vical_daemon.offline.compare import Comparison

_EPILOG = """\
sources: a result (.json), a log with calibrations in it (.mcap or folder), a file of the store,
`store` (the latest), Kalibr's camchain (.yaml), OpenVINS's kalibr_imucam_chain.yaml or estimator_config.yaml,
ROS: CameraInfo and static transforms (.yaml, or a bag)

examples:
  vical compare monday.json today.json
  vical compare result.json camchain-imucam.yaml --map
  vical compare store result.json --distance 0.5 --distance 20
  vical compare monday.json today.json --report difference.html
  vical compare a.json b.json c.json --matrix

exit code: 0 same; 4 changed; 5 not comparable; 1 a source cannot be read; 2 bad usage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the sources and what to show."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "sources", metavar="SOURCE", nargs="+", help="two calibrations; with --matrix any number"
    )
    parser.add_argument("--camera", metavar="NAME", help="use only this camera (default: all)")
    parser.add_argument("--map", action="store_true", help="show the whole map of pixel differences")
    parser.add_argument(
        "--distance",
        type=float,
        action="append",
        metavar="M",
        help="distance of the points of the map, m (default: 1 and 10); may be repeated",
    )
    parser.add_argument("--report", metavar="F.html", help="write a page with pictures, one HTML file")
    parser.add_argument("--matrix", action="store_true", help="compare every pair")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Compare and print; 4 if changed, 5 if not comparable."""
    if args.distance and not all(0.0 < d < 1e6 for d in args.distance):
        raise CliError("--distance must be above 0 m", EXIT_USAGE)
    if len(args.sources) < 2 or (len(args.sources) > 2 and not args.matrix):
        raise CliError(
            f"compare takes two calibrations, not {len(args.sources)}; for more use --matrix", EXIT_USAGE
        )
    if args.report and (args.matrix or not Path(args.report).absolute().parent.is_dir()):
        why = "not with --matrix" if args.matrix else f"the folder of {args.report} does not exist"
        raise CliError(f"--report: {why}", EXIT_USAGE)
    if args.matrix:
        return _matrix(args)
    comparison = _compare(args, *args.sources)
    if args.json:
        print(json.dumps(finite(comparison.document()), allow_nan=False))
    else:
        from vical_daemon.cli.compare_text import describe

        print(describe(comparison, with_map=args.map))
    if args.report:
        _report(args, comparison)
    return _code([comparison])


def _report(args: argparse.Namespace, comparison: Comparison) -> None:
    from vical_daemon.results.report import collect
    from vical_daemon.results.report.comparison import write_comparison

    made = collect(" ".join(sys.argv), [Path(source) for source in args.sources if Path(source).is_file()])
    write_comparison(Path(args.report), comparison.document(), comparison.sources, made)
    print(f"report: {args.report}", file=sys.stderr)


def _matrix(args: argparse.Namespace) -> int:
    """Compare each with each: verdict and largest difference in pixels."""
    pairs = [(i, j) for i in range(len(args.sources)) for j in range(i + 1, len(args.sources))]
    found = {(i, j): _compare(args, args.sources[i], args.sources[j]) for i, j in pairs}
    if args.json:
        documents = [{"a": i, "b": j} | c.document() for (i, j), c in found.items()]
        print(json.dumps(finite({"sources": args.sources, "pairs": documents}), allow_nan=False))
        return _code(list(found.values()))
    for k, source in enumerate(args.sources):
        print(f"{k + 1}: {source}")
    print("\nprobability by chance, and largest difference in px beyond what both sigmas allow\n")
    print("     " + "".join(f"{k + 1:>20}" for k in range(1, len(args.sources))))
    for i in range(len(args.sources) - 1):
        cells = [_cell(found[i, j]) if j > i else "" for j in range(1, len(args.sources))]
        print(f"{i + 1:>5}" + "".join(f"{cell:>20}" for cell in cells))
    print()
    notes: dict[str, list[str]] = {}
    for (i, j), comparison in found.items():
        for note in comparison.notes:
            notes.setdefault(note, []).append(f"{i + 1}-{j + 1}")
    for note, where in notes.items():
        print(f"note ({', '.join(where)}): {note}")
    return _code(list(found.values()))


def _cell(comparison: Comparison) -> str:
    chances = [c.verdict.probability for c in comparison.cameras if c.verdict is not None]
    if not chances:
        return comparison.verdict
    least = comparison.least_px
    return f"{comparison.verdict} {min(chances):.1g}" + ("" if least is None else f" {least:.1f}")


def _compare(args: argparse.Namespace, a: str, b: str) -> Comparison:
    from vical_daemon.offline.compare import DISTANCES_M, compare

    return compare(a, b, camera=args.camera, distances_m=tuple(args.distance or DISTANCES_M))


def _code(comparisons: list[Comparison]) -> int:
    verdicts = {comparison.verdict for comparison in comparisons}
    if "changed" in verdicts:
        return EXIT_CHANGED
    return 0 if verdicts == {"same"} else EXIT_CANNOT_TELL
