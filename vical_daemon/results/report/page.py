"""Layout of the report: HTML and CSS without any outside resource, readable on a phone, printable to PDF."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

CSS = """
:root{--ink:#1d2433;--soft:#5b6578;--line:#dfe4ec;--paper:#fff;--tint:#f5f7fa}
*{box-sizing:border-box}
body{margin:0;background:var(--tint);color:var(--ink);font:15px/1.5 system-ui,"Segoe UI",Roboto,sans-serif}
main{max-width:1040px;margin:0 auto;padding:24px 16px 48px}
header{display:flex;flex-wrap:wrap;align-items:baseline;gap:12px;margin-bottom:8px}
h1{font-size:26px;margin:0}h2{font-size:19px;margin:32px 0 8px}h3{font-size:15px;margin:16px 0 6px}
section,.card{background:var(--paper);border:1px solid var(--line);border-radius:10px}
section,.card{padding:14px 18px;margin:12px 0}
.pill{padding:3px 12px;border-radius:99px;font-weight:600;color:#fff;background:#7a8394}
.converged{background:#0b8457}.converging,.initialising,.waiting{background:#2468b2}
.degenerate{background:#b35c00}.inconsistent{background:#b3261e}
.note{color:var(--soft);margin:2px 0 0}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:5px 10px 5px 0;border-bottom:1px solid var(--line);vertical-align:top}
th{font-weight:600;color:var(--soft);font-size:13px}
td.n,th.n{text-align:right}
td:last-child:not(.n){overflow-wrap:anywhere}
.pair td,th{white-space:nowrap}
.warn{border-left:4px solid #b35c00;background:#fff7ec}
.bad{border-left:4px solid #b3261e;background:#fdf0ef}
ul{margin:4px 0;padding-left:20px}
figure{margin:10px 0}figure img{width:100%;height:auto;display:block}
figcaption{color:var(--soft);font-size:13px}
code,pre{font:13px/1.45 ui-monospace,Menlo,Consolas,monospace}
pre{white-space:pre-wrap;overflow-wrap:anywhere;background:var(--tint);padding:10px;border-radius:8px}
.scroll{overflow-x:auto}
.pair{display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start}.pair>*{flex:1 1 320px}
.pair figure{flex:0 1 300px}.pair>.scroll{flex:3 1 460px}
@media print{body{background:#fff;font-size:12px}main{max-width:none;padding:0}
section,.card{break-inside:avoid;border:none;padding:4px 0}h2{break-after:avoid}}
@page{margin:14mm}
"""


def document(title: str, body: Iterable[str]) -> str:
    """Wrap the parts of a page into a complete HTML document."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{CSS}</style></head>\n<body><main>\n"
        + "\n".join(body)
        + "\n</main></body></html>\n"
    )


def header(title: str, status: str, reason: str, facts: Sequence[str]) -> str:
    """Return the head of the page: title, status as a coloured word, why, and a line of facts."""
    known = status if status.isalpha() else "unknown"
    reason_line = f'<p class="note">{escape(reason)}</p>' if reason else ""
    return (
        f'<header><h1>{escape(title)}</h1><span class="pill {known}">{escape(status)}</span></header>'
        f'{reason_line}<p class="note">{escape(" · ".join(facts))}</p>'
    )


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numeric_from: int = 1) -> str:
    """Return a table; columns from `numeric_from` on are aligned right. Cells are escaped."""

    def cell(tag: str, i: int, text: str) -> str:
        kind = ' class="n"' if i >= numeric_from else ""
        return f"<{tag}{kind}>{escape(text)}</{tag}>"

    top = "".join(cell("th", i, text) for i, text in enumerate(head))
    lines = "".join("<tr>" + "".join(cell("td", i, text) for i, text in enumerate(r)) + "</tr>" for r in rows)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table></div>'


def section(title: str, *parts: str) -> str:
    """Return a titled part of the page."""
    return f"<h2>{escape(title)}</h2><section>{''.join(parts)}</section>"


def warnings(lines: Sequence[str], *, bad: bool = False) -> str:
    """Return a box of warnings; nothing for none."""
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<div class="card {"bad" if bad else "warn"}"><ul>{items}</ul></div>'


def figure(source: str, alt: str, caption: str = "") -> str:
    """Return an image with its caption; `source` is a data URI."""
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img src="{source}" alt="{escape(alt)}">{text}</figure>'


def preformatted(text: str) -> str:
    """Return text as it is, in a box."""
    return f"<pre>{escape(text)}</pre>"


def side_by_side(*parts: str) -> str:
    """Return parts next to each other where the page is wide enough."""
    return f'<div class="pair">{"".join(parts)}</div>'
