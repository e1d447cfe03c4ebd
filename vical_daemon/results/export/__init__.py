"""Exports results in the formats of other software, and reads Kalibr's files.

One `Rig` (plain data) in between: readers make it, writers turn it into text. Each writer states in its
docstring which way its transform and its time shift point; `docs/how-to/export.md` has them side by side.
"""

from __future__ import annotations

from vical_daemon.results.export.formats import FORMATS, ExportFile, export
from vical_daemon.results.export.rig import ExportError, Rig, RigCamera
from vical_daemon.results.export.sources import rig_from_estimate, rig_from_json

__all__ = [
    "FORMATS",
    "ExportError",
    "ExportFile",
    "Rig",
    "RigCamera",
    "export",
    "rig_from_estimate",
    "rig_from_json",
]
