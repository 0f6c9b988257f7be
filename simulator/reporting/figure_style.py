"""The style of the report's figures: the widths of a two-column paper, inline SVG for the page and files for print."""

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

# The widths of one column and of both columns of a two-column paper.
SINGLE_IN, DOUBLE_IN = 3.5, 7.16

RC: dict[Any, Any] = matplotlib.rc_params_from_file(
    Path(__file__).with_name("paper.mplstyle"), use_default_template=False
)
# The formats for print, without the metadata that differ between runs.
_UNDATED: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
# Colours of the page's theme, in place of those that are right on white paper only.
_THEMED = {"#ffffff": "var(--card)", "#000000": "var(--ink)", "#222222": "var(--ink)", "#dddddd": "var(--line)"}


@dataclass(eq=False)
class PaperFigure:
    """One figure in a paper's width; ``inline`` is its SVG for the page, once it is drawn."""

    name: str
    figure: Figure
    inline: str = ""

    def write(self, folder: Path) -> list[Path]:
        """Write ``NAME.svg`` and ``NAME.pdf`` with reproducible bytes; raises ``OSError``."""
        written = [folder / f"{self.name}.{kind}" for kind in _UNDATED]
        with matplotlib.style.context(["default", {**RC, "svg.hashsalt": self.name}]):
            for path, metadata in zip(written, _UNDATED.values(), strict=True):
                self.figure.savefig(path, metadata=metadata)
        return written


@contextmanager
def paper_figure(name: str, height_in: float, panels: tuple[int, int]) -> Iterator[tuple[PaperFigure, list[Axes]]]:
    """Yield a new figure and its panels, which are drawn within the context; one panel fills one column."""
    # A constant salt makes the IDs, and so the whole text, the same on every run.
    with matplotlib.style.context(["default", {**RC, "svg.hashsalt": name}]):
        width_in = SINGLE_IN if panels == (1, 1) else DOUBLE_IN
        figure = Figure(figsize=(width_in, height_in), layout="compressed")
        drawn = PaperFigure(name, figure)
        yield drawn, list(figure.subplots(*panels, squeeze=False).flat)
        drawn.inline = _inline_svg(figure, name, width_in)


def _inline_svg(figure: Figure, name: str, width_in: float) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata=_UNDATED["svg"])
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # Every figure numbers its parts from 1, but on the page all IDs share one namespace.
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'href="#', f'href="#{name}-', svg)
    svg = re.sub(r"url\(#", f"url(#{name}-", svg)
    for on_paper, themed in _THEMED.items():
        svg = svg.replace(f": {on_paper}", f": {themed}")
    # Its share of the page's width, so that letters have the same size in all figures.
    width = "double" if width_in == DOUBLE_IN else "single"
    share = f'class="{width}" style="max-width: {100 * width_in / DOUBLE_IN:.0f}%"'
    svg = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', share, svg, count=1)
    return svg.replace("<svg", f'<svg role="img" aria-labelledby="{name}-caption"', 1)
