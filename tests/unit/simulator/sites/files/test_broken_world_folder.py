"""Errors of broken world folders; any content gives a site or such an error."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.world.scenario import Scenario
from simulator.errors import UsageError
from simulator.flying.flight import rollout
from simulator.policies.registry import policy_named
from simulator.sites.files.world_folder import site_from_folder
from tests.support.drawn_areas import breach_m
from tests.support.world_folders import (
    GOOD,
    RING,
    Json,
    feature,
    sensor,
    there_and_back,
    traced,
    write,
)


def error_of(folder: Path, steps: int | None = None) -> str:
    with pytest.raises(UsageError) as refused:
        site_from_folder(folder, steps)
    assert "\n" not in str(refused.value)
    return str(refused.value)


# ---- broken files


def ring(*coordinates: Any) -> Json:
    return feature("trajectory", "Polygon", list(coordinates), name="laps")


def line(points: Any) -> Json:
    return feature("trajectory", "LineString", points)


POINTS = "uav,sensor,progress_m,excess_db\n"
NOWHERE = {"type": "Feature", "properties": {"role": "sensor", "id": "x"}, "geometry": None}
CROWD = [feature("trajectory", "LineString", [[41.5, 39.95], [41.51, 39.955]]) for _ in range(101)]
EXTRA: list[tuple[Any, str]] = [
    (sensor("x", 39.95, 117.2), "features[3] ('x'): geometry.coordinates: [39.95, 117.2] is no longitude and latitude"
     " in degrees: GeoJSON has the longitude first; swap the two"),
    (sensor("x", 500_123.0, 4_400_000.0), "projected metres; export the file as WGS 84 (EPSG:4326)"),
    (sensor("x", 181.0, 10.0), "longitudes go from -180 to 180"),
    (sensor("x", float("nan")), "features[3] ('x'): geometry.coordinates[0]: must be a finite number, not nan"),
    (sensor("x", float("inf")), "finite number"),
    (feature("sensor", "Point", [41.5], id="x"), "a Point needs a longitude and a latitude"),
    (feature("sensor", "Point", [41.5, 39.9, 0, 1], id="x"), "geometry.coordinates is too long; a position has two"),
    (feature("sensor", "Point", ["41.5", 39.95], id="x"), "geometry.coordinates[0]: must be a valid number"),
    (feature("sensor", "Point", [True, 39.95], id="x"), "geometry.coordinates[0]: must be a valid number"),
    (sensor("a"), "features[3] ('a'): sensor 'a' comes twice"),
    (feature("sensor", "Point", [41.5, 39.95]), "features[3]: the sensor has no ID"),
    (feature("sensor", "Point", [41.5, 39.95], id=[1]), "features[3]: [1] is no ID"),
    (feature("sensor", "LineString", [[41.5, 39.95], [41.6, 39.95]], id="x"), "a sensor is a Point, not a LineString"),
    (feature(None, "Point", [41.5, 39.95], id="x"), "features[3] ('x'): role is missing; add to its properties"),
    (feature("senzor", "Point", [41.5, 39.95], id="x"), "role is 'senzor'; the roles are \"sensor\", \"trajectory\""),
    (NOWHERE, "features[3] ('x'): geometry is null; give the feature a Point, LineString or Polygon"),
    (NOWHERE | {"properties": None}, "features[3]: properties is null; a feature needs the property"),
    (feature("sensor", "Point", None, id="x"), "geometry.coordinates: must be a list, not null"),
    (feature("sensor", "Point", [41.5, None], id="x"), "geometry.coordinates[1]: must be a valid number, not null"),
    (sensor("x" * 65), "is no ID; give a text of 1 to 64 letters or a whole number"),
    (feature("sensor", "Point", [41.5, 39.95], id=7.5), "features[3]: 7.5 is no ID"),
    (feature("sensor", "Point", [41.5, 39.95], id=10**400), "is no ID; give a text of"),
    (sensor("x") | {"crs": {"type": "name", "properties": {"name": "EPSG:32637"}}}, "crs is 'EPSG:32637'; export"),
    (feature("trajectory", "MultiLineString", [[[41.5, 39.9], [41.6, 39.9]], [[41.7, 39.9], [41.8, 39.9]]]),
     "features[3]: the MultiLineString's parts do not meet; give a LineString"),
    (feature("no_fly", "MultiLineString", [RING, RING]), "a no_fly is a Polygon, or a Point with the property radius"),
    (feature("sensor", "MultiPoint", [[41.5, 39.95]] * 2, id="x"), "geometry is none of Point, LineString or Polygon"),
    ({"type": "Point", "coordinates": [1, 2]}, "features[3]: type: must be 'Feature'"),
    ("feature", "features[3]: the feature: must be a JSON object"),
    (line([[41.5, 39.95]]), "a LineString at least two positions"),
    (line([[41.5, 39.95], [41.5, 39.95]]), "features[3]: all waypoints are the same"),
    (line([[41.5, 39.95], [41.5, 39.95 + 1e-10]]), "features[3]: all waypoints are the same"),
    (line([[41.5, 39.95]] * 1001), "the trajectory has 1,001 waypoints, at most 1,000; simplify it"),
    (feature("trajectory", "Point", [41.5, 39.95]), "a trajectory is a LineString (there and back) or a"),
    (ring(RING[:-1]), "features[3] ('laps'): geometry.coordinates: the Polygon's ring is not closed"),
    (ring(RING, RING), "the Polygon has 2 rings"),
    (ring(), "the Polygon has 0 rings"),
    (feature("pipeline", "Polygon", [RING]), "the pipeline is a LineString or MultiLineString, not a Polygon"),
    (sensor("x", 60.0, 39.95), "km across, at most 1,000 km fit; look for a swapped or mistyped coordinate"),
    (sensor("x", -138.5, -39.95), "across, at most 1,000 km fit"),
]  # fmt: skip


@pytest.mark.parametrize(("extra", "complaint"), EXTRA)
def test_a_broken_feature_is_named(tmp_path: Path, extra: Any, complaint: str) -> None:
    error = error_of(write(tmp_path, *GOOD, extra))
    assert error.startswith(str(tmp_path / "world.geojson"))
    assert complaint in error


def test_too_many_trajectories(tmp_path: Path) -> None:
    assert "at most 100 trajectories" in error_of(write(tmp_path, sensor("a"), *CROWD))


@pytest.mark.parametrize(("features", "role"), [(GOOD[2:], "sensor"), (GOOD[:2], "trajectory"), ((), "sensor")])
def test_a_missing_role_is_named(tmp_path: Path, features: tuple[Json, ...], role: str) -> None:
    assert f"world.geojson has no {role}: give a" in error_of(write(tmp_path, *features))


@pytest.mark.parametrize(
    "crs", [{"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}, "EPSG:32637", {}]
)
def test_another_crs_is_refused(tmp_path: Path, crs: Any) -> None:
    assert "export the file as WGS 84 (EPSG:4326)" in error_of(write(tmp_path, *GOOD, crs=crs))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "is no JSON: EOF while parsing a value at line 1 column 0"),
        (b'{\n"type": "FeatureCollection",\n"features": [,]}', "is no JSON: expected value at line 3 column 14"),
        (b"[]", "is no GeoJSON FeatureCollection"),
        (b'{"type": "Feature"}', "is no GeoJSON FeatureCollection"),
        (b'{"type": "FeatureCollection"}', '"features" is no list'),
        (b"\n\n\xff", "world.geojson, line 3: not UTF-8"),
        (b"[" * 100_000, "is no JSON: recursion limit exceeded"),
        (b" " * 20_000_001, "is larger than 20 MB"),
    ],
)
def test_a_file_that_is_no_geojson(tmp_path: Path, content: bytes, complaint: str) -> None:
    (tmp_path / "world.geojson").write_bytes(content)
    assert complaint in error_of(tmp_path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "--world" in error_of(tmp_path / "none") and "is no folder" in error_of(tmp_path / "none")
    assert error_of(tmp_path) == f"{tmp_path / 'world.geojson'}: No such file or directory"
    (tmp_path / "world.geojson").mkdir()
    assert error_of(tmp_path).endswith("world.geojson is no file")


@pytest.mark.parametrize(
    ("toml", "complaint"),
    [
        ("steps = ", "scenario.toml is no TOML: Invalid value (at end of document)"),
        ("\nsteps = 1\nsteps = 2\n", "is no TOML: Cannot overwrite a value (at line 3, column 10)"),
        ("radio_radius = 300", "scenario.toml, line 1: a scenario has no field 'radio_radius'; did you mean radio_r"),
        ("gravity = 9.81", "a scenario has no field 'gravity'; its fields are those of shared/world/scenario.py"),
        ("steps = 30\nsensors = 4", "scenario.toml, line 2: sensors follows from world.geojson"),
        ("lap_radius_m = 4", "does not use lap_radius_m"),
        ("# x\nqueue_capacity = 2.5", "scenario.toml, line 2: queue_capacity: must be a valid integer"),
        ("altitude_m = nan", "scenario.toml, line 1: altitude_m: must be a finite number"),
        ("altitude_m = true", "scenario.toml, line 1: altitude_m: must be a valid number"),
        ("arrival_rate_min = 9", "scenario.toml: arrival_rate_min exceeds arrival_rate_max"),
        ('name = "No"', "scenario.toml, line 1: name: must be 1 to 32 lower-case letters"),
        ("x = " + "[" * 100_000, "scenario.toml is no TOML"),
    ],
)  # fmt: skip
def test_a_broken_toml_names_the_line(tmp_path: Path, toml: str, complaint: str) -> None:
    assert complaint in error_of(write(tmp_path, *GOOD, toml=toml))


@pytest.mark.parametrize(
    ("trace", "complaint"),
    [
        ("", "line 1: the first column is nothing"),
        ("step;a;b\n", "line 1: the first column is 'step;a;b'; the header is step and the sensors' IDs, split"),
        ("step,a,b,c\n", "line 1: column 'c' is no sensor of world.geojson"),
        ("step,a,b,a\n", "line 1: column 'a' comes twice"),
        ("step,a\n", "line 1: sensor 'b' of world.geojson has no column"),
        ("step,a,b\n", "arrivals.csv has a header and no step"),
        ("step,a,b\n0,1\n", "line 2: 2 values, the header has 3"),
        ("step,a,b\n0,1,2\n2,1,2\n", "line 3: step '2', expected 1"),
        ("step,a,b\n1,1,2\n", "line 2: step '1', expected 0"),
        ("step,a,b\n0,1,-2\n", "line 2, column 'b': '-2' packets; write a whole number from 0 to 1000000"),
        ("step,b,a\n0,1,2\n\n1,1,2.5\n", "line 4, column 'a': '2.5' packets"),
        ("step,a,b\n0,1,\n", "line 2, column 'b': '' packets"),
        ("step,a,b\n0,1,nan\n", "'nan' packets"),
        ("step,a,b\n0,1,1000001\n", "'1000001' packets"),
        ("step,a,b\n0,1,\u0663\n", "packets; write a whole number"),
        ('step,a,b\n0,1,"2"x\n', "line 2: ',' expected after '\"'"),
        (traced(10_001), "line 10002: a mission has at most 10,000 steps"),
        (traced(29), "arrivals.csv has 29 steps, the mission 30; add lines, or fly fewer steps (--steps 29)"),
    ],
)  # fmt: skip
def test_a_broken_trace_names_the_line(tmp_path: Path, trace: str, complaint: str) -> None:
    error = error_of(write(tmp_path, *GOOD, trace=trace))
    assert error.startswith(str(tmp_path / "arrivals.csv"))
    assert complaint in error


@pytest.mark.parametrize(
    ("gains", "complaint"),
    [
        ("", "line 1: the header is uav,sensor,progress_m,excess_db"),
        ("uav,sensor,x,y,excess_db\n", "line 1: the header is uav,sensor,progress_m,excess_db"),
        (POINTS, "gains.csv has a header and no point"),
        (POINTS + "0,a,1\n", "line 2: 3 values, the header has 4"),
        (POINTS + "1,a,0,3\n", "line 2: UAV '1'; write the number of a trajectory, 0 to 0"),
        (POINTS + "-0,a,0,3\n", "line 2: UAV '-0'"),
        (POINTS + "0,c,0,3\n", "line 2: 'c' is no sensor of world.geojson"),
        (POINTS + "0,a,-1,3\n", "line 2: progress_m '-1' is no number from 0 to "),
        (POINTS + "0,a,1e9,3\n", "line 2: progress_m '1e9' is no number from 0 to "),
        (POINTS + "0,a,5,nan\n", "line 2: excess_db 'nan' is no number from -200 to 200"),
        (POINTS + "0,a,5,\n", "line 2: excess_db '' is no number"),
        (POINTS + "0,a,5,1\n\n0,a,5.0,2\n", "line 4: this point of UAV 0 and sensor 'a' comes twice"),
        (POINTS + '0,a,5,"1"x\n', "line 2: ',' expected after '\"'"),
    ],
)  # fmt: skip
def test_a_broken_gain_trace_names_the_line(tmp_path: Path, gains: str, complaint: str) -> None:
    error = error_of(write(tmp_path, *GOOD, gains=gains))
    assert error.startswith(str(tmp_path / "gains.csv"))
    assert complaint in error


def test_a_short_trace_will_do_for_a_short_mission(tmp_path: Path) -> None:
    site = site_from_folder(write(tmp_path, *GOOD, trace=traced(5)), steps=5)
    assert site.arrivals is not None and site.arrivals.shape == (5, 2)


def test_more_arrivals_than_a_world_may_draw(tmp_path: Path) -> None:
    crowd = [sensor(f"s{j}") for j in range(1100)]
    assert "exceeds 10,000,000" in error_of(write(tmp_path, *crowd, there_and_back()), steps=10_000)


# ---- any content


AROUND = [[41.4, 39.9], [41.6, 39.9], [41.6, 40.1], [41.4, 40.1], [41.4, 39.9]]
FENCES = (feature("fence", "Polygon", [AROUND]), feature("no_fly", "Point", [41.52, 39.95], radius_m=900.0))
# Lines of kilometres that are straight in degrees may be this far from that, metres.
STRAIGHT_M = 1.5


def fuzzed(folder: Path, change: Callable[[Path], object]) -> None:
    """Read a world after a change: it has whatever was drawn and flies inside its fences, or is a ``UsageError``."""
    for name in ("scenario.toml", "arrivals.csv", "gains.csv"):
        (folder / name).unlink(missing_ok=True)
    write(folder, *GOOD, *FENCES)
    change(folder)
    try:
        site = site_from_folder(folder, steps=2)
    except UsageError as error:
        assert str(error) and "\n" not in str(error)
        return
    drawn = json.loads((folder / "world.geojson").read_text(encoding="utf-8-sig"))["features"]
    roles = Counter(feature["properties"]["role"] for feature in drawn)
    assert (site.scenario.sensors, site.scenario.uavs) == (roles["sensor"], roles["trajectory"])
    assert [fence.role for fence in site.fences] == [
        role for role in (feature["properties"]["role"] for feature in drawn) if role in ("fence", "no_fly")
    ]
    assert bool(site.scenario.pipeline) == ("pipeline" in roles)
    assert breach_m(site, drawn) <= STRAIGHT_M
    if site.scenario.queue_capacity < 1000:
        rollout(site.world(), policy_named("eof"), seed=0)


scalars = st.none() | st.booleans() | st.integers(-(10**20), 10**400) | st.floats() | st.text(max_size=8)
anything = st.recursive(
    scalars | st.sampled_from(["Feature", "Point", "LineString", "Polygon", "sensor", "trajectory"]),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(
        st.sampled_from(["type", "features", "geometry", "coordinates", "properties", "role", "id"]), inner
    ),
    max_leaves=20,
)  # fmt: skip
near = st.floats(41.4, 41.6) | st.floats(39.9, 40.1) | st.sampled_from([0.0, 180.0, -180.0, 90.0, -90.0, 1e300])
geometries = st.one_of(
    st.lists(near, max_size=4),
    st.lists(st.lists(near, min_size=2, max_size=3), max_size=5),
    st.lists(st.lists(st.lists(near, min_size=2, max_size=2), max_size=5).map(lambda p: [*p, *p[:1]]), max_size=2),
)
features = st.builds(
    feature,
    st.sampled_from(["sensor", "trajectory", "pipeline", "no_fly", "fence", None]),
    st.sampled_from(["Point", "LineString", "Polygon", "MultiPoint", "MultiLineString"]),
    geometries | anything,
    id=st.text(max_size=3) | anything,
    radius_m=st.none() | st.floats(1.0, 2e4) | scalars,
)
# Some of them leave the fence, or enter the no_fly area.
ways = st.builds(
    lambda places: feature("trajectory", "LineString", [list(place) for place in places]),
    st.lists(st.tuples(st.floats(41.38, 41.62), st.floats(39.88, 40.12)), min_size=2, max_size=4),
)
quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@quick
@given(extra=st.lists(ways | features | anything, max_size=4), members=st.dictionaries(st.just("crs"), anything))
def test_any_features_make_a_world_inside_its_fences_or_a_usage_error(
    tmp_path: Path, extra: list[Any], members: Json
) -> None:
    fuzzed(tmp_path, lambda folder: write(folder, *GOOD[:2], *extra, *GOOD[2:], *FENCES, **members))


@quick
@given(content=st.binary(max_size=60) | anything.map(lambda value: json.dumps(value).encode()))
def test_any_bytes_make_a_world_inside_its_fences_or_a_usage_error(tmp_path: Path, content: bytes) -> None:
    for name in ("world.geojson", "scenario.toml", "arrivals.csv", "gains.csv"):
        fuzzed(tmp_path, lambda folder, name=name: (folder / name).write_bytes(content))  # type: ignore[misc]


@quick
@given(
    key=st.sampled_from([*Scenario.model_fields, "x"]),
    value=st.sampled_from(["nan", "-inf", "1e400", "0", "-1", "5", '"x"', "[]", "{}", "[[1, 2]]", "1979-05-27", "true"])
    | st.floats().map(repr)
    | st.integers().map(str)
    | st.just(hex(10**5000)),
)
def test_any_override_makes_a_world_inside_its_fences_or_a_usage_error(tmp_path: Path, key: str, value: str) -> None:
    fuzzed(tmp_path, lambda folder: (folder / "scenario.toml").write_text(f"{key} = {value}\n"))


@quick
@given(cells=st.lists(st.lists(st.text(max_size=4) | st.integers().map(str), min_size=2, max_size=3), max_size=4))
def test_any_cells_make_a_world_inside_its_fences_or_a_usage_error(tmp_path: Path, cells: list[list[str]]) -> None:
    out = io.StringIO()
    csv.writer(out, escapechar="\\").writerows([["step", "a", "b"], *([t, *row] for t, row in enumerate(cells))])
    text = out.getvalue().encode("utf-8", errors="surrogatepass")
    fuzzed(tmp_path, lambda folder: (folder / "arrivals.csv").write_bytes(text))


@quick
@given(
    rows=st.lists(st.lists(st.sampled_from(["0", "a", "b", "9.5", ""]) | st.text(max_size=4), max_size=5), max_size=4)
)
def test_any_gains_make_a_world_inside_its_fences_or_a_usage_error(tmp_path: Path, rows: list[list[str]]) -> None:
    out = io.StringIO()
    csv.writer(out, escapechar="\\").writerows([POINTS.strip().split(","), *rows])
    text = out.getvalue().encode("utf-8", errors="surrogatepass")
    fuzzed(tmp_path, lambda folder: (folder / "gains.csv").write_bytes(text))
