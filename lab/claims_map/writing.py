"""The claims map in files: the verdicts and the curves as CSV, and the figure."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from lab.claims_map.flights import SCHEMES, Flown
from lab.claims_map.judging import CLAIMS, Judgement, MapClaim, most_held, settled_step
from lab.claims_map.points import RATES, ROWS, VARIANTS, Point, fill_row
from lab.experiments.plots import PRINT, rounded
from shared.world.channel import FloatArray
from simulator.reporting.figure_style import DOUBLE_IN

VERDICTS, CURVES, FIGURE = "claims-map.csv", "claims-map-curves.csv", "claims-map"
Judged = Sequence[tuple[Point, Mapping[str, Judgement]]]

# White where a claim fails, darker the more stand-ins it holds for.
_SHADES = ListedColormap(["#ffffff", "#c6dbef", "#9ecae1", "#6baed6", "#2171b5"])
_MOOT = "#d9d9d9"
_COUNTS = matplotlib.colormaps["Greens"]
# The frames of the settings that are scenarios: the row, the arrivals, and the colour.
_FRAMES = {"paper": (fill_row((0.3, 1.0)), 5.0, "#d62728"), "paper_light": ("step 20 s", 0.5, "#ff9500")}
_NOT_FLOWN: dict[str, Any] = {"facecolor": "#ffffff", "edgecolor": "#cccccc", "hatch": "xxxx"}


def write_verdicts(path: Path, judged: Judged, seeds: int) -> None:
    """Write a line a setting and claim: the schemes for which it holds or fails, and our numbers."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["row", "arrivals", "claim", "stated", "holds_for", "fails_for", "moot", "worlds", "ours"])
        for point, held in judged:
            for claim in CLAIMS:
                found = held[claim.name]
                sides = [" ".join(n for n, holds in found.of.items() if holds is side) for side in (True, False)]
                stated = claim.stated.replace("\n", " ")
                row = [point.row, f"{point.rate:g}", claim.name, stated, *sides, int(found.moot), seeds, found.ours]
                writer.writerow(row)


def write_curves(path: Path, points: Sequence[Point], flights: Sequence[Mapping[str, Flown]]) -> None:
    """Write a line a setting and scheme: the step where it settles, its losses, and the mean lost packets by step."""
    steps = max(point.scenario.steps for point in points)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            ["row", "arrivals", "scheme", "settled", "lost", "failed", "overflows", "commit", *range(steps)]
        )
        for point, flown in zip(points, flights, strict=True):
            for scheme in SCHEMES:
                flight = flown[scheme]
                totals = [f"{part.sum(axis=1).mean():.2f}" for part in (flight.lost, flight.failed, flight.overflows)]
                at, means = settled_step(flight), [f"{mean:.3g}" for mean in flight.lost.mean(axis=0)]
                writer.writerow(
                    [point.row, f"{point.rate:g}", scheme, "" if at is None else at, *totals, flight.commit, *means]
                )


def draw(folder: Path, judged: Judged, seeds: int) -> None:
    """Draw the figure: a panel a claim, and one of their number; a row a setting, a column the mean arrivals."""
    with matplotlib.style.context(["default", {**PRINT, "svg.hashsalt": FIGURE}]):
        figure = Figure(figsize=(DOUBLE_IN, 6.9), layout="constrained")
        panels = list(figure.subplots(3, 4, sharex=True, sharey=True).flat)
        for panel, claim in zip(panels, CLAIMS, strict=False):
            _claim_panel(panel, claim, judged)
        _count_panel(panels[len(CLAIMS)], judged)
        for panel in panels[-4:]:
            panel.set_xlabel("arrivals, packets a step", fontsize=6)
        figure.legend(handles=_keys(), loc="outside lower center", ncols=2, frameon=False, fontsize=7)
        for kind in ("svg", "png"):
            undated = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
            figure.savefig(folder / f"{FIGURE}.{kind}", metadata=undated)
    svg = folder / f"{FIGURE}.svg"
    svg.write_text(rounded(svg.read_text(encoding="utf-8")), encoding="utf-8")


def _keys() -> list[Patch]:
    grey = "#888888"
    looks: dict[str, tuple[Any, str]] = {
        "holds for all that it was judged for": (_SHADES(1.0), grey),
        "holds for those whose letters are given": (_SHADES(0.5), grey),
        "fails": ("#ffffff", grey),
        "moot: hardly a packet is lost": (_MOOT, grey),
    }
    keys = [Patch(facecolor=face, edgecolor=edge, label=label) for label, (face, edge) in looks.items()]
    stand_ins = "look-ahead in the LLM's place, from a random (r) or the shipped (s) start; v: mode value"
    keys += [Patch(facecolor="none", edgecolor="none", label=stand_ins), Patch(**_NOT_FLOWN, label="not flown")]
    frames = [(f"scenario {name}", colour) for name, (_, _, colour) in _FRAMES.items()]
    return keys + [Patch(facecolor="#ffffff", edgecolor=colour, label=label) for label, colour in frames]


def _grid(judged: Judged) -> tuple[list[str], list[float]]:
    rows = [row for row in ROWS if any(point.row == row for point, _ in judged)]
    return rows, [rate for rate in RATES if any(point.rate == rate for point, _ in judged)]


def _claim_panel(panel: Axes, claim: MapClaim, judged: Judged) -> None:
    rows, rates = _grid(judged)
    shares: FloatArray = np.full((len(rows), len(rates)), np.nan)
    for point, held in judged:
        row, column, found = rows.index(point.row), rates.index(point.rate), held[claim.name]
        shares[row, column] = found.share
        if found.moot:
            panel.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, color=_MOOT, lw=0))
        elif 0 < found.share < 1:
            letters = "".join(n[0] for n, holds in found.of.items() if holds)
            panel.text(column, row, letters, ha="center", va="center", fontsize=6)
    panel.imshow(np.ma.masked_invalid(shares), cmap=_SHADES, vmin=0, vmax=1, aspect="auto", zorder=0)
    _finish(panel, claim.stated, judged)


def _count_panel(panel: Axes, judged: Judged) -> None:
    rows, rates = _grid(judged)
    counts: FloatArray = np.full((len(rows), len(rates)), np.nan)
    for point, held in judged:
        row, column = rows.index(point.row), rates.index(point.rate)
        letter, counts[row, column] = most_held(held)
        panel.text(column, row, f"{counts[row, column]:.0f}{letter}", ha="center", va="center", fontsize=6)
    panel.imshow(np.ma.masked_invalid(counts), cmap=_COUNTS, vmin=0, vmax=len(CLAIMS), aspect="auto", zorder=0)
    _finish(panel, f"how many of the {len(CLAIMS)} hold,\nand for which stand-in", judged)
    panel.title.set_fontweight("bold")


def _finish(panel: Axes, title: str, judged: Judged) -> None:
    rows, rates = _grid(judged)
    flown = {(point.row, point.rate) for point, _ in judged}
    for (at_y, row), (at_x, rate) in product(enumerate(rows), enumerate(rates)):
        if (row, rate) not in flown:
            panel.add_patch(Rectangle((at_x - 0.5, at_y - 0.5), 1, 1, **_NOT_FLOWN, lw=0, zorder=1))
    panel.set_title(title, fontsize=7)
    panel.set_xticks(range(len(rates)), [f"{rate:g}" for rate in rates], fontsize=6)
    panel.set_yticks(range(len(rows)), rows, fontsize=6)
    panel.set_xticks(np.arange(len(rates) + 1) - 0.5, minor=True)
    panel.set_yticks(np.arange(len(rows) + 1) - 0.5, minor=True)
    panel.grid(which="minor", color="#bbbbbb", lw=0.4)
    panel.grid(which="major", visible=False)
    panel.tick_params(which="both", length=0)
    variants = [row for row in rows if row in VARIANTS]
    if variants:
        panel.axhline(rows.index(variants[0]) - 0.5, color="#222222", lw=0.8)
    for row, rate, colour in _FRAMES.values():
        if row in rows and rate in rates:
            at = rates.index(rate) - 0.5, rows.index(row) - 0.5
            panel.add_patch(Rectangle(at, 1, 1, fill=False, edgecolor=colour, lw=1.2, zorder=3))
