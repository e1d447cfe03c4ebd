"""Reference pages made from the code at build time: topics, settings, commands, modules.

Each is a directive that writes Markdown (`reference_text`) and has it parsed in place, so nothing generated
lies in git.
"""

from __future__ import annotations

from typing import Any

import reference_text
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class _Generated(SphinxDirective):
    """A directive whose content is Markdown made by `make`."""

    make: Any = None

    def run(self) -> list[nodes.Node]:
        """Parse the generated text where the directive stands; anew each time: the source may differ."""
        self.env.note_reread()
        return self.parse_text_to_nodes(type(self).make(), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    for name, function in (
        ("vical-topics", reference_text.topics_table),
        ("vical-causes", reference_text.causes_table),
        ("vical-messages", reference_text.messages_text),
        ("vical-config", reference_text.config_text),
        ("vical-commands", reference_text.commands_text),
        ("vical-modules", reference_text.modules_text),
    ):
        app.add_directive(name, type(name, (_Generated,), {"make": staticmethod(function)}))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
