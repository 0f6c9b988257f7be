"""The paper's figures as it draws them, each with its numbers as CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lab.claims_map.flights import EVERY_SENSOR, Flown, chooser_name
from lab.experiments.execution import commit
from lab.experiments.intervals import curve, interval
from lab.experiments.plots import PRINT, rounded
from lab.paper_figures.measured import Trips
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from simulator.records.decision import jain_index
from simulator.reporting.figure_style import DOUBLE_IN, SINGLE_IN
from simulator.reporting.figures import BLUE, GREEN, ORANGE, PURPLE, RED, SKY

# By the paper's names: the scheme, the colour, and the dash.
FIVE = {
    "AIC-VDS": (chooser_name("shipped", 5), BLUE, "-"),
    "MADQN": ("madqn_paper", RED, "--"),
    "MAPPO": ("mappo", PURPLE, "-."),
    "EOF": ("eof", ORANGE, ":"),
    "WQCS": ("wqcs", GREEN, (0, (5, 1, 1, 1, 1, 1))),
}
ON_OFF = {
    "attention, shipped start": (chooser_name("shipped", 5), BLUE, "-"),
    "attention, random start": (chooser_name("random", 5), ORANGE, ":"),
    "without": (EVERY_SENSOR, RED, "--"),
}
BY_K = {
    "k = 3": (chooser_name("random", 3), RED, "-."),
    "k = 5": (chooser_name("random", 5), BLUE, "-"),
    "k = 7": (chooser_name("random", 7), GREEN, "--"),
    "all sensors": (EVERY_SENSOR, ORANGE, ":"),
}
# Three labels of fewer letters fit side by side.
_SHORT_LABEL = 12
Looks = Mapping[str, tuple[str, str, object]]
Rows = Sequence[Sequence[object]]


class Folder:
    """Where figures and their numbers go."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.mkdir(parents=True, exist_ok=True)

    def figure(self, name: str, size: tuple[float, float], draw: Callable[[Figure], None]) -> None:
        """Write ``NAME.svg`` and ``NAME.png``."""
        with matplotlib.style.context(["default", {**PRINT, "svg.hashsalt": name}]):
            picture = Figure(figsize=size, layout="constrained")
            draw(picture)
            svg = self._path / f"{name}.svg"
            picture.savefig(svg, metadata={"Date": None, "Creator": None})
            picture.savefig(svg.with_suffix(".png"), metadata={"Software": None})
            svg.write_text(rounded(svg.read_text(encoding="utf-8")), encoding="utf-8")

    def numbers(self, name: str, header: Sequence[str], rows: Rows) -> None:
        """Write ``NAME.csv``, with the commit of this code in each row."""
        with (self._path / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([[*header, "commit"], *([*row, commit()] for row in rows)])


def losses(folder: Folder, name: str, looks: Looks, flights: Mapping[str, Flown]) -> None:
    """Lost packets by step, means with 95% intervals over worlds."""
    found = {label: curve(flights[scheme].lost.tolist()) for label, (scheme, _, _) in looks.items()}

    def draw(picture: Figure) -> None:
        panel = picture.subplots()
        for label, one in found.items():
            _, colour, dash = looks[label]
            steps = range(len(one.mean))
            panel.plot(steps, one.mean, color=colour, ls=dash, label=label)
            panel.fill_between(steps, one.low, one.high, color=colour, alpha=0.15, lw=0)
        panel.set_xlabel("step")
        panel.set_ylabel("lost packets")
        panel.set_ylim(bottom=0)
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        columns = 3 if max(map(len, found)) < _SHORT_LABEL else 2
        picture.legend(loc="outside upper center", ncols=columns, frameon=False)

    folder.figure(name, (SINGLE_IN, 2.7), draw)
    numbers = [
        (label, step, one.mean[step], one.low[step], one.high[step])
        for label, one in found.items()
        for step in range(len(one.mean))
    ]
    folder.numbers(name, ("scheme", "step", "lost_packets", "low", "high"), numbers)


def tokens(folder: Folder, name: str, kept: FloatArray, whole: FloatArray) -> None:
    """Tokens of the state block by step with a standard deviation, and their means; from counts ``(S, T, I)``."""
    curves = {"every sensor": (whole, RED, "--"), "attention, k = 5": (kept, BLUE, "-")}

    def draw(picture: Figure) -> None:
        by_step, means = picture.subplots(1, 2, width_ratios=(3, 1))
        for label, (counts, colour, dash) in curves.items():
            mean, spread = counts.mean(axis=(0, 2)), counts.std(axis=(0, 2))
            steps = np.arange(len(mean))
            by_step.plot(steps, mean, color=colour, ls=dash, label=label)
            by_step.fill_between(steps, mean - spread, mean + spread, color=colour, alpha=0.15, lw=0)
            bar = means.bar([label.split(",")[0]], [counts.mean()], color=colour)
            means.bar_label(bar, fmt="%.1f", fontsize=7)
        by_step.set_xlabel("step")
        by_step.set_ylabel("tokens of the state block")
        means.margins(y=0.15)
        picture.legend(loc="outside upper center", ncols=2, frameon=False)

    folder.figure(name, (DOUBLE_IN, 2.7), draw)
    numbers = [
        (label, step, counts[:, step].mean(), counts[:, step].std())
        for label, (counts, _, _) in curves.items()
        for step in range(counts.shape[1])
    ]
    folder.numbers(name, ("rows", "step", "tokens", "standard_deviation"), numbers)


def circles(folder: Folder, name: str, scenario: Scenario, trips: Sequence[Trips]) -> None:
    """The round trips of the first mission's queries along each UAV's circle, each panel with its own scale."""

    def draw(picture: Figure) -> None:
        panels = picture.subplots(1, scenario.uavs, squeeze=False)[0]
        for panel, trip, centre in zip(panels, trips, scenario.lap_centres, strict=False):
            _circle(picture, panel, trip, centre, scenario.lap_radius_m)

    folder.figure(name, (DOUBLE_IN, 2.6), draw)
    numbers = [
        (number // scenario.uavs, trip.uav, step, *place, time)
        for number, trip in enumerate(trips)
        for step, (place, time) in enumerate(zip(trip.places.tolist(), trip.milliseconds.tolist(), strict=True))
    ]
    folder.numbers(name, ("mission", "uav", "query", "x", "y", "round_trip_ms"), numbers)


def _circle(picture: Figure, panel: Axes, trip: Trips, centre: tuple[float, float], radius_m: float) -> None:
    turn = np.linspace(0, 2 * np.pi, 200)
    panel.plot(centre[0] + radius_m * np.cos(turn), centre[1] + radius_m * np.sin(turn), color="#cccccc", lw=0.8)
    shown = panel.scatter(trip.places[:, 0], trip.places[:, 1], c=trip.milliseconds, cmap="viridis", s=16, zorder=2)
    for (x, y), marker, label in ((trip.places[0], "^", "start"), (trip.places[-1], "s", "end")):
        panel.scatter(x, y, marker=marker, s=60, facecolor="none", edgecolor=RED, label=label, zorder=3)
    picture.colorbar(shown, ax=panel, orientation="horizontal", label="round trip, ms")
    panel.set_title(f"UAV {trip.uav}")
    panel.set_aspect("equal")
    panel.set_xlabel("x, m")
    panel.set_ylabel("y, m")
    panel.legend(loc="center", frameon=False)


def visits(folder: Folder, name: str, flown: Flown) -> None:
    """Jain's index of each run, and the mean visits of each sensor."""
    index = [jain_index(one) or 0.0 for one in flown.visits.tolist()]
    means, overall = flown.visits.mean(axis=0), interval(index)

    def draw(picture: Figure) -> None:
        upper, lower = picture.subplots(2, 1)
        upper.bar(range(len(index)), index, color=BLUE)
        upper.axhline(overall.mean, color=RED, ls="--", lw=1)
        upper.set_ylim(0, 1)
        upper.set_xlabel("run")
        upper.set_ylabel("Jain's index")
        upper.set_title(f"mean {overall.mean:.3f} [{overall.low:.3f}, {overall.high:.3f}]")
        lower.bar(range(len(means)), means, yerr=flown.visits.std(axis=0), color=SKY, ecolor="#555555", capsize=2)
        lower.set_xlabel("sensor")
        lower.set_ylabel("visits a run")

    folder.figure(name, (SINGLE_IN, 3.6), draw)
    runs = [("jain", run, value) for run, value in enumerate(index)]
    folder.numbers(name, ("measure", "of", "value"), [*runs, *(("visits", j, v) for j, v in enumerate(means.tolist()))])
