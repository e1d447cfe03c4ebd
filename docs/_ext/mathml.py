"""Sphinx: formulas as MathML, written by docutils. Pages need neither the internet nor a TeX installation."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

_LOGGER = logging.getLogger(__name__)
_AS_DOCUTILS_READS_IT = (
    (r"\{align\*?\}", "{aligned}"),  # it has amsmath's `aligned` only
    (r"(\\[dt]?frac) ?(\d)(\d)", r"\1{\2}{\3}"),  # it takes \tfrac12 b for 12 over b
    (r"(\\(?:hat|bar|dot)(?:\{[^}]*\}|\\[a-z]+| ?[a-zA-Z]))_", r"\1{}_"),  # it sets \hat x_i below x
)


def _visit_inline(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node, block=False))
    raise nodes.SkipNode


def _visit_block(self: Any, node: nodes.math_block) -> None:
    self.body.append(f'<div class="math">{_mathml(node, block=True)}</div>')
    raise nodes.SkipNode


def _mathml(node: nodes.math | nodes.math_block, *, block: bool) -> str:
    """Translate a formula. One that docutils does not know is a warning, and `make docs` fails."""
    latex = node.astext()
    for pattern, replacement in _AS_DOCUTILS_READS_IT:
        latex = re.sub(pattern, replacement, latex)
    try:
        return str(latex2mathml.tex2mathml(latex, as_block=block))
    except MathError as error:
        _LOGGER.warning("formula %s: %s", latex, error, location=node)
        return ""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer under the name `mathml`."""
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
