"""How the report's figures are drawn: in a two-column paper's widths, inline for the page and as files for print."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# One column of a two-column paper, and both.
SINGLE_IN, DOUBLE_IN = 3.5, 7.16

RC: dict[Any, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Helvetica", "Arial", "sans-serif"],
    "font.size": 8.5,
    "axes.labelsize": 8.5,
    "axes.titlesize": 9,
    "axes.linewidth": 0.8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "text.parse_math": False,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
    "savefig.bbox": None,
    # Text stays text, in fonts that are embedded.
    "pdf.fonttype": 42,
}
# Without what would change from run to run; the formats of print.
_UNDATED: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


@dataclass(frozen=True, eq=False)
class Drawing:
    """One figure, drawn in a paper's width. ``inline`` is its SVG for the page."""

    name: str
    figure: Figure
    inline: str

    def write(self, folder: Path) -> list[Path]:
        """``NAME.svg`` and ``NAME.pdf``, the same bytes each time; raises ``OSError``."""
        written = [folder / f"{self.name}.{kind}" for kind in _UNDATED]
        with matplotlib.style.context(["default", {**RC, "svg.hashsalt": self.name}]):
            for path, metadata in zip(written, _UNDATED.values(), strict=True):
                self.figure.savefig(path, metadata=metadata)
        return written


@contextmanager
def drawn(name: str, height_in: float, panels: tuple[int, int], out: list[Drawing]) -> Iterator[list[Axes]]:
    """Yields a figure's panels, and when they are drawn puts the figure into ``out``: one panel fills one column."""
    # A constant salt makes the ids, and so the whole text, the same on every run.
    with matplotlib.style.context(["default", {**RC, "svg.hashsalt": name}]):
        width_in = SINGLE_IN if panels == (1, 1) else DOUBLE_IN
        figure = Figure(figsize=(width_in, height_in), layout="compressed")
        yield list(figure.subplots(*panels, squeeze=False).flat)
        out.append(Drawing(name, figure, _inline_svg(figure, name, width_in)))


def _inline_svg(figure: Figure, name: str, width_in: float) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata=_UNDATED["svg"])
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # Every figure numbers its parts from 1; inline, the ids of all share one page.
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'href="#', f'href="#{name}-', svg)
    svg = re.sub(r"url\(#", f"url(#{name}-", svg)
    # As wide as its share of the page, so that letters are of one size in all figures.
    share = f'style="max-width: {100 * width_in / DOUBLE_IN:.0f}%"'
    svg = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', share, svg, count=1)
    return svg.replace("<svg", f'<svg role="img" aria-labelledby="{name}-caption"', 1)
