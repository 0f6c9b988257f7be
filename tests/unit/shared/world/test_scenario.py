"""Scenarios: presets, bounds, contradictions, and the geometry that they imply."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from shared.world.scenario import SCENARIOS, Scenario, scenario_named

UNMODELLED = ["shadowed", "fading", "bursty", "windy", "faulty", "field"]


def test_presets_are_named_as_they_are_filed() -> None:
    assert list(SCENARIOS) == ["paper", "paper_light", "pipeline", "stress", "dense", "lossy_uplink", *UNMODELLED]
    assert all(scenario_named(name).name == name for name in SCENARIOS)


def test_paper_has_the_papers_numbers() -> None:
    paper = scenario_named("paper")
    assert paper == Scenario()
    assert (paper.sensors, paper.uavs, paper.steps, paper.queue_capacity) == (10, 3, 30, 60)
    assert paper.mean_arrival_rate == 5.0


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="unknown scenario 'mars': choose one of paper, paper_light, pipeline"):
        scenario_named("mars")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sensors", 0),
        ("sensors", 10_001),
        ("uavs", 101),
        ("steps", 0),
        ("area_m", 0.0),
        ("altitude_m", 0.0),
        ("step_s", float("nan")),
        ("battery_j", float("inf")),
        ("max_velocity", 15),
        ("queue_capacity", 2.5),
        ("initial_queue_min", 1.1),
        ("arrival_rate_min", -1.0),
        ("link_share", 0.0),
        ("uplink_drop", 1.0),
        ("layout", "grid"),
        ("pipeline", ((0.0, 0.0),)),
        ("name", "Paper"),
        ("gravity", 9.81),
    ],
)
def test_a_field_out_of_bounds_is_named(field: str, value: Any) -> None:
    with pytest.raises(ValidationError) as caught:
        Scenario(**{field: value})
    assert [error["loc"][0] for error in caught.value.errors()] == [field]


def test_only_layout_pipeline_needs_a_pipeline() -> None:
    assert Scenario(pipeline=()).pipeline == ()
    with pytest.raises(ValidationError, match="layout pipeline needs a pipeline of at least two points"):
        Scenario(layout="pipeline", pipeline=())


def test_ranges_that_contradict_themselves() -> None:
    with pytest.raises(ValidationError, match="arrival_rate_min exceeds arrival_rate_max"):
        Scenario(arrival_rate_min=9.0)
    with pytest.raises(ValidationError, match="initial_queue_min exceeds initial_queue_max"):
        Scenario(initial_queue_max=0.2)


def test_every_radio_may_die_and_all_uavs_but_one_may_leave() -> None:
    assert Scenario(sensors=4, dead_radios=4, uavs=3, departures=2).dead_radios == 4
    with pytest.raises(ValidationError, match="dead_radios is 5, there are 4 sensors"):
        Scenario(sensors=4, dead_radios=5)
    with pytest.raises(ValidationError, match="departures is 3 of 3 UAVs: at least one has to stay"):
        Scenario(uavs=3, departures=3)


def test_surveyed_sites_are_in_the_area_or_on_its_edge_one_a_sensor() -> None:
    surveyed: dict[str, Any] = {"layout": "surveyed", "area_m": 500.0, "sensors": 2}
    assert len(Scenario(**surveyed, sites=((0.0, 500.0), (500.0, 0.0))).sites) == 2
    for outside in ((500.1, 0.0), (0.0, -0.1)):
        with pytest.raises(ValidationError, match=r"a position outside the area of 0\.\.500 m"):
            Scenario(**surveyed, sites=((0.0, 500.0), outside))
    with pytest.raises(ValidationError, match="1 sites for 2 sensors"):
        Scenario(**surveyed, sites=((0.0, 500.0),))


def test_every_uav_has_a_route_or_none_has() -> None:
    with pytest.raises(ValidationError, match="routes has 1 trajectories for 2 UAVs"):
        Scenario(uavs=2, routes=(((0.0, 0.0), (9.0, 0.0)),))


def test_a_scenario_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        scenario_named("paper").sensors = 3  # type: ignore[misc]


def test_a_hash_reads_one_point_of_a_site_and_equality_all() -> None:
    one, same, other = (Scenario(routes=(((0.0, 0.0), (9.0, y)),) * 3) for y in (1.0, 1.0, 2.0))
    assert {one: "a", other: "b"} == {same: "a", other: "b"}
    far: Any = [0.0, 0.0]  # a list has no hash
    assert hash(Scenario.model_construct(sites=((0.0, 0.0), far), routes=(((0.0, 0.0), far),)))


def test_a_scenario_survives_json() -> None:
    for scenario in SCENARIOS.values():
        assert Scenario.model_validate_json(scenario.model_dump_json()) == scenario


def test_lap_centres_are_spread_from_due_north() -> None:
    expected = [(500.0, 750.0), (500 - 250 * np.sqrt(0.75), 375.0), (500 + 250 * np.sqrt(0.75), 375.0)]
    np.testing.assert_allclose(scenario_named("paper").lap_centres, expected)


def test_every_point_of_the_area_is_within_260_m_of_a_lap() -> None:
    paper = scenario_named("paper")
    x, y = np.meshgrid(np.linspace(0, 1000, 101), np.linspace(0, 1000, 101))
    gaps = [np.abs(np.hypot(x - cx, y - cy) - paper.lap_radius_m) for cx, cy in paper.lap_centres]
    # The farthest are the two southern corners, 259.02 m.
    assert 259.0 < np.min(gaps, axis=0).max() < 260.0
    assert paper.radio_radius_m > 260.0


def test_a_world_too_large_to_draw_is_refused() -> None:
    with pytest.raises(ValidationError, match="sensors x steps"):
        Scenario(sensors=2_000, steps=10_000)
    with pytest.raises(ValidationError, match="less than or equal to 2000"):
        Scenario(sensors=2_001)
