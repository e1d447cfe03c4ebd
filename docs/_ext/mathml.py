"""Sphinx: formulas as MathML, written by docutils. Pages need neither the internet nor a TeX installation."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

_LOGGER = logging.getLogger(__name__)


def _visit_inline(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node, block=False))
    raise nodes.SkipNode


def _visit_block(self: Any, node: nodes.math_block) -> None:
    self.body.append(f'<div class="math">{_mathml(node, block=True)}</div>')
    raise nodes.SkipNode


def _mathml(node: nodes.math | nodes.math_block, *, block: bool) -> str:
    """Translate a formula. One that docutils does not know is a warning, and `make docs` fails."""
    latex = re.sub(r"\{align\*?\}", "{aligned}", node.astext())  # docutils has amsmath's `aligned` only
    try:
        return str(latex2mathml.tex2mathml(latex, as_block=block))
    except MathError as error:
        _LOGGER.warning("formula %s: %s", latex, error, location=node)
        return ""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer under the name `mathml`."""
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
