"""Writing a sheet as SVG or PDF; both in true size and the same for the same board, byte for byte."""

from __future__ import annotations

from io import BytesIO
from xml.sax.saxutils import escape

from vical_daemon.vision.board_sheet import Sheet

POINTS_PER_MM = 72.0 / 25.4  # of PDF


def to_svg(sheet: Sheet) -> str:
    """Return an SVG document, one user unit per millimetre."""
    width, height = sheet.size_mm
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}">',
        f'<rect width="{width:g}" height="{height:g}" fill="white"/>',
        '<g fill="black" shape-rendering="crispEdges">',
    ]
    for x, y, w, h in sheet.black:
        lines.append(f'<rect x="{x:.6f}" y="{height - y - h:.6f}" width="{w:.6f}" height="{h:.6f}"/>')
    lines.append('</g>\n<g fill="black" font-family="sans-serif">')
    for text in sheet.texts:
        anchor = ' text-anchor="middle"' if text.centred else ""
        lines.append(
            f'<text x="{text.x_mm:.3f}" y="{height - text.y_mm:.3f}" font-size="{text.height_mm:g}"{anchor}>'
            f"{escape(text.words)}</text>"
        )
    lines.append("</g>\n</svg>\n")
    return "\n".join(lines)


def to_pdf(sheet: Sheet, title: str) -> bytes:
    """Return a PDF document of one page."""
    from reportlab.pdfgen.canvas import Canvas

    buffer = BytesIO()
    size = (sheet.size_mm[0] * POINTS_PER_MM, sheet.size_mm[1] * POINTS_PER_MM)
    canvas = Canvas(buffer, pagesize=size, invariant=1, pageCompression=0)
    canvas.setTitle(title)
    canvas.setViewerPreference("PrintScaling", "None")
    canvas.setFillGray(0)
    for rectangle in sheet.black:
        canvas.rect(*(value * POINTS_PER_MM for value in rectangle), stroke=0, fill=1)
    for text in sheet.texts:
        canvas.setFont("Helvetica", text.height_mm * POINTS_PER_MM)
        draw = canvas.drawCentredString if text.centred else canvas.drawString
        draw(text.x_mm * POINTS_PER_MM, text.y_mm * POINTS_PER_MM, text.words)
    canvas.save()
    return buffer.getvalue()
