"""Random maps and plans: each is refused by a message, or the world that it makes flies inside its fences."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from simulator.errors import UsageError
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.plans.plan_folder import export_plans, import_plans
from simulator.sites.plans.qgroundcontrol import read_plan
from tests.support.drawn_areas import breach_m
from tests.support.flight_plans import item, plan
from tests.support.flight_plans import write as write_plan
from tests.support.world_folders import Json, feature, write

# Places are on a grid, so that legs meet corners and run along edges; the middle is at an ordinary place, on the
# antimeridian, where meridian and equator cross (a position of 0, 0 is none in MAVLink, so not quite there), or far in
# the north, and a cell has 20 m to 20 km.
MIDDLES = [(41.5, 39.95), (180.0, -17.0), (1e-4, 1e-4), (-179.99, 71.0)]
CELLS = st.tuples(st.integers(-5, 5), st.integers(-5, 5))
Cell = tuple[int, int]
FEW = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
MANY = settings(FEW, max_examples=10_000)


def ring_of(cells: list[Cell]) -> list[Cell]:
    """The cells around their middle, closed: a ring that does not cross itself."""
    x, y = (sum(axis) / len(cells) + 0.1 for axis in zip(*cells, strict=True))
    around = sorted(cells, key=lambda cell: (math.atan2(cell[1] - y, cell[0] - x), cell))
    return [*around, around[0]]


@st.composite
def areas(draw: st.DrawFn, role: str) -> tuple[str, list[Cell], float]:
    if draw(st.integers(0, 3)) == 0:
        return role, [draw(CELLS)], draw(st.sampled_from([0.5, 1.0, 3.0, 8.0]))
    if role == "fence" and draw(st.booleans()):
        return role, [(-6, -6), (6, -6), (6, 6), (-6, 6), (-6, -6)], 0.0
    return role, ring_of(draw(st.lists(CELLS, min_size=3, max_size=7, unique=True))), 0.0


@st.composite
def worlds(draw: st.DrawFn) -> tuple[list[list[Cell]], list[Any], Any]:
    """Paths and areas in cells, and the place of a cell in degrees."""
    east, north = draw(st.sampled_from(MIDDLES))
    size = draw(st.sampled_from([0.0002, 0.002, 0.2]))

    def place(cell: Cell) -> list[float]:
        longitude = east + cell[0] * size
        return [longitude - 360 * math.copysign(abs(longitude) > 180, longitude), north + cell[1] * size]

    paths = draw(st.lists(st.lists(CELLS, min_size=2, max_size=5), min_size=1, max_size=2))
    drawn = draw(st.lists(areas("no_fly"), max_size=2)) + draw(st.lists(areas("fence"), max_size=1))
    shapes = [(role, [place(cell) for cell in cells], radius * size * 111_000) for role, cells, radius in drawn]
    return paths, shapes, place


def drawn_feature(role: str, places: list[list[float]], radius_m: float) -> Json:
    if radius_m:
        return feature(role, "Point", places[0], radius_m=radius_m)
    return feature(role, "Polygon", [places])


# In a world of kilometres both lines may be this far from those in degrees, metres.
TOLERANCE_M = 1.5


def check_map(folder: Path, world: tuple[Any, Any, Any], seen: Counter[str]) -> None:
    paths, shapes, place = world
    lines = [feature("trajectory", "LineString", [place(cell) for cell in path]) for path in paths]
    features = [feature("sensor", "Point", place((0, 0)), id="a"), *lines, *(drawn_feature(*shape) for shape in shapes)]
    try:
        site = site_from_folder(write(folder, *features))
    except UsageError as error:
        assert "\n" not in str(error) and str(folder) in str(error)
        seen["refused"] += 1
        return
    seen["fenced" if shapes else "free"] += 1
    assert breach_m(site, features) <= TOLERANCE_M


COMMANDS = st.sampled_from([16] * 12 + [20, 21, 22, 17, 82, 93, 112, 177, 178, 189, 206, 211, 600, 601, 5001, 31000])
FRAMES = st.sampled_from([3] * 12 + [0, 1, 2, 6, 10, 12])
CHANGES = [
    ("mission", "version", 1), ("geoFence", "version", 1), ("geoFence", "areas", []), ("mission", "items", None),
    ("mission", "extra", 1), ("rallyPoints", "points", [[1, 2, 3]]), ("geoFence", "breachReturn", [0, 0, 0]),
    ("geoFence", "polygons", None), ("rallyPoints", "version", None),
]  # fmt: skip


@st.composite
def plans(draw: st.DrawFn) -> tuple[tuple[Any, Any, Any], list[Json], Json]:
    world = paths, shapes, place = draw(worlds())
    items = []
    for number, cell in enumerate([cell for path in paths for cell in path], start=1):
        longitude, latitude = place(cell)
        first = draw(st.sampled_from([0, 0, 1, 2]))
        values = (first, draw(st.sampled_from([-1, 0, 3])), 0, None, latitude, longitude, 60)
        items.append(item(draw(COMMANDS), *values, number=number, frame=draw(FRAMES)))
    in_plan = draw(st.integers(0, len(shapes)))
    fences: Json = {"circles": [], "polygons": [], "version": 2}
    for role, places, radius in shapes[:in_plan]:
        corners = [[latitude, longitude] for longitude, latitude in places]
        circle = {"circle": {"center": corners[0], "radius": radius}, "inclusion": role == "fence", "version": 1}
        polygon = {"polygon": corners[:-1], "inclusion": role == "fence", "version": 1}
        fences["circles" if radius else "polygons"].append(circle if radius else polygon)
    document = plan(*items, geoFence=fences)
    for part, key, value in draw(st.lists(st.sampled_from(CHANGES), max_size=1)) if draw(st.booleans()) else ():
        document[part] = {**document[part], key: value}
    there = [drawn_feature(*shape) for shape in shapes[in_plan:]]
    return world, [feature("sensor", "Point", place((0, 0)), id="a"), *there], document


def check_plan(folder: Path, drawn: tuple[Any, list[Json], Json], seen: Counter[str]) -> None:
    (_, shapes, _), there, document = drawn
    path = write_plan(folder / "a.plan", document)
    write(folder, *there)
    before = (folder / "world.geojson").read_bytes()
    try:
        import_plans([path], folder, overwrite=False)
    except UsageError as error:
        assert "\n" not in str(error) and str(folder) in str(error)
        assert (folder / "world.geojson").read_bytes() == before
        seen["refused"] += 1
        return
    seen["fenced" if shapes else "free"] += 1
    site = site_from_folder(folder)
    features = json.loads((folder / "world.geojson").read_text())["features"]
    assert features[: len(there)] == there, "nothing is lost"
    assert breach_m(site, [drawn_feature(*shape) for shape in shapes]) <= TOLERANCE_M
    flown = {tuple(place) for place in features[len(there)]["geometry"]["coordinates"]}
    ways = [item for item in document["mission"]["items"] if item["command"] == 16]
    if not any(item["command"] in (189, 177) for item in document["mission"]["items"]):
        assert flown == {(item["params"][5], item["params"][4]) for item in ways}
    for written in export_plans(folder, folder / "out", overwrite=True):
        # Its digits may bring a line that is a centimetre clear of an area into touch with it.
        assert read_plan(written).fences or not shapes


@FEW
@given(worlds())
def test_a_map_is_refused_or_flown_inside_its_fences(tmp_path: Path, world: Any) -> None:
    check_map(tmp_path, world, Counter())


@FEW
@given(plans())
def test_a_plan_is_refused_or_flown_inside_its_fences(tmp_path: Path, drawn: Any) -> None:
    check_plan(tmp_path, drawn, Counter())


@pytest.mark.fuzz
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("strategy", "check"), [(worlds(), check_map), (plans(), check_plan)], ids=["maps", "plans"])
def test_ten_thousand_are_refused_or_flown_inside_their_fences(tmp_path: Path, strategy: Any, check: Any) -> None:
    seen: Counter[str] = Counter()

    @MANY
    @given(strategy)
    def check_one(drawn: Any) -> None:
        check(tmp_path, drawn, seen)

    check_one()
    assert min(seen["refused"], seen["fenced"], seen["free"]) > 100, seen
