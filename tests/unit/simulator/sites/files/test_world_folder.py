"""Sites from valid world folders."""

from __future__ import annotations

import math
import tomllib
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from pyproj import Geod

from shared.world.scenario import Scenario
from shared.world.trajectory import Polyline, trajectories
from simulator.commands.options import site_from_options
from simulator.errors import UsageError
from simulator.flying.flight import rollout
from simulator.policies.registry import policy_named
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.projection import Frame, centre_of
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
    plane = Frame(*centre_of(points), (0.0, 0.0)).metres(points)
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


@pytest.mark.parametrize(
    "named",
    [
        *({"name": name} for name in (
            "urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "epsg:4326", "urn:ogc:def:crs:EPSG::4326", "OGC:CRS84",
            "urn:x-ogc:def:crs:EPSG:6.9:4326", "http://www.opengis.net/def/crs/EPSG/0/4326", "CRS:84", "CRS84",
            "https://www.opengis.net/def/crs/OGC/1.3/CRS84", "http://www.opengis.net/gml/srs/epsg.xml#4326", "WGS 84",
        )),
        {"code": 4326},
        {"href": "http://spatialreference.org/ref/epsg/4326/proj4/"},
    ],
)  # fmt: skip
def test_a_crs_member_may_name_the_default(tmp_path: Path, named: dict[str, Any]) -> None:
    site_from_folder(write(tmp_path, *GOOD, crs={"type": "name", "properties": named}))


def test_a_whole_float_is_an_id_and_names_of_others_may_be_long(tmp_path: Path) -> None:
    number = feature("sensor", "Point", [41.5, 39.95], id=7.0, name="x" * 88)
    line = feature("trajectory", "LineString", [[41.5, 39.95], [41.51, 39.955]], name="x" * 88, id=7.5)
    assert site_from_folder(write(tmp_path, number, line)).sensor_names == ("7",)


def test_a_multi_geometry_of_one_part_is_that_part(tmp_path: Path) -> None:
    plain = (*GOOD, feature("no_fly", "Polygon", [[[x + 0.1, y] for x, y in RING]]))
    expected = site_from_folder(write(tmp_path, *plain))
    shapes = [one["geometry"] for one in plain]
    parts = [{"type": f"Multi{shape['type']}", "coordinates": [shape["coordinates"]]} for shape in shapes]
    multi = [{**one, "geometry": part} for one, part in zip(plain, parts, strict=True)]
    site = site_from_folder(write(tmp_path, *multi))
    assert (site.scenario, site.fences) == (expected.scenario, expected.fences)


def test_a_line_cut_at_the_antimeridian_is_one(tmp_path: Path) -> None:
    """As RFC 7946 has lines that cross it."""
    cut = feature(
        "trajectory", "MultiLineString", [[[179.99, -17], [180, -17.005]], [[-180, -17.005], [-179.99, -17.01]]]
    )
    [route] = site_from_folder(write(tmp_path, sensor("a", 180.0, -17.0), cut)).scenario.routes
    assert len(route) == 3 and max(math.dist(*leg) for leg in pairwise(route)) < 1300


@pytest.mark.parametrize(
    "length", [pytest.param(1_017, id="the real pipeline that was refused"), pytest.param(20_000, id="a longer one")]
)
def test_a_long_pipeline_is_simplified(tmp_path: Path, length: int) -> None:
    bends = [[41.5 + 1e-6 * k, 39.95 + 1e-3 * math.sin(k / length * 20)] for k in range(length)]
    scenario = site_from_folder(write(tmp_path, *GOOD, feature("pipeline", "LineString", bends))).scenario
    drawn = np.array(scenario.pipeline)
    assert len(drawn) == 1000
    frame = site_from_folder(tmp_path).frame
    assert frame is not None
    truly = frame.metres(bends)
    np.testing.assert_allclose(drawn[[0, -1]], truly[[0, -1]], atol=0.001)
    line = Polyline(drawn)
    assert max(line.locate((x, y))[1] for x, y in truly[:: length // 100].tolist()) < 0.5


def test_the_parts_of_a_pipeline_are_joined_end_to_end(tmp_path: Path) -> None:
    parts = [[[41.5 + k * 1e-5, 39.95], [41.5 + (k + 1) * 1e-5, 39.95]] for k in range(1483)]
    shuffled = [part[:: 1 - 2 * (k % 2)] for k, part in enumerate(Random(1).sample(parts, len(parts)))]
    warnings: list[str] = []
    halves = [feature("pipeline", "MultiLineString", half) for half in (shuffled[:700], shuffled[700:])]
    scenario = site_from_folder(write(tmp_path, *GOOD, *halves), on_warning=warnings.append).scenario
    assert len(scenario.pipeline) == 1000 and not warnings
    assert Polyline(scenario.pipeline).length_m / 2 == pytest.approx(1483 * 0.8547, rel=0.001)


def test_a_pipeline_with_gaps_is_joined_and_said(tmp_path: Path) -> None:
    parts = [[[41.5 + 0.002 * k, 39.95], [41.501 + 0.002 * k, 39.95]] for k in range(3)]
    warnings: list[str] = []
    site_from_folder(write(tmp_path, *GOOD, feature("pipeline", "MultiLineString", parts)), on_warning=warnings.append)
    assert ["the pipeline's parts are up to 85 m apart; pictures show them joined" in text for text in warnings] == [
        True
    ]


@pytest.mark.parametrize("length", [2.8, 9.0])
def test_a_long_line_is_straight_in_degrees(tmp_path: Path, length: float) -> None:
    """A parallel's 200 and 640 km: straight in the plane they are 900 m and 9 km off."""
    line = there_and_back([10.0, 50.0], [10.0 + length, 50.0])
    site = site_from_folder(write(tmp_path, sensor("a", 10.0, 50.0), line))
    assert site.frame is not None
    [path] = trajectories(site.scenario)
    for place in site.frame.metres([[10.0 + length * share, 50.0] for share in np.linspace(0, 1, 41)]).tolist():
        assert path.locate(tuple(place))[1] < 0.6


def test_a_fence_is_straight_in_degrees_too(tmp_path: Path) -> None:
    """A line 300 m south of a parallel of 200 km is clear of the area north of it, and 300 m north is in it."""
    area = feature("no_fly", "Polygon", [[[10, 50], [12.8, 50], [12.8, 50.5], [10, 50.5], [10, 50]]])
    clear = there_and_back([10.0, 49.9973], [12.8, 49.9973])
    site_from_folder(write(tmp_path, sensor("a", 10.0, 50.0), clear, area))
    with pytest.raises(UsageError, match="enters the no_fly area"):
        site_from_folder(
            write(tmp_path, sensor("a", 10.0, 50.0), there_and_back([11.3, 50.0027], [11.5, 50.0027]), area)
        )


@pytest.mark.parametrize("east", [-179.99, -180.0, -178.8])
def test_a_fence_across_the_antimeridian_is_a_fence(tmp_path: Path, east: float) -> None:
    ring = [[179.99, -17.02], [east, -17.02], [east, -16.98], [179.99, -16.98], [179.99, -17.02]]
    line = there_and_back([179.992, -17.0], [179.996, -17.0])
    area = feature("fence", "Polygon", [ring])
    assert len(site_from_folder(write(tmp_path, sensor("a", 179.994, -17.0), line, area)).fences) == 1


@pytest.mark.parametrize(
    ("ring", "complaint"),
    [
        ([[-180, -90], [180, -90], [180, 90], [-180, 90]], "the fence is more than 2,000 km away; draw it nearer"),
        (
            [[-180, 80], [180, 80], [180, 90], [-180, 90]],
            "an edge goes around the Earth; give it corners that are near",
        ),
        (
            [[-179, 80], [179, 80], [179, 90], [-179, 90]],
            "an edge goes around the Earth; give it corners that are near",
        ),
    ],
)
def test_an_area_around_the_earth_is_refused(tmp_path: Path, ring: list[list[float]], complaint: str) -> None:
    area = feature("no_fly", "Polygon", [[*ring, ring[0]]])
    line = there_and_back([10.0, 85.0], [10.1, 85.0])
    with pytest.raises(UsageError, match=complaint):
        site_from_folder(write(tmp_path, sensor("a", 10.0, 85.0), line, area))


def test_too_many_waypoints_between_are_refused(tmp_path: Path) -> None:
    line = there_and_back(*[[10.0, 50.0], [12.8, 50.0]] * 40)
    with pytest.raises(UsageError, match="straight in degrees, are 5,057 waypoints in metres, at most 1,000; shorten"):
        site_from_folder(write(tmp_path, sensor("a", 10.0, 50.0), line))


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
