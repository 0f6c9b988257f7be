"""The learning curve of a training: its points, a CSV file and a plot."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class Point:
    """One row of a learning curve.

    Attributes:
        episode: number of training missions so far.
        lost_packets: mean per mission since the previous row, exploration included.
        episode_return: of the same missions, the mean over missions and UAVs of the sum of rewards.
        loss: the mean training loss since the previous row.
        greedy_lost_packets: mean per mission over held-out worlds, without exploration.
    """

    episode: int
    lost_packets: float
    episode_return: float
    loss: float
    greedy_lost_packets: float


def write_csv(points: Sequence[Point], path: Path) -> None:
    """Write one line a point, with the names of the fields as the header."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.DictWriter(file, [field.name for field in fields(Point)], lineterminator="\n")
        rows.writeheader()
        rows.writerows({k: round(v, 4) for k, v in asdict(point).items()} for point in points)


def read_csv(path: Path) -> list[Point]:
    """Read a file of ``write_csv``."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            Point(int(row.pop("episode")), **{name: float(value) for name, value in row.items()})
            for row in csv.DictReader(file)
        ]


def plot(points: Sequence[Point], title: str, stem: Path) -> None:
    """Plot lost packets over episodes, to a PNG and an SVG file."""
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
