"""The checks of the options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from shared.world.scenario import SCENARIOS
from simulator.commands.options import (
    WorldOptions,
    check_between,
    check_deadline,
    check_seed,
    check_wait,
    edge_from_option,
    site_of,
)
from simulator.errors import UsageError


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: check_seed(2**32), "--seed 4294967296 is not between 0 and 4294967295"),
        (lambda: check_seed(-1), "--seed -1 is not between 0 and 4294967295"),
        (lambda: check_wait(90_000.5), "--wait-s 90000.5 is not between 0 and 86400"),
        (lambda: check_wait(float("nan")), "--wait-s nan is not between 0 and 86400"),
        (lambda: check_deadline(9), "--deadline-ms 9 is not between 10 and 60000"),
        (lambda: check_between("--time-limit-s", 0.0, 0.1, 86_400), "--time-limit-s 0 is not between 0.1 and 86400"),
        (lambda: edge_from_option(None), "--edge is missing: give the edge's address"),
        (lambda: edge_from_option("ftp://edge"), "--edge: "),
    ],
)
def test_the_error_for_a_value_out_of_bounds_has_the_bounds(check: Callable[[], object], message: str) -> None:
    with pytest.raises(UsageError) as error:
        check()
    assert str(error.value).startswith(message)


def test_values_on_their_bounds_are_taken() -> None:
    check_seed(0)
    check_seed(2**32 - 1)
    check_wait(86_400)
    check_deadline(None)
    check_deadline(10)
    assert edge_from_option("http://127.0.0.1:8000").startswith("http://127.0.0.1:8000")


def test_a_scenario_changes_by_options_and_is_named_so() -> None:
    site = site_of(WorldOptions(sensors=20, uavs=5, steps=4, set=("wind_mps=4", "layout=pipeline", "link_share=0.5")))
    expected = {"sensors": 20, "uavs": 5, "steps": 4, "wind_mps": 4.0, "layout": "pipeline", "link_share": 0.5}
    assert site.scenario == SCENARIOS["paper"].model_copy(update={**expected, "name": site.scenario.name})
    other = site_of(WorldOptions(sensors=20, uavs=4)).scenario.name
    assert site.scenario.name.startswith("paper_changed_") and other != site.scenario.name
    assert site_of(WorldOptions(scenario="stress", set=("name=mine",))).scenario.name == "mine"
    assert site_of(WorldOptions(steps=4)).scenario.name == "paper"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            WorldOptions(set=("wnd_mps=4",)),
            "--set wnd_mps=4: a scenario has no field 'wnd_mps'; did you mean wind_mps?",
        ),
        (WorldOptions(set=("wind_mps",)), "--set wind_mps: write FIELD=VALUE"),
        (WorldOptions(set=("link_share=2",)), "--set link_share=2: must be less than or equal to 1"),
        (WorldOptions(set=("battery_j=[1]",)), "--set battery_j=[1]: must be a valid number"),
        (WorldOptions(set=("link_share=NaN",)), "--set link_share=NaN: must be a finite number"),
        (WorldOptions(set=("arrival_rate_min=9",)), "--set: arrival_rate_min exceeds arrival_rate_max"),
        (WorldOptions(scenario="faulty", uavs=1), "--set: departures is 1 of 1 UAVs: at least one has to stay"),
        (WorldOptions(sensors=0), "--sensors 0: must be greater than or equal to 1"),
        (WorldOptions(steps=0), "--steps 0 is not between 1 and 10000"),
        (WorldOptions(scenario="papr"), "--scenario: unknown scenario 'papr'"),
        (WorldOptions(world=Path("w"), sensors=3), "--world w: its files have the value of sensors; change it there"),
    ],
)
def test_the_error_for_a_changed_scenario_names_the_option(options: WorldOptions, message: str) -> None:
    with pytest.raises(UsageError) as error:
        site_of(options)
    assert str(error.value).startswith(message)
