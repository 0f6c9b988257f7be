"""Flight plans into worlds and back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.world.scenario import Point
from simulator.commands import world
from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.survey import read_survey
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.plans.mission_path import items_of, path_of
from simulator.sites.plans.plan_folder import export_plans, import_plans
from simulator.sites.plans.qgroundcontrol import read_plan
from tests.support.flight_plans import (
    AGAIN,
    TAKE_OFF,
    TRIANGLE,
    A,
    B,
    C,
    Json,
    item,
    plan,
    waypoint,
    write,
)
from tests.support.world_folders import EXAMPLE, feature, sensor
from tests.support.world_folders import write as write_world

AROUND = [[39.94, 41.49], [39.94, 41.52], [39.97, 41.52], [39.97, 41.49]]
FENCED: Json = {"circles": [], "polygons": [{"inclusion": True, "polygon": AROUND, "version": 1}], "version": 2}


def turned(*places: tuple[float, float]) -> list[Point]:
    return [(longitude, latitude) for latitude, longitude in places]


def test_a_plan_becomes_a_trajectory_and_a_fence(tmp_path: Path) -> None:
    path = write(tmp_path / "north.plan", plan(TAKE_OFF, *TRIANGLE, AGAIN, geoFence=FENCED))
    made = import_plans([path], tmp_path / "world", overwrite=False)
    assert (made.trajectories, made.fences, made.sensors, made.altitudes_m) == (1, 1, 0, frozenset({60.0}))
    survey = read_survey(made.path)
    assert list(survey.trajectories.values()) == [turned(A, B, C, A)]
    assert list(survey.trajectories) == ["features[0] ('north')"]
    [fence] = survey.fences.values()
    assert fence == Fence("fence", tuple(turned(*((a, b) for a, b in [*AROUND, AROUND[0]]))))


def test_sensors_that_are_there_stay_and_trajectories_are_replaced_only_as_asked(tmp_path: Path) -> None:
    write_world(tmp_path, sensor("a"), sensor("b", 41.505))
    path = write(tmp_path / "a.plan", plan(*TRIANGLE, AGAIN, geoFence=FENCED))
    import_plans([path], tmp_path, overwrite=False)
    site = site_from_folder(tmp_path)
    assert site.sensor_names == ("a", "b") and site.scenario.uavs == 1 and len(site.fences) == 1
    with pytest.raises(UsageError, match="has 1 trajectories; add --overwrite"):
        import_plans([path, path], tmp_path, overwrite=False)
    import_plans([path, path], tmp_path, overwrite=True)
    again = site_from_folder(tmp_path)
    assert (again.scenario.uavs, again.sensor_names, len(again.fences)) == (2, ("a", "b"), 1)


def test_fences_that_are_there_are_replaced_only_by_fences_and_as_asked(tmp_path: Path) -> None:
    bare, fenced = (
        write(tmp_path / "a.plan", plan(*TRIANGLE)),
        write(tmp_path / "b.plan", plan(*TRIANGLE, geoFence=FENCED)),
    )
    ring = [list(place[::-1]) for place in [*AROUND, AROUND[0]]]
    circle = feature("no_fly", "Point", [41.7, 39.99], radius_m=20.0)
    (tmp_path / "w").mkdir()
    folder = write_world(tmp_path / "w", sensor("a"), feature("fence", "Polygon", [ring]), circle)
    before = read_survey(folder / "world.geojson").fences.values()
    made = import_plans([bare], folder, overwrite=False)
    assert (made.fences, made.replaced) == (2, 0)
    assert import_plans([bare], folder, overwrite=True).replaced == 0
    assert list(read_survey(folder / "world.geojson").fences.values()) == list(before)
    write_world(folder, sensor("a"), circle)
    with pytest.raises(
        UsageError, match=r"features\[1\]: the plans' geofence would replace this fence; add --overwrite"
    ):
        import_plans([fenced], folder, overwrite=False)
    assert len(read_survey(folder / "world.geojson").fences) == 1
    made = import_plans([fenced], folder, overwrite=True)
    assert (made.fences, made.replaced) == (1, 1)


def test_what_no_vehicle_reaches_may_follow_a_jump(tmp_path: Path) -> None:
    path = write(tmp_path / "a.plan", plan(TAKE_OFF, *TRIANGLE, AGAIN, waypoint(*A, 6), item(21)))
    assert read_plan(path).path.repeats
    path = write(tmp_path / "a.plan", plan(TAKE_OFF, *TRIANGLE, item(177, 2, 3), item(206), item(20)))
    assert read_plan(path).path.repeats


def test_what_is_flown_back_the_way_it_came_is_a_line(tmp_path: Path) -> None:
    back = [waypoint(*place, number=number) for number, place in enumerate((A, B, C, B), start=2)]
    flown = read_plan(write(tmp_path / "a.plan", plan(TAKE_OFF, *back, item(177, 2, -1, number=6)))).path
    assert list(flown.trajectory) == turned(A, B, C)
    once = read_plan(write(tmp_path / "b.plan", plan(TAKE_OFF, *TRIANGLE, item(20)))).path
    assert not once.repeats and list(once.trajectory) == turned(A, B, C)


def test_a_corridor_scan_is_its_waypoints(tmp_path: Path) -> None:
    scan = {"type": "ComplexItem", "complexItemType": "CorridorScan", "TransectStyleComplexItem": {"Items": TRIANGLE}}
    assert len(read_plan(write(tmp_path / "a.plan", plan(TAKE_OFF, scan))).path.waypoints) == 3


def test_the_world_comes_back_from_its_plans(tmp_path: Path) -> None:
    paths = export_plans(EXAMPLE, tmp_path / "plans", overwrite=False)
    assert [path.name for path in paths] == ["uav_0.plan", "uav_1.plan", "uav_2.plan"]
    import_plans(paths, tmp_path / "again", overwrite=False)
    before = read_survey(EXAMPLE / "world.geojson").trajectories.values()
    after = read_survey(tmp_path / "again" / "world.geojson").trajectories.values()
    for was, now in zip(before, after, strict=True):
        assert [tuple(point) for point in now] == [pytest.approx(point, abs=1e-7) for point in was]
    with pytest.raises(UsageError, match="uav_0.plan is there already"):
        export_plans(EXAMPLE, tmp_path / "plans", overwrite=False)


def test_the_fences_come_back_too(tmp_path: Path) -> None:
    circle = feature("no_fly", "Point", [41.58, 39.95], radius_m=200.0)
    ring = [[41.4, 39.9], [41.6, 39.9], [41.6, 40.0], [41.4, 40.0], [41.4, 39.9]]
    line = feature("trajectory", "LineString", [[41.5, 39.95], [41.51, 39.955]])
    world_folder = tmp_path / "world"
    world_folder.mkdir()
    write_world(world_folder, sensor("a"), line, feature("fence", "Polygon", [ring]), circle)
    import_plans(export_plans(world_folder, tmp_path, overwrite=False), tmp_path / "again", overwrite=False)
    again = read_survey(tmp_path / "again" / "world.geojson").fences.values()
    assert list(again) == list(read_survey(world_folder / "world.geojson").fences.values())


PLACES = st.tuples(st.integers(-1800000, 1800000), st.integers(-850000, 850000)).map(lambda p: (p[0] / 1e4, p[1] / 1e4))


@given(st.lists(PLACES.filter(lambda place: place != (0, 0)), min_size=2, max_size=6, unique=True), st.booleans())
def test_the_items_of_any_trajectory_make_its_path(places: list[Point], ring: bool) -> None:
    trajectory = (*places, places[0]) if ring and len(places) > 2 else tuple(places)
    path = path_of(items_of(trajectory, 60.0))
    assert path.repeats and path.trajectory == trajectory


BROKEN: list[tuple[Any, str]] = [
    ([], 'no plan of QGroundControl: its top level needs "fileType": "Plan"'),
    (plan(*TRIANGLE, fileType="Mission"), 'needs "fileType": "Plan"'),
    (plan(*TRIANGLE, mission={}), "mission.items: is missing"),
    (plan(*TRIANGLE, mission={"items": [{"type": "Loop"}]}), "mission.items[0]: is of an unknown type, not"),
    (plan(TRIANGLE[0] | {"params": [1, 2]}), "mission.items[0].params: must have at least 7 items"),
    (plan(TRIANGLE[0], TRIANGLE[1] | {"params": ["x"] * 7}), "mission.items[1].params[0]: must be a valid num"),
    (plan(*TRIANGLE[:1]), "1 waypoints; a path needs at least two that differ"),
    (plan(TRIANGLE[0], waypoint(None, None, 3)), "mission.items[1]: the waypoint has no position"),
    (plan(TRIANGLE[0], waypoint(95.0, 41.5, 3)), "mission.items[1].params: 95, 41.5 is no latitude and longitude"),
    (plan(*TRIANGLE, item(18, number=9)), "mission.items[3]: command 18 is no straight leg; use waypoints (16)"),
    (plan(*TRIANGLE, item(177, 3, -1)), "mission.items[3]: it jumps to item 3; only a jump to the first waypoint"),
    (plan(*TRIANGLE, item(177, 2, 0)), "mission.items[3]: it repeats 0 times"),
    (plan(*TRIANGLE, {"type": "ComplexItem", "complexItemType": "fwLandingPattern"}), "item 'fwLandingPattern' has no"),
    (plan(*TRIANGLE, geoFence={"polygons": [{"polygon": AROUND}]}), "geoFence.polygons[0].inclusion: is missing"),
    # Whatever is flown after the path's end.
    (
        plan(*TRIANGLE, item(21, number=5), item(211, 1, 0, number=6), TAKE_OFF | {"doJumpId": 7}, *TRIANGLE),
        "mission.items[5]: command 22 comes after mission.items[3] (command 21), where the path ends",
    ),
    (plan(*TRIANGLE, item(20), waypoint(*B, 6)), "mission.items[4]: command 16 comes after mission.items[3]"),
    (plan(*TRIANGLE, item(177, 2, 3), waypoint(*A, 6)), "mission.items[4]: command 16 comes after mission.items[3]"),
    (plan(*TRIANGLE, item(21), item(177, 2, -1)), "mission.items[4]: command 177 comes after mission.items[3]"),
    (
        plan(*TRIANGLE, geoFence={"polygon": AROUND, "version": 1}),
        "geoFence.version is 1; a geofence of version 2 is read: open the plan in QGroundControl",
    ),
    (plan(*TRIANGLE, geoFence={"polygon": AROUND}), "geoFence.polygon is not known; a geofence of version 2"),
    (
        plan(*TRIANGLE, geoFence={"version": 2, "circles": [{"inclusion": True, "center": [1, 2], "radius": 3}]}),
        "geoFence.circles[0].circle: is missing",
    ),
    (plan(*TRIANGLE, geoFence=FENCED | {"corridors": []}), "geoFence.corridors is not known"),
    (
        plan(*TRIANGLE, geoFence={"circles": [{"inclusion": True, "circle": {"center": [1, 2], "radius": -3}}]}),
        "geoFence.circles[0].circle.radius: must be greater than 0, not -3",
    ),
    (
        plan(*TRIANGLE, geoFence={"polygons": [FENCED["polygons"][0], {"inclusion": True, "polygon": AROUND[:3]}]}),
        "geoFence: this is the second inclusion area",
    ),
]


@pytest.mark.parametrize(("document", "names"), BROKEN)
def test_a_broken_plan_is_refused_with_its_field(tmp_path: Path, document: Any, names: str) -> None:
    path = write(tmp_path / "broken.plan", document)
    with pytest.raises(UsageError) as refused:
        import_plans([path], tmp_path / "world", overwrite=False)
    assert str(refused.value).startswith(str(path)) and names in str(refused.value)
    assert not (tmp_path / "world").exists()


def test_a_plan_that_is_no_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.plan").write_text('{"fileType": ', encoding="utf-8")
    with pytest.raises(UsageError, match="no JSON: EOF"):
        read_plan(tmp_path / "a.plan")


def test_the_commands_say_what_they_wrote_and_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.plan", plan(*TRIANGLE, AGAIN))
    assert world.main(["import", str(path), "--out", str(tmp_path / "w")]) == 0
    told = capsys.readouterr().out
    assert "1 trajectories, 0 fences, 0 sensors" in told and "Add the sensors" in told and "at 60 m" in told
    assert world.main(["export", str(EXAMPLE), "--plan", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "uav_2.plan").read_text())["fileType"] == "Plan"
    assert world.main(["import", str(path)]) == 2
    assert "--out is missing" in capsys.readouterr().err
    assert world.main(["fly"]) == 2
