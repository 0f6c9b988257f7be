"""Sites from valid world folders."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Geod

from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories
from simulator.commands.options import site_from_options
from simulator.errors import UsageError
from simulator.flying.rollout import rollout
from simulator.policies.registry import policy_named
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.projection import to_metres
from simulator.sites.site import Site
from tests.support.world_folders import (
    EXAMPLE,
    GOOD,
    RING,
    feature,
    sensor,
    there_and_back,
    traced,
    write,
)

EARTH = Geod(ellps="WGS84")


# ---- sites from files


def test_sensors_and_trajectories_become_a_scenario(tmp_path: Path) -> None:
    ring = feature("trajectory", "Polygon", [RING], name="laps")
    pipe = feature("pipeline", "LineString", [[41.5, 39.95], [41.505, 39.952], [41.51, 39.955]])
    scenario = site_from_folder(write(tmp_path, ring, *GOOD, pipe)).scenario
    assert (scenario.layout, scenario.sensors, scenario.uavs, scenario.steps) == ("surveyed", 2, 2, 30)
    assert [len(route) for route in scenario.routes] == [4, 2], "in the file's order"
    assert scenario.routes[0][0] == scenario.routes[0][-1], "a ring is flown in laps"
    assert len(scenario.pipeline) == 3
    assert scenario.pipeline[0] == scenario.sites[0] == scenario.routes[0][0], "what meets on the globe meets here"


def test_a_world_without_a_pipeline_has_none(tmp_path: Path) -> None:
    assert site_from_folder(write(tmp_path, *GOOD)).scenario.pipeline == ()


def test_everything_lies_in_the_area_and_fills_it(tmp_path: Path) -> None:
    scenario = site_from_folder(write(tmp_path, *GOOD, feature("trajectory", "Polygon", [RING]))).scenario
    points = np.array([*scenario.sites, *(point for route in scenario.routes for point in route)])
    assert points.min() >= 0 and points.max() <= scenario.area_m
    assert np.ptp(points, axis=0).max() == pytest.approx(scenario.area_m, abs=1.0)
    np.testing.assert_allclose(points.min(axis=0) + points.max(axis=0), scenario.area_m, atol=0.01, err_msg="centred")


def test_east_is_x_and_north_is_y(tmp_path: Path) -> None:
    west, east, north = sensor("w", 41.50), sensor("e", 41.51), sensor("n", 41.50, 39.96)
    w, e, n = np.array(site_from_folder(write(tmp_path, west, east, north, there_and_back())).scenario.sites)
    assert e[0] - w[0] == pytest.approx(854.7, abs=0.5) and e[1] == pytest.approx(w[1], abs=0.1)
    assert n[1] - w[1] == pytest.approx(1110.4, abs=0.5) and n[0] == pytest.approx(w[0], abs=0.1)


@pytest.mark.parametrize(("apart", "worst"), [(0.1, 1e-6), (1.0, 5e-5), (4.0, 1e-3)])
@pytest.mark.parametrize("centre", [(41.5, 39.95), (180.0, -17.0), (0.0, 0.0), (10.0, 88.0)])
def test_lengths_are_those_on_the_ellipsoid(centre: tuple[float, float], apart: float, worst: float) -> None:
    """The accuracy in the projection's docstring, also across the antimeridian and near a pole."""
    east, north, _ = EARTH.fwd([centre[0]] * 8, [centre[1]] * 8, np.arange(8) * 45.0, [apart * 1e5] * 8)
    points = np.stack((east, north), axis=-1)
    plane = to_metres(points)
    for here, there, a, b in zip(points, np.roll(points, 1, 0), plane, np.roll(plane, 1, 0), strict=True):
        true_m = EARTH.inv(*here, *there)[2]
        assert np.hypot(*(a - b)) == pytest.approx(true_m, rel=worst, abs=0.01)


def test_a_world_across_the_antimeridian_is_no_larger_for_it(tmp_path: Path) -> None:
    line = there_and_back([179.995, -17.0], [-179.995, -17.0])
    scenario = site_from_folder(write(tmp_path, sensor("a", 180.0, -17.0), sensor("b", -180.0, -17.0), line)).scenario
    assert scenario.area_m == pytest.approx(1065, abs=2)
    assert scenario.sites[0] == scenario.sites[1]


def test_altitudes_are_left_out_and_foreign_members_ignored(tmp_path: Path) -> None:
    high = feature("sensor", "Point", [41.505, 39.95, 1900.5], id="b", depth=2)
    flat = site_from_folder(write(tmp_path, *GOOD)).scenario
    assert site_from_folder(write(tmp_path, GOOD[0], high, GOOD[2], name="x", bbox=[9, 9, 0, 0])).scenario == flat


@pytest.mark.parametrize("name", ["urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326"])
def test_a_crs_member_may_name_the_default(tmp_path: Path, name: str) -> None:
    site_from_folder(write(tmp_path, *GOOD, crs={"type": "name", "properties": {"name": name}}))


def test_an_id_may_be_a_number_a_name_or_the_features_own(tmp_path: Path) -> None:
    number, named = feature("sensor", "Point", [41.5, 39.95], id=7), feature("sensor", "Point", [41.5, 39.95], name="n")
    own = {**feature("sensor", "Point", [41.5, 39.95]), "id": "own"}
    trace = traced(30, "step,own,7,n", "1,2,3")
    site = site_from_folder(write(tmp_path, number, named, own, there_and_back(), trace=trace))
    assert site.arrivals is not None and site.arrivals[0].tolist() == [2, 3, 1]


@pytest.mark.parametrize(
    ("folder", "name"),
    [("North Field 2", "north_field_2"), ("2024-süd", "world_2024_s_d"), ("___", "world"), ("x" * 40, "x" * 32)],
)
def test_a_world_is_called_like_its_folder(tmp_path: Path, folder: str, name: str) -> None:
    (tmp_path / folder).mkdir()
    assert site_from_folder(write(tmp_path / folder, *GOOD)).scenario.name == name


def test_other_numbers_come_from_the_toml(tmp_path: Path) -> None:
    toml = 'name = "mine"\nsteps = 12\nradio_radius_m = 200\narrival_rate_max = 2.5\n'
    scenario = site_from_folder(write(tmp_path, *GOOD, toml=toml)).scenario
    assert (scenario.name, scenario.steps, scenario.radio_radius_m, scenario.arrival_rate_max) == ("mine", 12, 200, 2.5)
    assert scenario.queue_capacity == Scenario().queue_capacity
    assert site_from_folder(tmp_path, steps=7).scenario.steps == 7, "the command line is asked first"


def test_a_trace_gives_the_arrivals_and_the_seed_draws_the_rest(tmp_path: Path) -> None:
    trace = "\ufeffstep, b ,a\r\n" + "".join(f"{t},{t},{10 * t}\r\n" for t in range(40)) + "\r\n"
    site = site_from_folder(write(tmp_path, *GOOD, trace=trace))
    one, two = site.world(), site.world()
    one.reset(seed=1)
    two.reset(seed=2)
    for world in (one, two):
        np.testing.assert_array_equal(world.sensors.arrivals, [(10 * t, t) for t in range(30)])
    assert one.fleet.start_m != two.fleet.start_m
    assert not np.array_equal(one.sensors.initial_queue, two.sensors.initial_queue)


def test_a_gain_trace_is_interpolated_around_the_trajectory(tmp_path: Path) -> None:
    plain = site_from_folder(write(tmp_path, *GOOD)).world()
    lap = trajectories(plain.scenario)[0].length_m
    gains = f"\ufeffuav, sensor ,progress_m,excess_db\r\n0,b,{0.5 * lap},10\r\n0, b ,{0.25 * lap},-2\r\n\r\n"
    site = site_from_folder(write(tmp_path, *GOOD, gains=gains))
    world = site.world()
    observed, unaided = world.reset(seed=1)[0]["uav_0"], plain.reset(seed=1)[0]["uav_0"]
    along = world.fleet.progress_m[0] / lap % 1
    expected = np.interp(along, [-0.5, 0.25, 0.5, 1.25], [10, -2, 10, -2])
    more = unaided["channel_gain"] - observed["channel_gain"]
    np.testing.assert_allclose(more, [0.0, expected], atol=1e-5)
    assert set(unaided["last_heard"]) == {0}


def test_the_same_files_are_the_same_site(tmp_path: Path) -> None:
    first, second = site_from_folder(write(tmp_path, *GOOD)), site_from_folder(tmp_path)
    assert first.scenario == second.scenario and first.arrivals is second.arrivals is None


def test_a_sensor_out_of_reach_is_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far = sensor("far", 41.5, 39.94)
    warnings: list[str] = []
    site_from_folder(write(tmp_path, *GOOD, far), on_warning=warnings.append)
    assert len(warnings) == 1 and "1 of 3 sensors can be reached from no trajectory ('far')" in warnings[0]
    site_from_options(None, tmp_path)
    assert capsys.readouterr().err == f"warning: {warnings[0]}\n"


def test_a_warning_names_a_few_of_many(tmp_path: Path) -> None:
    warnings: list[str] = []
    far = [sensor(f"s{j}", 41.5, 39.94) for j in range(9)]
    site_from_folder(write(tmp_path, *GOOD, *far), on_warning=warnings.append)
    assert "9 of 11 sensors" in warnings[0] and "'s4' and others" in warnings[0] and "'s5'" not in warnings[0]


@pytest.mark.parametrize(("metres", "reached"), [(355, True), (365, False)])
def test_sensors_in_reach_are_within_the_radio_radius(tmp_path: Path, metres: float, reached: bool) -> None:
    east, north, _ = EARTH.fwd(41.5, 39.95, 180.0, metres)
    warnings: list[str] = []
    line = there_and_back([41.49, 39.95], [41.51, 39.95])
    site_from_folder(write(tmp_path, sensor("x", east, north), line), on_warning=warnings.append)
    assert (not warnings) == reached


# ---- the commands' choice


def test_with_neither_a_scenario_nor_a_world_the_paper() -> None:
    assert site_from_options(None, None).scenario == Scenario()
    assert site_from_options("stress", None, 4).scenario.steps == 4


def test_a_scenario_and_a_world_contradict_each_other(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--scenario paper and --world .* contradict"):
        site_from_options("paper", write(tmp_path, *GOOD))


@pytest.mark.parametrize("steps", [0, 10_001])
def test_steps_out_of_bounds(tmp_path: Path, steps: int) -> None:
    with pytest.raises(UsageError, match=f"--steps {steps} is not between 1 and 10000"):
        site_from_options(None, write(tmp_path, *GOOD), steps)


# ---- the worked example


def test_the_example_matches_its_readme() -> None:
    warnings: list[str] = []
    site = site_from_folder(EXAMPLE, on_warning=warnings.append)
    scenario = site.scenario
    assert not warnings, "a UAV can reach every sensor"
    assert (scenario.name, scenario.sensors, scenario.uavs, scenario.steps) == ("pipeline_world", 14, 3, 60)
    assert site.arrivals is not None and site.arrivals.shape == (60, 14)
    lengths = [path.length_m for path in trajectories(scenario)]
    assert 3500 < min(lengths) < max(lengths) < 4300
    assert scenario.arrival_rate_min <= site.arrivals.mean() <= scenario.arrival_rate_max
    assert set(tomllib.loads((EXAMPLE / "scenario.toml").read_text(encoding="utf-8"))) <= set(Scenario.model_fields)


def test_on_the_example_policies_differ() -> None:
    site = site_from_folder(EXAMPLE)

    def lost(name: str) -> int:
        return sum(t.lost_packets for seed in range(5) for t in rollout(site.world(), policy_named(name), seed))

    assert 2 * lost("eof") < lost("random")


def test_the_examples_trace_is_its_scripts(tmp_path: Path) -> None:
    for name in ("make_arrivals.py", "world.geojson"):
        (tmp_path / name).write_bytes((EXAMPLE / name).read_bytes())
    script: dict[str, Any] = {"__name__": "script", "__file__": str(tmp_path / "make_arrivals.py")}
    exec(compile((tmp_path / "make_arrivals.py").read_text(encoding="utf-8"), "make_arrivals.py", "exec"), script)
    script["main"]()
    assert (tmp_path / "arrivals.csv").read_bytes() == (EXAMPLE / "arrivals.csv").read_bytes()


def test_a_world_without_its_trace_draws_arrivals(tmp_path: Path) -> None:
    (tmp_path / "world.geojson").write_bytes((EXAMPLE / "world.geojson").read_bytes())
    site: Site = site_from_folder(tmp_path)
    assert site.arrivals is None
    world = site.world()
    world.reset(seed=0)
    assert world.sensors.arrivals.shape == (30, 14)
