"""The report's figures.

The colours are those of Okabe and Ito, distinguishable for colour-blind readers. Lines differ in dashes and markers
too.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories
from simulator.records.decision import Decision, visits_per_sensor
from simulator.reporting.figure_style import PaperFigure, paper_figure
from simulator.world.observation import StepTally

INK = "#222222"
BLUE, ORANGE, GREEN, RED, PURPLE, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#767676"
SKY = "#56B4E9"
AS_SENT, IN_FULL = (BLUE, "-", "o"), (ORANGE, "--", "s")
# Colour, dash and marker of each policy, the same on every page.
# fmt: off
POLICIES = {
    "aic_vds": (BLUE, "-", "o"), "eof": (ORANGE, "--", "s"), "wqcs": (GREEN, ":", "^"),
    "round_robin": (PURPLE, "-.", "D"), "random": (SKY, (0, (5, 1, 1, 1)), "v"), "max_gain": (RED, "--", ">"),
    "nearest": (GREY, "-.", "X"), "mpc": (INK, "-", "h"), "edge:llm": (BLUE, "--", "P"),
    "edge:guided": (PURPLE, "-", "P"), "edge:value": (GREEN, "-", "v"), "edge:policy": (RED, "-", "D"),
}
# fmt: on
OTHER_POLICY = (GREY, "-", "x")
SOURCES = {"llm": BLUE, "guided": PURPLE, "value": GREEN, "policy": ORANGE, "onboard": RED}
MARKERS = {"llm": "o", "guided": "P", "value": "^", "policy": "D", "onboard": "o"}
MAPS = 9
# The distance from a sensor to its number, as a share of the area's side.
LABEL_OFFSET = 0.06
_HALO = [withStroke(linewidth=2.5, foreground="white")]


def _integers(*axis: XAxis | YAxis) -> None:
    for each in axis:
        each.set_major_locator(MaxNLocator(nbins=8, integer=True, steps=[1, 2, 5, 10]))


def _legend_above(axes: Axes, columns: int = 3) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.figure.legend(handles, labels, loc="outside upper center", ncols=columns)


def plain(axes: Axes) -> None:
    """Style axes: two spines, ticks outside, and faint horizontal grid lines."""
    axes.minorticks_off()
    axes.tick_params(top=False, right=False, direction="out")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)


def latency_map(scenario: Scenario, sensor_xy: np.ndarray, decisions: Sequence[Decision]) -> PaperFigure:
    """A map for each of the first nine UAVs: its trajectory, its waypoints coloured by round trip, and all sensors.

    ``sensor_xy`` is (J, 2) in metres. The marker shows the source of a decision; those taken on board are hollow.
    """
    shown = min(scenario.uavs, MAPS)
    columns = min(3, shown)
    rows = -(-shown // columns)
    trips = [d.rtt_ms for d in decisions if d.rtt_ms is not None]
    scale = Normalize(min(trips), max(trips)) if trips else Normalize(0.0, 1.0)
    with paper_figure("latency-map", 2.1 * rows + 0.4, (rows, columns)) as (drawn, panels):
        for extra in panels[shown:]:
            extra.set_visible(False)
        for uav in range(shown):
            mine = [d for d in decisions if d.uav_id == uav]
            _map_frame(panels[uav], scenario, uav)
            arrow = _map_trajectory(panels[uav], scenario, uav, mine)
            _map_sensors(panels[uav], scenario, sensor_xy, [*(np.array(d.position) for d in mine), *arrow])
            _map_waypoints(panels[uav], mine, scale)
            if uav % columns == 0:
                panels[uav].set_ylabel("y (m)")
        figure = panels[0].figure
        if trips:
            bar = figure.colorbar(ScalarMappable(scale, "viridis"), ax=panels, shrink=0.8, pad=0.02)
            bar.set_label("round trip (ms)")
            bar.ax.minorticks_off()
        present = {d.source for d in decisions}
        keys = [_key(source) for source in SOURCES if source in present]
        keys.append(Line2D([], [], color=INK, marker="s", linestyle="", label="sensor"))
        figure.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn


def _key(source: str) -> Line2D:
    face = "none" if source == "onboard" else GREY
    edge = RED if source == "onboard" else GREY
    return Line2D([], [], linestyle="", marker=MARKERS[source], markerfacecolor=face, color=edge, label=source)


def _map_frame(axes: Axes, scenario: Scenario, uav: int) -> None:
    axes.set_title(f"UAV {uav}")
    axes.set_aspect("equal")
    corners = [corner for path in trajectories(scenario) for corner in path.bounds]
    low, high = np.min(corners, axis=0).clip(max=0.0), np.max(corners, axis=0).clip(min=scenario.area_m)
    margin = 0.06 * scenario.area_m
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_xlabel("x (m)")
    axes.minorticks_off()
    axes.locator_params(nbins=4)
    if scenario.layout != "uniform" and scenario.pipeline:
        axes.plot(*np.array(scenario.pipeline).T, color="#cccccc", linewidth=2.5, zorder=0.5)


def _map_trajectory(axes: Axes, scenario: Scenario, uav: int, mine: Sequence[Decision]) -> list[np.ndarray]:
    path = trajectories(scenario)[uav]
    axes.plot(*path.at(np.linspace(0.0, path.length_m, 361)).T, color=GREY, linewidth=0.8, linestyle="--")
    flown = [np.array(d.position) for d in mine]
    moved = next((position for position in flown if np.hypot(*(position - flown[0])) > 1.0), None)
    if moved is None:
        return []
    ahead = (moved - flown[0]) / np.hypot(*(moved - flown[0]))
    # The left side is the inside of a lap, free of waypoints and of the frame.
    left = np.array([-ahead[1], ahead[0]])
    tail = flown[0] + 0.06 * scenario.area_m * left
    tip = tail + 0.15 * scenario.area_m * ahead
    label = flown[0] + 0.15 * scenario.area_m * left
    axes.annotate("", tuple(tip), tuple(tail), arrowprops={"arrowstyle": "-|>", "color": RED, "lw": 1.1}, zorder=6)
    axes.text(
        label[0], label[1], "start", color=RED, fontsize=7, ha="center", va="center", zorder=7, path_effects=_HALO
    )
    return [tail, tip, label]


def _map_sensors(axes: Axes, scenario: Scenario, sensor_xy: np.ndarray, occupied: list[np.ndarray]) -> None:
    few = len(sensor_xy) <= 20
    axes.scatter(
        sensor_xy[:, 0], sensor_xy[:, 1], marker="s", s=27 if few else 6, color=INK, edgecolors="white", zorder=5
    )
    occupied = [*occupied, *sensor_xy]
    reach = LABEL_OFFSET * scenario.area_m
    angles = np.arange(8) * np.pi / 4 + np.pi / 4
    for j, at in enumerate(sensor_xy if few else ()):
        spots = at + reach * np.column_stack([np.cos(angles), np.sin(angles)])
        spot = max(spots, key=lambda s: min((float(np.hypot(*(s - other))) for other in occupied), default=0.0))
        occupied.append(spot)
        axes.text(
            spot[0], spot[1], str(j), fontsize=7, color=INK, ha="center", va="center", zorder=7, path_effects=_HALO
        )  # fmt: skip


def _map_waypoints(axes: Axes, mine: Sequence[Decision], scale: Normalize) -> None:
    for source, marker in MARKERS.items():
        timed = [(*d.position, d.rtt_ms) for d in mine if d.source == source and d.rtt_ms is not None]
        x, y, trips = np.array(timed, dtype=float).reshape(-1, 3).T
        axes.scatter(
            x, y, c=trips, cmap="viridis", norm=scale, marker=marker,
            s=30, edgecolors="white", linewidths=0.5, zorder=3,
        )  # fmt: skip
    onboard = np.array([d.position for d in mine if d.rtt_ms is None]).reshape(-1, 2)
    axes.scatter(
        onboard[:, 0], onboard[:, 1], s=26, marker=MARKERS["onboard"], facecolors="none", edgecolors=RED,
        linewidths=1.4, zorder=4,
    )  # fmt: skip


def latency_per_step(decisions: Sequence[Decision]) -> PaperFigure:
    """Round trip over the steps for each source: the median of the fleet, and the range from fastest to slowest."""
    trips: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for d in decisions:
        if d.rtt_ms is not None:
            trips[d.source][d.step].append(d.rtt_ms)
    with paper_figure("latency-steps", 2.2, (1, 1)) as (drawn, (axes,)):
        for source in (name for name in SOURCES if name in trips):
            by_step, colour = trips[source], SOURCES[source]
            steps = sorted(by_step)
            medians = [float(np.median(by_step[s])) for s in steps]
            low, high = [min(by_step[s]) for s in steps], [max(by_step[s]) for s in steps]
            axes.vlines(steps, low, high, color=colour, alpha=0.3, linewidth=3.5)
            axes.plot(
                steps, medians, color=colour, marker=MARKERS[source], ms=4, linestyle="", label=source, clip_on=False
            )
        _legend_above(axes)
        if trips:
            axes.set_ylim(bottom=0)
        axes.set_xlabel("step")
        axes.set_ylabel("round trip (ms)")
        plain(axes)
        _integers(axes.xaxis)
    return drawn


def losses(tallies: Mapping[str, Sequence[StepTally]], names: dict[str, str]) -> PaperFigure:
    """Lost packets and loss events of every policy, per step and cumulative; ``names`` are the policies' labels."""
    measures: tuple[tuple[str, Callable[[StepTally], int]], ...] = (
        ("lost packets", lambda t: t.lost_packets),
        ("loss events", lambda t: t.failures + t.overflows),
    )
    with paper_figure("losses", 4.8, (2, 2)) as (drawn, panels):
        for row, (title, measure) in enumerate(measures):
            for name, tally in tallies.items():
                colour, dash, marker = POLICIES.get(name, OTHER_POLICY)
                values = np.array([measure(t) for t in tally], dtype=float)
                for axes, series in ((panels[2 * row], values), (panels[2 * row + 1], values.cumsum())):
                    axes.plot(
                        np.arange(len(series)), series, color=colour, linestyle=dash, marker=marker,
                        markersize=2.8, label=names.get(name, name),
                    )  # fmt: skip
            panels[2 * row].set_ylabel(f"{title} a step")
            panels[2 * row + 1].set_ylabel(f"{title}, cumulative")
        for axes in panels:
            plain(axes)
            _integers(axes.xaxis, axes.yaxis)
            axes.set_ylim(bottom=0)
        for axes in panels[2:]:
            axes.set_xlabel("step")
        _legend_above(panels[0], min(max(1, len(tallies)), 3))
    return drawn


def tokens_per_step(decisions: Sequence[Decision]) -> PaperFigure:
    """Mean tokens of a decision over the fleet at each step: the prompt and its state block, as sent and in full."""
    by_step = defaultdict(list)
    for d in decisions:
        if d.tokens is not None:
            by_step[d.step].append(d.tokens)
    steps = sorted(by_step)
    with paper_figure("tokens", 2.7, (1, 2)) as (drawn, panels):
        for axes, sent, full, title in (
            (panels[0], "prompt", "uncompressed", "whole prompt"),
            (panels[1], "state", "state_uncompressed", "state block"),
        ):
            for key, label, (colour, dash, marker) in ((full, "every sensor", IN_FULL), (sent, "as sent", AS_SENT)):
                means = [float(np.mean([getattr(t, key) for t in by_step[s]])) for s in steps]
                axes.plot(steps, means, color=colour, linestyle=dash, marker=marker, markersize=2.8, label=label)
            axes.set_title(title)
            axes.set_xlabel("step")
            axes.set_ylim(bottom=0)
            plain(axes)
            _integers(axes.xaxis, axes.yaxis)
        panels[0].set_ylabel("tokens a decision")
        _legend_above(panels[0], 2)
    return drawn


def visits(decisions: Sequence[Decision], sensors: int, names: Sequence[str | None] = ()) -> PaperFigure:
    """Visits of each sensor, with its name if it has one, as stacked bars: successful and failed ones."""
    served = np.array(visits_per_sensor(decisions, sensors))
    tried = np.bincount([d.sensor_id for d in decisions], minlength=sensors)[:sensors]
    with paper_figure("visits", 2.2, (1, 1)) as (drawn, (axes,)):
        at = np.arange(sensors)
        axes.bar(at, served, color=BLUE, label="served")
        missed = np.flatnonzero(tried > served)
        unserved = (tried - served)[missed]
        axes.bar(missed, unserved, bottom=served[missed], color="white", edgecolor=RED, hatch="////", label="failed")
        axes.axhline(served.mean(), color=INK, linewidth=1, linestyle=":", label="mean served")
        if sensors <= 20:
            axes.set_xticks(at)
        if sensors <= 20 and any(names):
            labels = [(name or str(sensor))[:12] for sensor, name in enumerate(names)]
            # A dollar sign of a name is no mathematics.
            axes.set_xticklabels(labels, rotation=90, parse_math=False)
        axes.set_xlabel("sensor")
        axes.set_ylabel("visits")
        plain(axes)
        _integers(axes.yaxis)
        _legend_above(axes)
    return drawn


def deciders(decisions: Sequence[Decision]) -> PaperFigure:
    """The sources of the decisions of each step, as stacked bars."""
    counted: Counter[tuple[int, str]] = Counter((d.step, d.source) for d in decisions)
    steps = sorted({step for step, _ in counted})
    with paper_figure("deciders", 2.0, (1, 1)) as (drawn, (axes,)):
        below = np.zeros(len(steps))
        for source, colour in SOURCES.items():
            counts = np.array([counted[step, source] for step in steps], dtype=float)
            if counts.any():
                axes.bar(steps, counts, bottom=below, color=colour, label=source, edgecolor="white", linewidth=0.5)
                below = below + counts
        axes.set_xlabel("step")
        axes.set_ylabel("decisions")
        plain(axes)
        _integers(axes.xaxis, axes.yaxis)
        _legend_above(axes)
    return drawn
