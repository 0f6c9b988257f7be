"""The fields that only the simulator reads: off by default, absent from JSON then, and not read by the edge."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator

import pytest

from shared.world.scenario import SCENARIOS, Scenario, Unmodelled
from tests.support.places import ROOT

HIDDEN = set(Unmodelled.model_fields)
# What decides: the edge, and the shared parts that policies on board and the edge use.
DECIDING = ("service", "shared", "simulator/policies", "lab/marl")
# The fields' definition, and the presets that set them.
DEFINING = {"shared/world/scenario.py"}


def names_in(source: str) -> Iterator[str]:
    """Every attribute, variable, argument and string in Python source."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Attribute(attr=name) | ast.Name(id=name) | ast.keyword(arg=str(name)) | ast.Constant(str(name)):
                yield name


def test_nothing_that_decides_reads_a_hidden_field() -> None:
    files = {str(path.relative_to(ROOT)): path for folder in DECIDING for path in (ROOT / folder).rglob("*.py")}
    assert len(files) > 100
    found = {name: HIDDEN & set(names_in(path.read_text(encoding="utf-8"))) for name, path in files.items()}
    assert {name: fields for name, fields in found.items() if fields and name not in DEFINING} == {}


def test_the_search_finds_every_way_to_read_a_field() -> None:
    for source in ("world.shadowing_db", "getattr(world, 'shadowing_db')", "f(shadowing_db=1)", "w['shadowing_db']"):
        assert "shadowing_db" in set(names_in(source))


def test_a_scenario_without_them_has_the_json_of_a_version_without_them() -> None:
    assert not HIDDEN & set(json.loads(SCENARIOS["stress"].model_dump_json()))
    assert not HIDDEN & set(SCENARIOS["paper"].model_dump())
    assert set(json.loads(SCENARIOS["shadowed"].model_dump_json())) & HIDDEN == {"shadowing_db", "route_shadowing_db"}


@pytest.mark.parametrize("name", sorted(HIDDEN))
def test_every_field_is_off_by_default_and_described(name: str) -> None:
    field = Scenario.model_fields[name]
    assert field.description
    assert field.exclude_if is not None and field.exclude_if(field.default)


def test_the_documentation_has_every_scenario_and_field() -> None:
    page = (ROOT / "docs" / "reference" / "worlds.md").read_text(encoding="utf-8")
    assert [name for name in (*SCENARIOS, *sorted(HIDDEN)) if f"`{name}`" not in page] == []
