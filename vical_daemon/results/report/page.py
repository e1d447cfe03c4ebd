"""Layout of the report: HTML without any outside resource, readable on a phone, in the dark and on paper."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from vical_daemon.results.report.scene import SCRIPT as SCENE_SCRIPT
from vical_daemon.results.report.verdict import Verdict

_HERE = Path(__file__).parent
# Colours of the figures that follow the page's, which may be dark.
_THEME = {
    "#1d2433": "var(--ink)",
    "#8a93a6": "var(--soft)",
    "#e3e7ee": "var(--line)",
    "#c3cad6": "var(--edge)",
    "#d55e00": "var(--x)",
    "#009e73": "var(--y)",
    "#0072b2": "var(--z)",
}
_CLUTTER = re.compile(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>|<style.*?</style>", re.DOTALL)
_SIZE = re.compile(r'<svg([^>]*?) width="([\d.]+)pt" height="[\d.]+pt"')
_SHOWN_WIDTH = 1.44  # pixels of the page for each point of a figure, on a desk


def document(title: str, body: Iterable[str]) -> str:
    """Wrap the parts of a page into a complete HTML document."""
    style = (_HERE / "style.css").read_text(encoding="utf-8")
    scripts = [path.read_text(encoding="utf-8") for path in (SCENE_SCRIPT, _HERE / "report.js")]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style></head>\n<body><main>\n"
        + "\n".join(body)
        + "\n</main>\n"
        + "".join(f"<script>\n{script}</script>\n" for script in scripts)
        + "</body></html>\n"
    )


def head(title: str, status: str, said: Verdict, facts: Sequence[str], kind: str = "") -> str:
    """Return the head of the page: verdict, what to do, and a line of facts; `kind` chooses its colour."""
    kind = kind or (status if status.isalpha() else "unknown")
    known = "".join(f'<p class="known">{escape(line)}</p>' for line in said.known)
    advice = "".join(f"<li>{_sentence(line)}</li>" for line in said.advice)
    return (
        f'<header><h1>{escape(title)}</h1><span class="pill {kind}">{escape(status)}</span></header>'
        f'<div class="card verdict {kind}"><p class="word">{escape(said.word)}</p>{known}'
        + (f"<ul>{advice}</ul>" if advice else "")
        + f'<p class="note">{escape(" · ".join(facts))}</p></div>'
    )


def _sentence(text: str) -> str:
    """Return text as HTML, with a full stop; what stands in backticks becomes code.

    >>> _sentence("remove `fix`")
    'remove <code>fix</code>.'
    """
    whole = text if text.endswith((".", "?")) else f"{text}."
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(whole))


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numeric_from: int = 1) -> str:
    """Return a table; columns from `numeric_from` on are aligned right. Cells are escaped."""

    def cell(tag: str, i: int, text: str) -> str:
        kind = ' class="n"' if i >= numeric_from else ' class="w"' if tag == "td" and i else ""
        return f"<{tag}{kind}>{escape(text)}</{tag}>"

    top = "".join(cell("th", i, text) for i, text in enumerate(head))
    lines = "".join("<tr>" + "".join(cell("td", i, text) for i, text in enumerate(r)) + "</tr>" for r in rows)
    kind = "" if numeric_from < len(head) else " lines"
    return (
        f'<div class="scroll"><table class="table{kind}"><thead><tr>{top}</tr></thead>'
        f"<tbody>{lines}</tbody></table></div>"
    )


def section(title: str, *parts: str) -> str:
    """Return a titled part of the page."""
    return f"<h2>{escape(title)}</h2><section>{''.join(parts)}</section>"


def warning(text: str) -> str:
    """Return a box with a warning."""
    return f'<div class="card warn">{escape(text)}</div>'


def note(text: str) -> str:
    """Return a line of small text."""
    return f'<p class="note">{escape(text)}</p>'


def figure(name: str, drawings: Sequence[str], alt: str, caption: str = "") -> str:
    """Return SVG files side by side, or one below the other where the page is narrow.

    Their colours become those of the page, and their ids unique in it.
    """
    panels = "".join(_inline(svg, f"{name}-{i}") for i, svg in enumerate(drawings))
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure aria-label="{escape(alt)}"><div class="panels">{panels}</div>{text}</figure>'


def _inline(svg: str, prefix: str) -> str:
    svg = _CLUTTER.sub("", svg)
    for colour, variable in _THEME.items():
        svg = svg.replace(colour, variable)
    prefix = re.sub(r"\W", "", prefix)
    svg = re.sub(r'\bid="', f'id="{prefix}', svg)
    svg = re.sub(r'(href="#|url\(#)', rf"\g<1>{prefix}", svg)

    def sized(match: re.Match[str]) -> str:
        width = float(match.group(2)) * _SHOWN_WIDTH
        flow = f"flex:{width:.0f} 1 {0.55 * width:.0f}px;max-width:{width:.0f}px"
        return f'<svg{match.group(1)} role="img" style="{flow}"'

    return _SIZE.sub(sized, svg, count=1).strip()


def preformatted(text: str) -> str:
    """Return text as it is, in a box."""
    return f"<pre>{escape(text)}</pre>"


def copyable(text: str) -> str:
    """Return text as it is, in a box with a button that copies it."""
    return f'<div class="matrix"><pre>{escape(text)}</pre><button class="copy">copy</button></div>'


def scene(document: dict[str, Any]) -> str:
    """Return a 3-D view with its buttons."""
    data = json.dumps(document, separators=(",", ":")).replace("<", "\\u003c")
    rooms = ""
    if "board" in document:
        rooms = '<button data-room="0" class="on">rig</button><button data-room="1">board and path</button>'
    gains = "".join(
        f'<button data-gain="{gain}"{" class=on" if gain == 1 else ""}>sigma × {gain}</button>'
        for gain in (1, 10, 100)
    )
    return (
        f'<div class="scene"><script type="application/json">{data}</script>'
        '<canvas role="img" tabindex="0" aria-label="3-D view of IMU, camera and board; '
        'arrow keys rotate it, plus and minus zoom"></canvas>'
        f"<p>{rooms}{gains}</p>"
        '<p class="note">Drag to rotate, scroll or pinch to zoom. Red, 1 sigma: position of the camera, '
        "and of the tips of its axes.</p></div>"
    )


def side_by_side(*parts: str) -> str:
    """Return parts next to each other where the page is wide enough."""
    return f'<div class="pair">{"".join(parts)}</div>'


def grid(parts: Iterable[str]) -> str:
    """Return figures in as many columns as the page has room for."""
    return f'<div class="shots">{"".join(parts)}</div>'
