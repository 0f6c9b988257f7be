"""The names and the map that a world's features give: for people, bounded, in the scenario's plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shared.wire.names import MAX_NAME, MAX_SHAPES
from shared.wire.schemas import MissionSpec
from simulator.errors import UsageError
from simulator.sites.files.world_folder import site_from_folder
from tests.support.world_folders import GOOD, RING, feature, sensor, there_and_back, write

LINE = [[41.5, 39.95], [41.505, 39.952], [41.51, 39.955]]


def test_a_name_is_the_property_or_else_the_id(tmp_path: Path) -> None:
    features = [
        sensor("7"),
        feature("sensor", "Point", [41.501, 39.951], id="8", name=" valve \t house\u202e "),
        feature("sensor", "Point", [41.502, 39.951], id=9, name="x" * 64 + "y"),
        feature("trajectory", "LineString", LINE, name="north"),
        feature("trajectory", "LineString", LINE),
    ]
    names = site_from_folder(write(tmp_path, *features)).names
    assert names is not None
    assert names.sensors == ["7", "valve house", "x" * MAX_NAME]
    assert names.uavs == ["north", None]


def test_background_sections_and_fences_are_the_map(tmp_path: Path) -> None:
    features = [
        *GOOD,
        feature("background", "MultiLineString", [LINE, LINE], name="road"),
        feature("background", "Polygon", [RING]),
        feature("pipeline", "LineString", LINE, name="section 3"),
        feature("pipeline", "LineString", LINE),
        feature("fence", "Point", [41.5, 39.95], radius_m=5000.0, name="border"),
    ]
    site = site_from_folder(write(tmp_path, *features))
    assert sorted((shape.kind, shape.name or "") for shape in site.map) == [
        ("area", ""), ("fence", "border"), ("line", "road"), ("line", "road"), ("line", "section 3"),
    ]  # fmt: skip
    assert site.frame is not None
    area, road = (next(shape for shape in site.map if shape.kind == kind) for kind in ("area", "line"))
    assert np.array(road.points) == pytest.approx(site.frame.metres(LINE), abs=0.06)
    assert len(area.points) == len(RING) - 1, "the first corner does not come again"
    border = next(shape for shape in site.map if shape.kind == "fence")
    [centre] = site.frame.metres([[41.5, 39.95]])
    assert np.linalg.norm(np.array(border.points) - centre, axis=1) == pytest.approx(5000.0, abs=0.1)
    # What the simulator sends is what the edge accepts.
    spec = site.named(MissionSpec(scenario=site.scenario))
    assert MissionSpec.model_validate_json(spec.model_dump_json()) == spec


def test_a_large_background_is_thinned_and_many_sections_are_cut(tmp_path: Path) -> None:
    wave = [[41.5 + i * 1e-6, 39.95 + (i % 7) * 1e-5] for i in range(20_000)]
    parts = [feature("pipeline", "LineString", LINE, name="part") for _ in range(MAX_SHAPES)]
    site = site_from_folder(write(tmp_path, *GOOD, *parts, feature("background", "LineString", wave, name="wave")))
    assert len(site.map) == MAX_SHAPES
    [drawn] = [shape for shape in site.map if shape.name == "wave"]
    assert len(drawn.points) == 33


def test_a_background_that_is_no_line_or_area_or_is_far_away_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the background is a LineString, MultiLineString or Polygon, not a Point"):
        site_from_folder(write(tmp_path, *GOOD, feature("background", "Point", [41.5, 39.95])))
    far = [[-120.0, 10.0], [-121.0, 10.0]]
    with pytest.raises(UsageError, match="the line or area road is too far away"):
        site_from_folder(write(tmp_path, *GOOD, feature("background", "LineString", far, name="road")))


def test_a_world_as_before_has_ids_for_names_and_no_map(tmp_path: Path) -> None:
    site = site_from_folder(write(tmp_path, sensor("a"), there_and_back()))
    assert site.names is not None and site.names.sensors == ["a"] and site.map == ()
    assert "map" not in site.named(MissionSpec(scenario=site.scenario)).model_dump(exclude_none=True)
