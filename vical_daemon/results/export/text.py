"""Writes numbers and matrices so that every YAML reader reads them correctly."""

from __future__ import annotations

from collections.abc import Iterable

from vical_daemon.estimation.measurements import FloatArray


def number(value: float) -> str:
    """Write a float so that YAML 1.1, YAML 1.2 and OpenCV all read a float.

    PyYAML takes ``1e-05`` for text (no point in it) and OpenCV takes ``458`` for an integer, on which
    ORB-SLAM3 exits: so there is always a point. 12 digits are kept.

    >>> number(1e-5), number(458), number(-0.0)
    ('1.0e-05', '458.0', '0.0')
    """
    text = f"{float(value) + 0.0:.12g}"
    mantissa, _, exponent = text.partition("e")
    if "." not in mantissa:
        mantissa += ".0"
    return f"{mantissa}e{exponent}" if exponent else mantissa


def row(values: Iterable[float]) -> str:
    """Write numbers as a flow sequence.

    >>> row([1, 0.5])
    '[1.0, 0.5]'
    """
    return "[" + ", ".join(number(v) for v in values) + "]"


def matrix_rows(matrix: FloatArray, indent: int) -> str:
    """Write a matrix as a block sequence of rows (Kalibr's form), each line indented."""
    pad = " " * indent
    return "\n".join(f"{pad}- {row(line)}" for line in matrix)


def opencv_matrix(matrix: FloatArray, kind: str = "d") -> str:
    """Write the body of an ``!!opencv-matrix`` node; `kind` is d (float64) or f (float32)."""
    pad = " " * 3
    rows, cols = matrix.shape
    lines = ",\n".join(" " * 10 + ", ".join(number(v) for v in line) for line in matrix).lstrip()
    return f"{pad}rows: {rows}\n{pad}cols: {cols}\n{pad}dt: {kind}\n{pad}data: [ {lines} ]"


def comment(text: str) -> str:
    """Write lines of text as YAML comments; nothing for an empty text."""
    return "".join(f"# {line}\n" for line in text.splitlines())
