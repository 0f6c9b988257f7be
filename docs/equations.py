"""Equations as SVG, drawn when the pages are built: MkDocs calls this for each page (`hooks` in mkdocs.yml).

A browser draws MathML well only with a font for it, and scripts that draw equations come from other hosts.
"""

from __future__ import annotations

import html
import re
from typing import Any
from xml.etree import ElementTree

import ziamath

# The output of pymdownx.arithmatex in `generic` mode.
_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
_SIZE = 17.0
# Every drawing has its own glyphs: shared symbols would have the same names on a page and differ.
ziamath.config.svg2 = False


def on_page_content(content: str, **_: Any) -> str:
    """A page's HTML with drawings in place of its LaTeX."""
    content = _BLOCK.sub(lambda found: f'<p class="equation">{_drawn(found[1], inline=False)}</p>', content)
    return _INLINE.sub(lambda found: _drawn(found[1], inline=True), content)


def _drawn(escaped: str, inline: bool) -> str:
    latex = html.unescape(escaped).strip()
    drawing = ziamath.Latex(latex, size=_SIZE, color="currentColor", inline=inline)
    svg = drawing.svgxml()
    # Align the equation's baseline with the text's.
    svg.set("style", f"vertical-align: {drawing.getyofst() - drawing.margin:.2f}px")
    svg.set("role", "img")
    svg.set("aria-label", latex)
    return ElementTree.tostring(svg, encoding="unicode")
