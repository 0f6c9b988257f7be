"""The paper's figures: their numbers, and which place explains a round trip."""

from __future__ import annotations

import csv
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from lab.claims_map.flights import SCHEMES, Flown
from lab.experiments.execution import commit
from lab.paper_figures import command, drawing
from lab.paper_figures.command import FigureOptions, paper_figures
from lab.paper_figures.measured import Trips, spatial_share, tokens_by_step
from shared.world.scenario import SCENARIOS, Scenario

PAPER = SCENARIOS["paper"]
BRIEF = PAPER.model_copy(update={"steps": 6})


def numbers(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> Scenario:
    monkeypatch.setattr(command, "scenario_from_options", lambda name, changes: BRIEF)
    return BRIEF


@pytest.mark.usefixtures("brief")
def test_curves_are_the_papers_schemes(tmp_path: Path) -> None:
    options = FigureOptions(out=tmp_path, figure=("losses", "attention", "visits"), runs=2)
    assert paper_figures(options, Console(quiet=True)) == 0
    rows = numbers(tmp_path / "losses.csv")
    assert {row["commit"] for row in rows} == {commit() or ""}
    assert list(dict.fromkeys(row["scheme"] for row in rows)) == ["AIC-VDS", "MADQN", "MAPPO", "EOF", "WQCS"]
    assert len(rows) == 5 * 6
    assert len({row["scheme"] for row in numbers(tmp_path / "attention.csv")}) == 3
    assert [row["of"] for row in numbers(tmp_path / "visits.csv") if row["measure"] == "visits"] == [*"0123456789"]
    for name in ("losses", "attention", "visits"):
        assert ET.parse(tmp_path / f"{name}.svg").getroot().tag.endswith("svg")


class Seen(drawing.Folder):
    """Keeps the legend's place in shares of the figure."""

    def figure(self, name: str, size: tuple[float, float], draw: Callable[[Figure], None]) -> None:
        picture = Figure(figsize=size, layout="constrained")
        draw(picture)
        picture.canvas.draw()
        self.legend = picture.legends[0].get_window_extent().transformed(picture.transFigure.inverted())


@pytest.mark.parametrize("looks", [drawing.FIVE, drawing.ON_OFF, drawing.BY_K])
def test_legends_are_whole(looks: drawing.Looks, tmp_path: Path) -> None:
    none = np.zeros((2, 6), dtype=np.int64)
    flown = Flown(none, none, none, np.ones((2, 10), dtype=np.int64), 0.0, "")
    folder = Seen(tmp_path)
    drawing.losses(folder, "losses", looks, {scheme: flown for scheme, _, _ in looks.values()})
    assert 0 <= folder.legend.x0 < folder.legend.x1 <= 1
    assert 0 <= folder.legend.y0 < folder.legend.y1 <= 1


def test_no_figure_has_more_than_five_curves() -> None:
    for looks in (drawing.FIVE, drawing.ON_OFF, drawing.BY_K):
        assert len(looks) <= 5
        assert {scheme for scheme, _, _ in looks.values()} <= set(SCHEMES)


def test_five_sensors_have_fewer_tokens_than_all() -> None:
    kept, whole = tokens_by_step(BRIEF, range(2))
    assert kept.shape == whole.shape == (2, 6, 3)
    assert (kept <= whole).all()
    assert 0.3 < kept.mean() / whole.mean() < 0.7


@pytest.mark.usefixtures("brief")
def test_round_trips_have_the_places_of_their_queries(tmp_path: Path) -> None:
    options = FigureOptions(out=tmp_path, figure=("round-trips",), quick=True, llm="none")
    assert paper_figures(options, Console(quiet=True)) == 0
    rows = numbers(tmp_path / "round-trips.csv")
    assert len(rows) == 3 * 6
    for row in rows:
        centre = BRIEF.lap_centres[int(row["uav"])]
        assert np.hypot(float(row["x"]) - centre[0], float(row["y"]) - centre[1]) == pytest.approx(300.0, rel=0.01)
        assert float(row["round_trip_ms"]) > 0


def flown(depends: bool) -> list[Trips]:
    """Five missions of three laps, whose round trips depend on the place or do not."""
    rng, found = np.random.default_rng(0), []
    for _ in range(5):
        for uav, centre in enumerate(PAPER.lap_centres):
            phase = rng.uniform(0, 2 * np.pi) + np.linspace(0, 6 * np.pi, 30)
            places = np.asarray(centre) + 300 * np.stack((np.cos(phase), np.sin(phase)), axis=1)
            times = 300 * np.exp(0.1 * rng.standard_normal(30) + 0.2 * np.cos(phase) * depends)
            found.append(Trips(uav, places, times))
    return found


def test_the_place_explains_round_trips_that_depend_on_it_and_no_others() -> None:
    share, chance = spatial_share(flown(True), PAPER.lap_centres, shifts=200)
    assert share > 0.5
    assert chance < 0.01
    share, chance = spatial_share(flown(False), PAPER.lap_centres, shifts=200)
    assert share < 0.1
    assert chance > 0.05
