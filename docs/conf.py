"""Sphinx: Markdown pages (MyST); reference pages are made from the code by `_ext/vical_reference.py`."""

import sys
from importlib.metadata import version as package_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "vical"
author = "the vical authors"
copyright = "the vical authors, Apache-2.0"
release = version = package_version("vical")

extensions = ["myst_parser", "vical_reference", "mathml"]
html_math_renderer = "mathml"
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "_ext"]
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"vical {release}"
html_static_path = ["_static"]
html_css_files = ["formulas.css"]
html_copy_source = False
