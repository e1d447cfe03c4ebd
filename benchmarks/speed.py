"""CPU time and that of peers in the same run, one thread each: medians, and how they grow."""

from __future__ import annotations

import argparse

from benchmarks import speed_detection, speed_estimator

PARTS = {"detection": speed_detection.run, "estimator": speed_estimator.run}
"""Each prints its Markdown tables; the argument is the number of images a sequence has."""


def main(argv: list[str]) -> int:
    """Run the parts named, or all."""
    parser = argparse.ArgumentParser(prog="benchmarks speed", description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; none: all")
    parser.add_argument("--frames", type=int, default=12, help="images of a sequence")
    args = parser.parse_args(argv)
    unknown = [name for name in args.parts if name not in PARTS]
    if unknown:
        parser.error(f"no part {unknown[0]!r}; there are: {', '.join(PARTS)}")
    for name in args.parts or PARTS:
        PARTS[name](args.frames)
    return 0
