"""The relaxed bound of large fleets, beside the proven optimum of small ones."""

import csv
from pathlib import Path

import pytest

from lab.benchmarks.fleet_bound import FleetBound, least, long_pipeline, main
from shared.world.scenario import SCENARIOS, Scenario
from simulator.bound.clairvoyant_bound import clairvoyant
from simulator.sites.site import Site

pytestmark = pytest.mark.long

SMALL = Scenario(name="small", sensors=6, uavs=2, steps=10, link_share=0.5)


def test_no_fleet_loses_less_and_it_is_of_use() -> None:
    bounds, optima = [], []
    for seed in range(6):
        plan = clairvoyant(Site(SMALL), seed, time_limit_s=30, workers=2)
        assert plan.optimal
        optima.append(plan.lost_packets)
        for cell in (1, 7, 14):
            bounds.append(least(Site(SMALL), seed, cell, 500, plan.lost_packets))
            assert bounds[-1] <= plan.lost_packets
    assert sum(bounds[::3]) > 0.7 * sum(optima) > 0


def test_wind_is_refused() -> None:
    with pytest.raises(ValueError, match="wind"):
        least(Site(SCENARIOS["windy"]), 0, 14, 10, 30.0)


def test_it_writes_the_values_of_each_world(tmp_path: Path) -> None:
    out = tmp_path / "bound.csv"
    assert main(FleetBound(scenario="paper", worlds=2, first=0, rounds=500, out=out)) == 0
    rows = csv.DictReader(out.read_text(encoding="utf-8").splitlines())
    lost = {(row["seed"], row["scheme"]): int(row["lost_packets"]) for row in rows}
    assert len(lost) == 6
    for seed in ("0", "1"):
        assert lost[seed, "bound"] <= lost[seed, "mpc"] < lost[seed, "longest_queue_fast"]


def test_a_long_pipeline_is_shared_by_its_uavs() -> None:
    scenario = long_pipeline()
    assert (scenario.sensors, scenario.uavs, len(scenario.routes)) == (400, 20, 20)
    ends = [route[-1] for route in scenario.routes]
    assert [route[0] for route in scenario.routes[1:]] == ends[:-1]
