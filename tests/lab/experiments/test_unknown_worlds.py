"""The experiment in worlds that differ from the model: its sites, and its references on each of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lab.experiments.plan import Experiment, plan
from lab.experiments.result import Result
from lab.experiments.schemes import BOUND, FORMULA_PLANNER, INFORMED, Scheme
from lab.experiments.tables import tables_of
from lab.experiments.unknown_worlds import EXPERIMENT
from shared.world.scenario import SCENARIOS
from simulator.sites.site import Site
from tests.support.tiny_flights import run_in, setup

SITES = {name: Site(SCENARIOS[name].model_copy(update={"steps": 4})) for name in ("paper", "faulty", "windy")}


def cheap(*more: str) -> Experiment:
    """The heuristics, and the schemes of those names."""
    kept = {*EXPERIMENT.heuristics, *more}

    def schemes(_: object) -> list[Scheme]:
        return [scheme for scheme in EXPERIMENT.schemes(setup()) if scheme.name in kept]

    return replace(EXPERIMENT, schemes=schemes)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """Two seeds of four steps in three worlds."""
    [made] = run_in(tmp_path_factory.mktemp("out"), seeds=2, sites=SITES).make([cheap()])
    return made


def test_it_flies_every_world_that_differs_and_two_that_do_not() -> None:
    sites = {name: Site(scenario) for name, scenario in SCENARIOS.items()}
    flown = {flight.site_name for flight in plan(EXPERIMENT, setup(sites=sites)).flights}
    assert flown == {"paper", "stress", "shadowed", "fading", "bursty", "windy", "faulty", "field"}


def test_a_world_of_ones_own_comes_first() -> None:
    own = Site(SCENARIOS["dense"].model_copy(update={"name": "mine"}))
    flights = plan(EXPERIMENT, setup(sites={"mine": own, **SITES})).flights
    assert list(dict.fromkeys(flight.site_name for flight in flights)) == ["mine", *SITES]


def test_every_heuristic_is_compared_with_the_best_of_its_world(result: Result) -> None:
    for site in SITES:
        means = {name: result.schemes[name][f"lost_packets@{site}"].mean for name in EXPERIMENT.heuristics}
        least = min(means.values())
        ratios = {
            pair.scheme: pair.mean
            for pair in result.paired
            if (pair.reference, pair.measure, pair.kind) == ("best_heuristic", f"lost_packets@{site}", "ratio")
        }
        assert len(ratios) == len(means) - 1
        assert ratios == pytest.approx({name: means[name] / least for name in ratios})
        assert any("The best heuristic" in note and f" on {site}" in note for note in result.notes)


def test_the_tables_have_a_column_a_world(result: Result) -> None:
    lost, *ratios = tables_of(result)
    assert lost.caption == "lost packets" and lost.columns == ["scheme", *SITES]
    [ratio] = [table for table in ratios if table.caption == "lost packets: ratio to the best heuristic"]
    assert ratio.columns == ["scheme", *SITES]


@pytest.mark.long
def test_planners_and_bounds_are_those_of_their_world(tmp_path: Path) -> None:
    sites = {name: SITES[name] for name in ("paper", "faulty")}
    flown = cheap(FORMULA_PLANNER, INFORMED.name, BOUND.name)
    [result] = run_in(tmp_path, seeds=2, sites=sites).make([flown])
    for site in sites:
        bound = result.bound[f"lost_packets@{site}"].values
        informed = result.schemes[INFORMED.name][f"lost_packets@{site}"].values
        assert all(least <= lost for least, lost in zip(bound, informed, strict=True))
        above = [p for p in result.paired if p.reference == BOUND.name and p.measure == f"lost_packets@{site}"]
        differences = {p.scheme: p.mean for p in above if p.kind == "difference"}
        assert differences[INFORMED.name] == pytest.approx((sum(informed) - sum(bound)) / 2)
    assert not any("cannot fly" in note or "is wrong" in note for note in result.notes)
    assert any(pair.reference == INFORMED.name for pair in result.paired)


def test_a_second_run_flies_nothing(tmp_path: Path) -> None:
    sites = {"paper": SITES["paper"]}
    run_in(tmp_path, seeds=1, sites=sites).make([cheap()])
    again = run_in(tmp_path, seeds=1, sites=sites)
    again.make([cheap()])
    assert again.flown == 0
