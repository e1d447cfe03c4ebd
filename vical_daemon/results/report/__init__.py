"""The calibration report: one self-contained HTML file.

`write_report` is what `vical calibrate --report` calls. Figures are drawn by `figures`, residual
statistics computed by `residuals`, the page laid out by `page`, and what is needed to reproduce the
result collected by `provenance`.
"""

from __future__ import annotations

from vical_daemon.results.report.provenance import Provenance, collect
from vical_daemon.results.report.residuals import FrameResiduals
from vical_daemon.results.report.writer import ReportError, write_report

__all__ = ["FrameResiduals", "Provenance", "ReportError", "collect", "write_report"]
