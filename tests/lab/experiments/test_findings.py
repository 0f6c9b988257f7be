"""From flights to a result: pairs, measures and notes."""

from __future__ import annotations

import csv
from io import StringIO
from typing import Any

import pytest

from lab.experiments.catalogue import EXPERIMENTS
from lab.experiments.findings import findings, tidy
from lab.experiments.flight import BoundFound, FlightRecord
from lab.experiments.measures import MEASURES, STEP_MEASURES
from lab.experiments.plan import QUICK_STEPS, Experiment, FigureSpec, plan
from lab.experiments.plots import BOUND_LABEL
from lab.experiments.result import Result
from lab.experiments.schemes import BOUND, llm, local
from lab.experiments.tables import tables_of
from simulator.sites.site import Site
from tests.support.tiny_flights import TINY, decided, declared, flown, setup

LOST = {"eof": 10, "random": 30, "llm": 20}


def result_of(experiment: Experiment, changes: dict[str, Any] | None = None, **setup_changes: Any) -> Result:
    """The findings of flights in which a scheme loses ``LOST`` packets and as many again for each seed."""
    planned = plan(experiment, setup(**setup_changes))
    flights: dict[str, FlightRecord] = {}
    for flight in planned.flights:
        name, seed = flight.scheme.name, flight.seed
        if name == BOUND.name:
            bound = BoundFound(lower_bound=2 + seed, lost_packets=3 + seed, optimal=seed > 0, gap=0.1)
            flights[flight.key] = flown(seed=seed, bound=bound)
            continue
        lost = [0, LOST[name] * (seed + 1), 0]
        flights[flight.key] = flown(
            [decided(0, 0, **(changes or {}))], seed=seed, failures=[1] * 3, overflows=[0] * 3, lost_packets=lost
        )
    return findings(planned, setup(**setup_changes), "python -m lab experiment tiny", flights.get, [])


def test_schemes_are_paired_to_the_reference_on_the_seeds_that_both_flew() -> None:
    result = result_of(declared(local("eof"), local("random"), llm()), llm=setup().llm.__class__())
    assert result.seeds == [0, 1, 2] and result.seeds_of == {"llm": [0, 1]}
    ratios = {p.scheme: p.mean for p in result.paired if p.kind == "ratio" and p.measure == "lost_packets"}
    assert ratios == pytest.approx({"random": 3.0, "llm": 2.0})
    differences = {p.scheme: p.mean for p in result.paired if p.kind == "difference" and p.measure == "lost_packets"}
    # EOF loses 10, 20, 30 on the three seeds, the LLM 20, 40 on the first two.
    assert differences == pytest.approx({"random": 40.0, "llm": 15.0})


def test_the_bound_is_no_scheme_and_every_scheme_is_compared_with_it() -> None:
    result = result_of(declared(local("eof"), local("random"), BOUND))
    assert "bound" not in result.schemes and "bound" not in result.curves
    assert result.bound["lost_packets"].values == [2, 3, 4]
    above = {p.scheme: p.mean for p in result.paired if p.reference == "bound" and p.kind == "difference"}
    assert above == pytest.approx({"eof": 17.0, "random": 57.0})
    assert any("proven optimal on 2 of 3 seeds" in note and "up to 1 packets" in note for note in result.notes)


def test_curves_are_per_step_and_cumulative() -> None:
    curves = ("lost_packets_per_step", "lost_packets_cumulative")
    result = result_of(declared(local("eof"), figures=(FigureSpec("c", "curves", curves, "Curves."),)))
    assert result.curves["eof"]["lost_packets_per_step"].mean == [0, 20, 0]
    assert result.curves["eof"]["lost_packets_cumulative"].mean == [0, 20, 20]


def test_a_caption_has_seeds_interval_and_command() -> None:
    [figure] = result_of(declared(local("eof"), llm()), llm=setup().llm.__class__()).figures
    assert "3 seeds (2 for those that ask an LLM)" in figure.caption
    assert "95% bootstrap interval" in figure.caption and "`python -m lab experiment tiny`" in figure.caption


def test_decisions_taken_in_the_llms_place_are_not_passed_off_as_its_own() -> None:
    late = result_of(declared(llm(), references=("llm",)), {"reason": "llm_timeout"}, llm=setup().llm.__class__())
    assert any("2 of 2 decisions are not the LLM's" in note and "llm_timeout" in note for note in late.notes)
    own = result_of(declared(llm(), references=("llm",)), {"source": "llm"}, llm=setup().llm.__class__())
    assert not any("not the LLM's" in note for note in own.notes)


def test_a_measure_that_some_seed_lacks_is_omitted_with_a_note() -> None:
    planned = plan(declared(local("eof")), setup())
    flights = {
        p.key: flown([decided(0, 0, failed=p.seed == 1)], seed=p.seed, failures=[0], overflows=[0], lost_packets=[0])
        for p in planned.flights
    }
    result = findings(planned, setup(), "x", flights.get, [])
    assert "jain" not in result.schemes["eof"]
    assert any("it has none on 1 of 3 seeds" in note for note in result.notes)


def test_the_measures_names_have_the_site() -> None:
    sites = {"paper": Site(TINY), "stress": Site(TINY.model_copy(update={"name": "stress", "link_share": 0.35}))}
    result = result_of(declared(worlds=("stress",)), sites=sites)
    assert {"lost_packets@paper", "lost_packets@stress"} <= set(result.schemes["eof"])
    assert result.figures[0].measures == [f"{m}@{s}" for m in ("lost_packets", "events") for s in sites]
    assert result.labels["events@stress"] == "loss events, stress"
    assert {p.measure for p in result.paired} >= {"events@paper", "events@stress"}


def test_each_site_has_a_bound_and_a_best_heuristic_of_its_own() -> None:
    sites = {"paper": Site(TINY), "stress": Site(TINY.model_copy(update={"name": "stress", "link_share": 0.35}))}
    experiment = declared(
        local("eof"), local("random"), BOUND, worlds=("stress",), heuristics=("eof", "random"), references=()
    )
    result = result_of(experiment, sites=sites)
    assert result.bound["lost_packets@paper"].values == result.bound["lost_packets@stress"].values == [2, 3, 4]
    found = {(p.scheme, p.reference, p.measure, p.kind): p.mean for p in result.paired}
    assert found["random", "best_heuristic", "lost_packets@stress", "ratio"] == pytest.approx(3.0)
    # EOF loses 10, 20, 30 and random thrice as many, at least 2, 3 and 4 of them whatever is flown.
    assert found["random", "best_heuristic", "excess@stress", "ratio"] == pytest.approx(171 / 51)
    assert found["random", "bound", "lost_packets@paper", "difference"] == pytest.approx(57.0)
    assert ("eof", "best_heuristic", "lost_packets@paper", "ratio") not in found
    [*_, least] = csv.DictReader(StringIO(tidy(result)))
    assert {"scheme": "bound", "seed": "2", "lost_packets@stress": "4", "events@stress": ""}.items() <= least.items()
    assert any("clairvoyant bound@stress: proven optimal on 2 of 3 seeds" in note for note in result.notes)
    [lost, *_] = tables_of(result)
    assert lost.rows[-1][0] == BOUND_LABEL and lost.rows[-1][1].startswith("3.0")


def test_the_table_has_a_line_a_scheme_and_seed() -> None:
    result = result_of(declared(local("eof"), llm(), BOUND), llm=setup().llm.__class__())
    rows = list(csv.DictReader(StringIO(tidy(result))))
    assert [(row["scheme"], row["seed"], row["lost_packets"]) for row in rows] == [
        ("eof", "0", "10"), ("eof", "1", "20"), ("eof", "2", "30"), ("llm", "0", "20"), ("llm", "1", "40"),
        ("bound", "0", "2"), ("bound", "1", "3"), ("bound", "2", "4"),
    ]  # fmt: skip


def test_a_result_names_each_commit_of_its_flights() -> None:
    planned = plan(declared(local("eof")), setup())
    flights = {
        p.key: flown([decided(0, 0)], seed=p.seed, commit=f"c{p.seed}", failures=[0], overflows=[0], lost_packets=[0])
        for p in planned.flights
    }
    assert findings(planned, setup(), "x", flights.get, []).commit == "c0, c1, c2"


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=list(EXPERIMENTS))
@pytest.mark.parametrize("pace", ["full", "quick"])
def test_the_names_that_experiments_declare_exist(experiment: Experiment, pace: str) -> None:
    names = {scheme.name for scheme in experiment.schemes(setup(pace=pace))}
    whole = {scheme.name for scheme in experiment.schemes(setup())}
    assert names <= whole
    assert set(experiment.references) <= names
    assert set(experiment.heuristics) <= names
    assert {name for pair in experiment.pairs for name in pair} <= whole
    assert set(experiment.measures) <= MEASURES.keys() and set(experiment.paired_measures) <= set(experiment.measures)
    for drawing in experiment.figures:
        known = STEP_MEASURES.keys() if drawing.kind == "curves" else set(experiment.measures)
        assert set(drawing.measures) <= known, drawing.name
    assert experiment.sweep is None or experiment.sweep.at.keys() <= whole


def test_quick_shortens_every_scheme_of_a_comparison_alike() -> None:
    sites = {"paper": Site(TINY.model_copy(update={"steps": 30}))}
    short = plan(declared(local("eof"), llm()), setup(pace="quick", sites=sites, llm=setup().llm.__class__()))
    assert {p.site.scenario.steps for p in short.flights} == {QUICK_STEPS}
    without = plan(
        declared(local("eof"), llm(), when_quick="no_llm"),
        setup(pace="quick", sites=sites, llm=setup().llm.__class__()),
    )
    assert {p.site.scenario.steps for p in without.flights} == {30}
    assert [scheme.name for scheme in without.left_out] == ["llm"]


def test_a_bound_that_a_scheme_undercuts_is_called_wrong() -> None:
    planned = plan(declared(local("eof"), BOUND), setup(seeds=1))
    bound = BoundFound(lower_bound=5, lost_packets=5, optimal=True, gap=0)
    flights = {
        p.key: flown(bound=bound)
        if p.scheme.name == BOUND.name
        else flown([decided(0, 0)], failures=[0], overflows=[0], lost_packets=[4])
        for p in planned.flights
    }
    notes = findings(planned, setup(seeds=1), "x", flights.get, []).notes
    assert "The bound is wrong: less than it was lost by EOF, seed 0." in notes
