"""``python -m lab experiment claims-map``: it continues, and writes the map."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from rich.console import Console

from lab.claims_map import points
from lab.claims_map.command import MapOptions, claims_map
from lab.claims_map.flights import SCHEMES
from lab.claims_map.judging import CLAIMS
from shared.world.scenario import SCENARIOS
from simulator.errors import UsageError
from tests.support.processes import run_lab_here


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Missions of six steps at one setting."""
    whole = points.points
    short = [
        points.Point(p.row, p.rate, p.scenario.model_copy(update={"steps": 6})) for p in whole(quick=True) if p.rate > 1
    ]
    monkeypatch.setattr(points, "points", lambda quick=False: short[:1])


@pytest.mark.usefixtures("brief")
def test_it_writes_the_map_and_flies_nothing_twice(tmp_path: Path) -> None:
    options = MapOptions(out=tmp_path, seeds=2)
    assert claims_map(options, Console(quiet=True)) == 0
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "flights").iterdir()}
    assert len(kept) == len(SCHEMES)
    verdicts, curves = rows(tmp_path / "claims-map.csv"), rows(tmp_path / "claims-map-curves.csv")
    assert [row["claim"] for row in verdicts] == [claim.name for claim in CLAIMS]
    assert [row["scheme"] for row in curves] == list(SCHEMES)
    for row in curves:
        assert sum(float(row[str(step)]) for step in range(6)) == pytest.approx(float(row["lost"]), rel=0.01, abs=0.02)
    assert (tmp_path / "claims-map.svg").stat().st_size > 10_000

    lost = next(iter(kept))
    lost.unlink()
    written = (tmp_path / "claims-map-curves.csv").read_bytes()
    assert claims_map(options, Console(quiet=True)) == 0
    assert {p for p in kept if p.stat().st_mtime_ns == kept[p]} == set(kept) - {lost}
    assert (tmp_path / "claims-map-curves.csv").read_bytes() == written


@pytest.mark.usefixtures("brief")
def test_written_needs_a_complete_setting(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no setting with every scheme's flights in 2 worlds"):
        claims_map(MapOptions(out=tmp_path, seeds=2, written=True), Console(quiet=True))


def test_the_settings_vary_what_the_paper_leaves_open() -> None:
    found = points.points()
    assert len(found) == len({point.name for point in found}) == 52
    assert {point.row for point in found} == set(points.ROWS)
    paper = next(p for p in found if (p.row, p.rate) == ("queues 0.3 to 1 W", 5.0))
    assert paper.scenario == SCENARIOS["paper"]
    light = next(p for p in found if (p.row, p.rate) == ("step 20 s", 0.5))
    assert light.scenario.model_copy(update={"name": "paper_light"}) == SCENARIOS["paper_light"]


def test_bad_use_is_refused() -> None:
    refused = run_lab_here("experiment", "claims-map", "--seeds", "1")
    assert refused.returncode == 2
    assert "--seeds" in refused.stderr
