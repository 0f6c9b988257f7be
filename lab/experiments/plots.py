"""The figures of a ``results.json`` in a two-column paper's width: PNG, SVG and PDF with reproducible bytes.

Bands and whiskers are 95% intervals over seeds; small dots are single seeds. A scheme has the same colour, dash and
marker in every figure (see ``LOOKS``).
"""

from __future__ import annotations

import itertools
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib import figure as mpl
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator, SymmetricalLogLocator

from lab.experiments.result import Figure, Interval, Result
from simulator.reporting.figure_style import DOUBLE_IN, RC, SINGLE_IN
from simulator.reporting.figures import BLUE, GREEN, INK, ORANGE, POLICIES, PURPLE, RED, SKY, plain
from simulator.reporting.wording import NAMES

Format = Literal["png", "svg", "pdf"]
FORMATS: tuple[Format, ...] = ("png", "svg", "pdf")
# The ratio of the largest to the smallest mean from which an axis is logarithmic: on a linear one, the shortest bars
# would be invisible.
LOG_PAST = 30.0
# The ratio of the smallest to the largest mean from which points replace bars, which would all have similar lengths.
ALIKE = 0.75
BOUND_LABEL = "clairvoyant bound (proven)"

Style = tuple[str, Any, str]
# Colour, dash and marker of each scheme.
LOOKS: dict[str, Style] = {
    **POLICIES,
    "longest_queue_fast": (ORANGE, (0, (1, 1)), "p"),
    "queue_and_channel_fast": (GREEN, "-.", "<"),
    "madqn": (RED, "-", "P"),
    "madqn_paper": (RED, "--", "P"),
    "mappo": (PURPLE, "-", "*"),
    "bound": (INK, (0, (4, 2)), "|"),
    "llm": (BLUE, "-", "o"),
    "guided": (BLUE, "--", "d"),
    "value": (BLUE, ":", "8"),
    "value_reach": (SKY, "-", "8"),
    "edge_policy": (BLUE, "-.", "H"),
    "edge_planner": (INK, "-.", "h"),
    "guided_chance": (PURPLE, "--", "1"),
    "guided_worst": (RED, "--", "2"),
    "guided_alone": (BLUE, "-.", "d"),
    "guided_alone_chance": (PURPLE, ":", "1"),
    "guided_alone_worst": (RED, ":", "2"),
    "llm_all": (SKY, "--", "s"),
    "llm_random_start": (SKY, "-", "^"),
    "llm_chance": (SKY, ":", "1"),
    "value_random_start": (GREEN, "--", "D"),
}
BOUND = LOOKS["bound"]

PRINT: dict[Any, Any] = {
    **RC,
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.5,
    "savefig.bbox": None,
    "savefig.dpi": 300,
    "pdf.fonttype": 42,
}
# Removes the metadata that differ between runs or between matplotlib's versions.
_UNDATED: dict[str, dict[str, Any]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
# Styles of schemes without an entry in LOOKS, all different.
_OTHERS: tuple[Style, ...] = tuple(
    (colour, dash, marker)
    for dash, markers in (("-", "sd^vX"), ("--", "oP<>*"), (":", "Dh8pv"), ("-.", "X^sod"))
    for colour, marker in zip((SKY, ORANGE, GREEN, RED, PURPLE), markers, strict=True)
)


def draw(result: Result, out: Path, formats: Sequence[Format] = FORMATS) -> list[Path]:
    """Draw every figure of ``result`` into the folder ``out``, one file a figure and format.

    A measure's panel omits schemes without it, and numbers that are not finite. A figure without any measured number is
    not drawn.

    Raises:
        ValueError: a figure asks for a sweep and the result has none.
        OSError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    drawn: list[Path] = []
    for figure in result.figures:
        # A constant salt makes the IDs, and so the whole text, the same on every run.
        with matplotlib.style.context(["default", {**PRINT, "svg.hashsalt": f"{result.experiment}-{figure.name}"}]):
            picture = _DRAWN_BY[figure.kind](result, figure)
            if picture is None:
                continue
            for kind in formats:
                path = out / f"{figure.name}.{kind}"
                picture.savefig(path, format=kind, metadata=_UNDATED[kind])
                drawn.append(path)
                if kind == "svg":
                    path.write_text(rounded(path.read_text(encoding="utf-8")), encoding="utf-8")
    return drawn


def rounded(svg: str) -> str:
    """The SVG with coordinates rounded to a hundredth of a point, a third smaller without a visible difference."""

    def shorter(attribute: re.Match[str]) -> str:
        return re.sub(r"\d+\.\d{3,}", lambda number: f"{float(number[0]):.2f}", attribute[0])

    return re.sub(r'\b(?:d|x|y)="[^"]*"', shorter, svg)


def label_of(result: Result, name: str) -> str:
    """The label of a scheme or a measure; with the number of seeds for a scheme that flew fewer than the rest."""
    label = result.labels.get(name) or NAMES.get(name) or name.replace("_", " ")
    return f"{label} ({len(result.seeds_of[name])} seeds)" if name in result.seeds_of else label


def styles(result: Result) -> dict[str, Style]:
    """Colour, dash and marker of every scheme, all different."""
    names = [*result.schemes, *(name for name in result.curves if name not in result.schemes)]
    others = (style for style in _OTHERS * (1 + len(names) // len(_OTHERS)) if style not in LOOKS.values())
    return {name: LOOKS[name] if name in LOOKS else next(others) for name in names}


def measured(result: Result, name: str, measure: str) -> Interval | None:
    """The scheme's interval of the measure; ``None`` for a missing one or one that is not finite."""
    found = result.schemes.get(name, {}).get(measure)
    return found if found and _finite(found.mean, found.low, found.high) else None


def _finite(*numbers: float) -> bool:
    return all(math.isfinite(number) for number in numbers)


def _bound_of(result: Result, measure: str) -> float | None:
    found = result.bound.get(measure)
    return found.mean if found and _finite(found.mean) else None


def _columns(figure: Figure) -> int:
    return {1: 1, 2: 2, 4: 2}.get(len(figure.measures), 3)


def _panels(figure: Figure, panel_in: float, below_in: float) -> tuple[mpl.Figure, list[Axes]]:
    count, columns = len(figure.measures), _columns(figure)
    rows = -(-count // columns)
    width = SINGLE_IN if count == 1 else DOUBLE_IN
    picture = mpl.Figure(figsize=(width, rows * panel_in + below_in), layout="constrained")
    axes = list(picture.subplots(rows, columns, squeeze=False).flat)
    for extra in axes[count:]:
        extra.remove()
    return picture, axes[:count]


def _curves(result: Result, figure: Figure) -> mpl.Figure | None:
    looks = styles(result)
    shown = [name for name in result.curves if set(figure.measures) & result.curves[name].keys()]
    if not shown:
        return None
    bounded = [measure for measure in figure.measures if _bound_of(result, measure) is not None]
    width = SINGLE_IN if len(figure.measures) == 1 else DOUBLE_IN
    below = _legend_in(len(shown) + bool(bounded), width)
    picture, panels = _panels(figure, 2.0, below)
    for axes, measure in zip(panels, figure.measures, strict=True):
        for position, name in enumerate(shown):
            _one_curve(axes, result, name, measure, looks[name], position)
        _bound_line(axes.axhline, result, measure)
        _frame(axes, label_of(result, measure))
        _scale(axes.yaxis, [max(result.curves[name][measure].mean) for name in shown if measure in result.curves[name]])
        axes.set_xlabel("step")
        axes.xaxis.set_major_locator(MaxNLocator(nbins=7, integer=True, steps=[1, 2, 5, 10]))
    _legend(picture, [_key(label_of(result, name), looks[name]) for name in shown], bool(bounded), width)
    return picture


def _one_curve(axes: Axes, result: Result, name: str, measure: str, look: Style, position: int) -> None:
    curve = result.curves[name].get(measure)
    if curve is None:
        return
    colour, dash, marker = look
    # Steps without a measurement are NaN, which would interrupt the line and the band.
    triples = zip(curve.mean, curve.low, curve.high, strict=True)
    points = np.array([(at, *row) for at, row in enumerate(triples) if _finite(*row)], dtype=float).reshape(-1, 4)
    at, mean, low, high = points.T
    every = max(1, len(at) // 6)
    axes.fill_between(at, low, high, color=colour, alpha=0.14 if len(result.curves) <= 8 else 0.08, linewidth=0)
    # Offset markers keep coinciding lines distinguishable.
    axes.plot(at, mean, color=colour, linestyle=dash, marker=marker, markevery=(position % every, every))


def _bars(result: Result, figure: Figure) -> mpl.Figure | None:
    looks = styles(result)
    first = figure.measures[0]
    shown = [name for name in result.schemes if any(measured(result, name, m) for m in figure.measures)]
    if not shown:
        return None
    shown.sort(key=lambda name: found.mean if (found := measured(result, name, first)) else math.inf)
    labels = [textwrap.fill(label_of(result, name), 28) for name in shown]
    lines = sum(1 + label.count("\n") for label in labels)
    bounded = any(_bound_of(result, measure) is not None for measure in figure.measures)
    picture, panels = _panels(figure, 0.55 + 0.15 * max(lines, 4), 0.2 * bounded)
    for position, (axes, measure) in enumerate(zip(panels, figure.measures, strict=True)):
        _bar_panel(axes, result, measure, shown, looks)
        axes.set_yticks(range(len(shown)), labels if position % _columns(figure) == 0 else [""] * len(shown))
        axes.set_ylim(len(shown) - 0.4, -0.6)
    if bounded:
        _legend(picture, [], True, SINGLE_IN if len(panels) == 1 else DOUBLE_IN)
    return picture


def _bar_panel(axes: Axes, result: Result, measure: str, shown: Sequence[str], looks: Mapping[str, Style]) -> None:
    found = {row: i for row, name in enumerate(shown) if (i := measured(result, name, measure))}
    means = [i.mean for i in found.values()]
    bound = _bound_of(result, measure)
    similar = bool(means) and min(means) > ALIKE * max(means) and bound is None
    # Without zero on its axis, or on a logarithmic one, a bar's length has no meaning.
    barred = not (similar or _spans_decades(means))
    for row, interval in found.items():
        colour, _, marker = looks[shown[row]]
        if barred:
            axes.barh(row, interval.mean, height=0.7, color=colour, alpha=0.45, linewidth=0)
        seeds = [value for value in interval.values if _finite(value)]
        if len(seeds) > 1:
            heights = row + np.linspace(-0.26, 0.26, len(seeds))
            axes.plot(seeds, heights, ".", color=colour, markersize=2, alpha=0.6, zorder=3)
        reach = [[max(0.0, interval.mean - interval.low)], [max(0.0, interval.high - interval.mean)]]
        axes.errorbar(
            interval.mean, row, xerr=reach, color=INK, marker=marker, markersize=4, markerfacecolor=colour,
            markeredgewidth=0.5, elinewidth=0.9, capsize=2, zorder=4,
        )  # fmt: skip
    for row in set(range(len(shown))) - found.keys():
        axes.text(0.01, row, "not measured", transform=axes.get_yaxis_transform(), fontsize=6, va="center", color=INK)
    _bound_line(axes.axvline, result, measure)
    plain(axes)
    axes.grid(visible=False, axis="y")
    axes.grid(axis="x", color="#dddddd", linewidth=0.6)
    axes.set_xlabel(textwrap.fill(label_of(result, measure), 34))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
    if not similar and min((i.low for i in found.values()), default=0.0) >= 0:
        axes.set_xlim(left=0)
    _scale(axes.xaxis, means)


def _sweep(result: Result, figure: Figure) -> mpl.Figure | None:
    if result.sweep is None:
        raise ValueError(f"figure {figure.name!r} of {result.experiment!r} is a sweep, but the result has no `sweep`")
    looks = styles(result)
    points = sorted(
        (at, name)
        for name, at in result.sweep.at.items()
        if any(measured(result, name, measure) for measure in figure.measures)
    )
    if not points:
        return None
    unswept = [
        name
        for name in result.schemes
        if name not in result.sweep.at and any(measured(result, name, measure) for measure in figure.measures)
    ]
    bounded = any(_bound_of(result, measure) is not None for measure in figure.measures)
    width = SINGLE_IN if len(figure.measures) == 1 else DOUBLE_IN
    keys = len(unswept) + bounded
    picture, panels = _panels(figure, 2.1, _legend_in(keys, width))
    for axes, measure in zip(panels, figure.measures, strict=True):
        _sweep_panel(axes, result, measure, points)
        for name in unswept:
            if reference := measured(result, name, measure):
                axes.axhspan(reference.low, reference.high, color=looks[name][0], alpha=0.14, linewidth=0)
                axes.axhline(reference.mean, color=looks[name][0], linestyle=looks[name][1])
        _bound_line(axes.axhline, result, measure)
        _frame(axes, label_of(result, measure))
        _scale(axes.yaxis, [i.mean for name in result.schemes if (i := measured(result, name, measure))])
        axes.set_xlabel(result.sweep.label)
    references = [_key(label_of(result, name), (looks[name][0], looks[name][1], "")) for name in unswept]
    _legend(picture, references, bounded, width)
    return picture


def _sweep_panel(axes: Axes, result: Result, measure: str, points: Sequence[tuple[float, str]]) -> None:
    found = [(at, i) for at, name in points if (i := measured(result, name, measure))]
    colour, dash, marker = LOOKS["llm"]
    gap = min((b - a for (a, _), (b, _) in itertools.pairwise(points) if b > a), default=1.0)
    for at, interval in found:
        seeds = [value for value in interval.values if _finite(value)]
        if len(seeds) > 1:
            positions = at + 0.3 * gap * np.linspace(-0.5, 0.5, len(seeds))
            axes.plot(positions, seeds, ".", color=colour, markersize=2, alpha=0.35)
    mean = np.array([i.mean for _, i in found])
    reach = np.array([(max(0.0, i.mean - i.low), max(0.0, i.high - i.mean)) for _, i in found]).reshape(-1, 2).T
    axes.errorbar(
        [at for at, _ in found], mean, yerr=reach, color=colour, linestyle=dash, marker=marker, capsize=2, zorder=4
    )
    axes.set_xticks([at for at, _ in points])


_DRAWN_BY: dict[str, Callable[[Result, Figure], mpl.Figure | None]] = {
    "curves": _curves,
    "bars": _bars,
    "sweep": _sweep,
}


def _spans_decades(means: Sequence[float]) -> bool:
    positive = [mean for mean in means if _finite(mean) and mean > 0]
    return bool(positive) and min(means) >= 0 and max(positive) > LOG_PAST * min(positive)


def _scale(axis: XAxis | YAxis, means: Sequence[float]) -> None:
    """Make the axis logarithmic if the means span decades, with a linear part around zero."""
    if not _spans_decades(means):
        return
    # At most four decades, so that the smallest mean does not compress the rest.
    least = max(min(mean for mean in means if mean > 0), max(means) / 1e4)
    threshold = 10.0 ** math.floor(math.log10(least))
    scale = axis.axes.set_xscale if isinstance(axis, XAxis) else axis.axes.set_yscale
    limit = axis.axes.set_xlim if isinstance(axis, XAxis) else axis.axes.set_ylim
    scale("symlog", linthresh=threshold, linscale=0.5)
    axis.set_major_locator(SymmetricalLogLocator(base=10.0, linthresh=threshold))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    limit(0)


def _frame(axes: Axes, ylabel: str) -> None:
    plain(axes)
    axes.set_ylabel(textwrap.fill(ylabel, 30))
    low, high = axes.dataLim.intervaly
    if axes.get_yscale() == "linear" and 0 <= low <= (1 - ALIKE) * high:
        axes.set_ylim(bottom=0)


def _bound_line(line: Callable[..., Line2D], result: Result, measure: str) -> None:
    value = _bound_of(result, measure)
    if value is not None:
        line(value, color=BOUND[0], linestyle=BOUND[1], linewidth=1.0, zorder=5)


def _key(label: str, look: Style) -> Line2D:
    colour, dash, marker = look
    return Line2D([], [], color=colour, linestyle=dash, marker=marker, label=label)


def _legend_columns(width: float) -> int:
    return 2 if width == SINGLE_IN else 4


def _legend_in(keys: int, width: float) -> float:
    return 0.15 * -(-keys // _legend_columns(width)) + 0.05


def _legend(picture: mpl.Figure, keys: list[Line2D], bounded: bool, width: float) -> None:
    """Add the legend below all panels, where it covers no data."""
    if bounded:
        keys = [*keys, _key(BOUND_LABEL, (BOUND[0], BOUND[1], ""))]
    if keys:
        columns = min(len(keys), _legend_columns(width))
        picture.legend(handles=keys, loc="outside lower center", ncols=columns, handlelength=3.2)
