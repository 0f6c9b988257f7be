"""The learning curve of a training: rows as it goes, a CSV, a plot."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class Point:
    """One row of a learning curve.

    Attributes:
        episode: missions flown in training by then.
        lost_packets: a mission, mean of those flown since the row before, exploration included.
        episode_return: mean over the UAVs of the sum of rewards of a mission, of the same missions.
        loss: the mean training loss since the row before.
        greedy_lost_packets: a mission without exploration, mean over held-out worlds.
    """

    episode: int
    lost_packets: float
    episode_return: float
    loss: float
    greedy_lost_packets: float


def write_csv(points: Sequence[Point], path: Path) -> None:
    """One line a point, under the names of the fields."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.DictWriter(file, [field.name for field in fields(Point)], lineterminator="\n")
        rows.writeheader()
        rows.writerows({k: round(v, 4) for k, v in asdict(point).items()} for point in points)


def read_csv(path: Path) -> list[Point]:
    """What ``write_csv`` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            Point(int(row.pop("episode")), **{name: float(value) for name, value in row.items()})
            for row in csv.DictReader(file)
        ]


def plot(points: Sequence[Point], title: str, stem: Path) -> None:
    """Lost packets over episodes, as PNG and SVG beside each other."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    episodes = [point.episode for point in points]
    axes.plot(episodes, [point.lost_packets for point in points], label="training missions, exploring")
    axes.plot(episodes, [point.greedy_lost_packets for point in points], label="held-out worlds, greedy")
    axes.set(xlabel="episode", ylabel="lost packets a mission", title=title, ylim=(0, None))
    axes.legend()
    for suffix in (".png", ".svg"):
        figure.savefig(stem.with_suffix(suffix), dpi=150)
