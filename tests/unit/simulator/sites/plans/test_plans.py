"""Flight plans into worlds and back."""

from __future__ import annotations

import json
import math
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
from simulator.sites.plans.mission_path import MissionItem, items_of, path_of
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
    assert (made.trajectories, made.fences, made.sensors) == (1, 1, 0)
    assert [note.removeprefix(f"{path}: ") for note in made.notes] == [
        "passed over, for they are not the path's: take-off (1).",
        "waypoints at 60 m above take-off; a world has one height: altitude_m in scenario.toml.",
    ]
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


def test_an_import_leaves_whatever_is_there_but_for_trajectories(tmp_path: Path) -> None:
    bare = write(tmp_path / "a.plan", plan(*TRIANGLE))
    fenced = write(tmp_path / "b.plan", plan(*TRIANGLE, geoFence=FENCED))
    other = {"inclusion": True, "polygon": [[39.9, 41.4], *AROUND[1:]], "version": 1}
    refenced = write(tmp_path / "c.plan", plan(*TRIANGLE, geoFence={"polygons": [other]}))
    ring = [list(place[::-1]) for place in [*AROUND, AROUND[0]]]
    ring[1] = [ring[1][0] + 4e-8, ring[1][1]]
    around = feature("fence", "Polygon", [ring])
    circle = feature("no_fly", "Point", [41.7, 39.99], radius_m=20.0, owner="Änderung GmbH") | {"x": 1}
    pipe = feature("pipeline", "LineString", ring[:2])
    (tmp_path / "w").mkdir()
    folder = write_world(tmp_path / "w", circle, sensor("a"), pipe, name="north line", bbox=[41.4, 39.9, 41.7, 40.0])
    made = import_plans([bare], folder, overwrite=False)
    assert (made.fences, made.sensors) == (1, 1)
    document = json.loads((folder / "world.geojson").read_text(encoding="utf-8"))
    assert document["features"][:3] == [circle, sensor("a"), pipe]
    assert (document["name"], document["bbox"]) == ("north line", [41.4, 39.9, 41.7, 40.0])
    assert import_plans([fenced], folder, overwrite=True).fences == 2
    with pytest.raises(UsageError, match=r"c.plan, geoFence: this is the second inclusion area \(.* has another\)"):
        import_plans([refenced], folder, overwrite=True)
    assert import_plans([fenced], folder, overwrite=True).fences == 2, "the same fence comes once"
    write_world(folder, sensor("a"), around)
    assert import_plans([fenced], folder, overwrite=True).fences == 1, "the same but for a plan's digits"
    assert next(iter(read_survey(folder / "world.geojson").fences.values())).points[1] == tuple(ring[1])


@pytest.mark.parametrize(
    ("document", "complaint"),
    [
        (plan(*(waypoint(50 + i * 1e-5, 10 + i % 2 * 1e-4, i + 1) for i in range(1500))), "mission.items: 1,500"),
        (plan(*TRIANGLE, geoFence={"polygons": [{"inclusion": True, "polygon": [[39.9, 41.4]] * 1001}]}),
         "geoFence.polygons[0].polygon: must have at most 1000 items, not 1001"),
        (plan(*TRIANGLE, geoFence={"circles": [{"inclusion": False, "circle": {"center": list(B), "radius": 9}}]}),
         "features[1] ('a'): it enters the no_fly area"),
    ],
)  # fmt: skip
def test_an_import_refuses_what_no_command_could_read(tmp_path: Path, document: Json, complaint: str) -> None:
    folder = tmp_path / "w"
    folder.mkdir()
    write_world(folder, sensor("a"))
    before = (folder / "world.geojson").read_bytes()
    with pytest.raises(UsageError) as refused:
        import_plans([write(tmp_path / "a.plan", document)], folder, overwrite=False)
    assert complaint in str(refused.value)
    assert (folder / "world.geojson").read_bytes() == before
    assert [file.name for file in folder.iterdir()] == ["world.geojson"]


def test_what_an_import_accepts_is_read(tmp_path: Path) -> None:
    """A fence of 1,000 corners, and a name of 88 letters."""
    turns = [2 * math.pi * corner / 1000 for corner in range(1000)]
    ring = [[39.955 + 0.1 * math.sin(turn), 41.505 + 0.1 * math.cos(turn)] for turn in turns]
    fenced = plan(*TRIANGLE, geoFence={"polygons": [{"inclusion": True, "polygon": ring}]})
    (tmp_path / "w").mkdir()
    folder = write_world(tmp_path / "w", sensor("a"))
    import_plans([write(tmp_path / f"{'x' * 88}.plan", fenced)], folder, overwrite=False)
    assert len(site_from_folder(folder).fences) == 1


def test_an_import_says_what_a_world_has_not(tmp_path: Path) -> None:
    turned_off = waypoint(*B, 3, 90) | {"params": [7, 0, 0, None, *B, 90], "autoContinue": False}
    high = waypoint(*C, 4, 1950) | {"frame": 0, "colour": "red"}
    deep = waypoint(*A, 5, 40) | {"frame": 10}
    items = [
        TAKE_OFF, item(178, 1, 9), waypoint(*A, 2), turned_off, high, deep, waypoint(*B, 6), item(177, 2, 3, number=7)
    ]  # fmt: skip
    rally = {"points": [[39.9, 41.4, 50]], "version": 2}
    document = plan(*items, rallyPoints=rally, noFly=[], geoFence=FENCED | {"breachReturn": [39.9, 41.4, 50]})
    notes = "\n".join(read_plan(write(tmp_path / "a.plan", document)).notes)
    for said in (
        "take-off (1), speed (1)", "waits at 1 waypoints, the first at mission.items[3]", "flies 4 laps",
        "waypoints at 60 to 90 m above take-off and at 1950 m above mean sea level and at 40 m above the terrain",
        "not known: 'colour'", "not known: 'noFly'", "1 rally points", "breachReturn", "autoContinue is off at 1 items",
    ):  # fmt: skip
        assert said in notes


@pytest.mark.parametrize(
    ("vehicle", "named"), [(10, "a ground rover"), (11, "a boat"), (12, "a submarine"), (2, ""), (None, "")]
)
def test_a_plan_for_a_vehicle_that_does_not_fly_says_so(tmp_path: Path, vehicle: int | None, named: str) -> None:
    document = plan(*TRIANGLE)
    document["mission"]["vehicleType"] = vehicle
    notes = "\n".join(read_plan(write(tmp_path / "a.plan", document)).notes)
    assert ("vehicleType" in notes) == bool(named) and named in notes


@pytest.mark.parametrize("kind", ["fwLandingPattern", "vtolLandingPattern"])
def test_a_landing_pattern_is_a_landing(tmp_path: Path, kind: str) -> None:
    pattern = {"type": "ComplexItem", "complexItemType": kind, "landCoordinate": [39.9, 41.4, 0]}
    read = read_plan(write(tmp_path / "a.plan", plan(TAKE_OFF, *TRIANGLE, pattern)))
    assert list(read.path.trajectory) == turned(A, B, C) and "landing (1)" in read.notes[0]
    with pytest.raises(UsageError, match=r"mission.items\[4\]: command 16 comes after mission.items\[3\]"):
        read_plan(write(tmp_path / "a.plan", plan(*TRIANGLE, pattern, waypoint(*A, 9))))


def test_a_landing_pattern_on_board_is_a_landing() -> None:
    """The items that QGroundControl uploads for it."""
    ways = [MissionItem(f"item {n}", n, 16, place) for n, place in enumerate(turned(A, B, C))]
    landing = [MissionItem(f"item {n}", n, command, (41.4, 39.9)) for n, command in enumerate((189, 31, 21), start=3)]
    assert path_of([*ways, *landing]).waypoints == tuple(turned(A, B, C))
    for after in (16, 601, 177):
        with pytest.raises(ValueError, match=rf"item 6: command {after} comes after item 3 \(command 189\)"):
            path_of([*ways, *landing, MissionItem("item 6", 6, after, (41.5, 39.9))])
    with pytest.raises(ValueError, match="item 4: command 177 comes after item 3"):
        path_of([*ways, landing[0], MissionItem("item 4", 4, 177, None, parameters=(0.0, 3.0)), *landing[1:]])
    with pytest.raises(ValueError, match="item 4: command 31 comes after item 3"):
        path_of([*ways, *landing[:2]])


HOME = "0\t1\t0\t16\t0\t0\t0\t0\t50.0\t10.0\t5\t1"
LINES = [f"{n}\t0\t3\t16\t0\t0\t0\tnan\t50.001\t10.00{n}\t30\t1" for n in range(3)]


@pytest.mark.parametrize(
    "text",
    ["\n".join(["QGC WPL 110", HOME, *LINES[1:]]) + "\n", "\ufeffQGC WPL 120\r\n" + "\r\n".join(
        [line.replace(f"{n}\t", f"{n - 1} ", 1) for n, line in enumerate(LINES) if n])],
)  # fmt: skip
def test_a_plain_text_mission_is_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "route.waypoints").write_text(text, encoding="utf-8", newline="")
    read = read_plan(tmp_path / "route.waypoints")
    assert read.path.trajectory == ((10.001, 50.001), (10.002, 50.001)) and not read.path.repeats
    assert any("waypoints at 30 m above take-off" in note for note in read.notes)
    assert any("line 2 is the home position" in note for note in read.notes) == ("110" in text)


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (["QGC WPL 100", HOME], "line 1: 'QGC WPL 100'; QGC WPL 110 is read"),
        (["QGC WPL 110", *LINES], "line 2: a QGC WPL 110 file begins with the home position"),
        (["QGC WPL 110", HOME, LINES[1][:-2]], "line 3: 11 values, a mission's line has 12"),
        (["QGC WPL 110", HOME, "", LINES[2]], "line 4: item 2, expected 1"),
        (["QGC WPL 110", HOME, LINES[1].replace("30", "3O")], "line 3: a value is no number"),
        (["QGC WPL 110", HOME, LINES[1].replace("\t3\t", "\t1\t"), LINES[2]], "line 3: frame 1 is not global"),
        (["QGC WPL 110", HOME, LINES[1].replace("16", "82"), LINES[2]], "line 3: command 82 is no straight leg"),
        (["QGC WPL 110", HOME], "0 waypoints; a path needs at least two"),
        (["QGC WPL 110"], "0 waypoints; a path needs at least two"),
        (["<?xml version='1.0'?>", "<kml/>"], "it is XML, as KML and GPX are; save a map as GeoJSON"),
    ],
)
def test_a_broken_text_names_its_line(tmp_path: Path, lines: list[str], complaint: str) -> None:
    (tmp_path / "a.waypoints").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(UsageError) as refused:
        read_plan(tmp_path / "a.waypoints")
    assert complaint in str(refused.value)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("a.kml", "is no flight plan, but a map; open it in QGroundControl's plan view"),
        ("a.KMZ", "is no flight plan, but a map; open it in QGroundControl's plan view"),
        ("a.plan", "is a ZIP archive, as KMZ and zipped shapefiles are"),
    ],
)
def test_maps_are_told_what_to_do(tmp_path: Path, name: str, complaint: str) -> None:
    (tmp_path / name).write_bytes(b"PK\x03\x04\x00\xff")
    with pytest.raises(UsageError, match=complaint):
        read_plan(tmp_path / name)


def test_what_no_vehicle_reaches_may_follow_a_jump(tmp_path: Path) -> None:
    beyond = waypoint(*A, 6) | {"frame": 1}
    read = read_plan(write(tmp_path / "a.plan", plan(TAKE_OFF, *TRIANGLE, AGAIN, beyond, item(21))))
    assert read.path.repeats
    assert "2 items from mission.items[5] on are never reached, after an endless jump." in read.notes
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
    (plan(TRIANGLE[0], waypoint(95.0, 41.5, 3)), "mission.items[1]: 95, 41.5 is no latitude and longitude"),
    (plan(*TRIANGLE, item(18, number=9)), "mission.items[3]: command 18 is no straight leg; use waypoints (16)"),
    (plan(*TRIANGLE, item(177, 3, -1)), "mission.items[3]: it jumps to item 3; only a jump to the first waypoint"),
    (plan(*TRIANGLE, item(177, 2, 0)), "mission.items[3]: it repeats 0 times"),
    (plan(*TRIANGLE, {"type": "ComplexItem", "complexItemType": "StructureScan"}), "item 'StructureScan' has no path"),
    (plan(*TRIANGLE, item(601, 3, number=5)), "mission.items[3]: command 601 may change the path; use waypoints"),
    (plan(*TRIANGLE, item(31000, number=5)), "mission.items[3]: command 31000 may change the path; use waypoints"),
    (plan(*TRIANGLE, TRIANGLE[0] | {"frame": 1}), "mission.items[3]: frame 1 is not global; give a latitude"),
    (plan(*TRIANGLE, TRIANGLE[0] | {"frame": 2}), "mission.items[3]: frame 2 is not global; give a latitude"),
    (plan(*TRIANGLE, version=2), "version is 2, which is not read; open the plan in a current QGroundControl"),
    (plan(*TRIANGLE, mission={"version": 1, "items": []}), "mission.version is 1, which is not read"),
    (plan(*TRIANGLE, geoFence=None), "geoFence: must be a JSON object, not null"),
    (
        plan(*TRIANGLE, geoFence={"polygons": [FENCED["polygons"][0] | {"version": 2}]}),
        "geoFence.polygons[0].version is 2, which is not read",
    ),
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
        "geoFence.version is 1, which is not read; open the plan in a current QGroundControl",
    ),
    (plan(*TRIANGLE, geoFence={"polygon": AROUND}), "geoFence.polygon is not known; open the plan in"),
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
    reported = capsys.readouterr().out
    assert "1 trajectories, 0 fences, 0 sensors" in reported and "Add the sensors" in reported and "at 60 m" in reported
    assert world.main(["export", str(EXAMPLE), "--plan", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "uav_2.plan").read_text())["fileType"] == "Plan"
    assert world.main(["import", str(path)]) == 2
    assert "--out is missing" in capsys.readouterr().err
    assert world.main(["fly"]) == 2
