"""A world as an image."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from shared.world.scenario import Scenario
from simulator.world.fleet import Fleet
from simulator.world.sensors import Sensors


def render_map(scenario: Scenario, step: int, sensors: Sensors, fleet: Fleet) -> NDArray[np.uint8]:
    """The map as RGB, shape ``(600, 600, 3)``: trajectories, UAVs, and sensors filled by their queues."""
    # Without pyplot, no reference to the figure outlives this function.
    figure = Figure(figsize=(6, 6), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot(xlabel="x, m", ylabel="y, m", title=f"{scenario.name}, step {step}")
    low, high = [np.zeros(2)], [np.full(2, scenario.area_m)]
    for uav, (path, position) in enumerate(zip(fleet.trajectories, fleet.positions, strict=True)):
        colour = f"C{uav % 10}"
        axes.plot(*path.at(np.linspace(0.0, path.length_m, 361)).T, ls="--", color=colour, alpha=0.6)
        axes.plot(position[0], position[1], marker="^", ms=11, color=colour)
        low.append(path.bounds[0])
        high.append(path.bounds[1])
    x, y = sensors.positions.T
    axes.scatter(x, y, c=sensors.queue, s=90, cmap="Reds", edgecolors="k", vmin=0, vmax=scenario.queue_capacity)
    if scenario.layout != "uniform" and scenario.pipeline:
        axes.plot(*np.array(scenario.pipeline).T, color="0.7", lw=3, zorder=0)
    (left, bottom), (right, top) = np.min(low, axis=0), np.max(high, axis=0)
    margin = 0.05 * scenario.area_m
    axes.set(xlim=(left - margin, right + margin), ylim=(bottom - margin, top + margin), aspect="equal")
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.array(canvas.buffer_rgba())[..., :3]  # type: ignore[no-untyped-call]
