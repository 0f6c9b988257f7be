"""The user's names in a note become sensors' IDs; what is unclear stays, with a doubt that quotes it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from service.guidance.named_places import in_ids
from shared.wire.names import MapShape, Names
from simulator.sites.files.world_folder import site_from_folder
from tests.support.world_folders import EXAMPLE

SQUARE = [(1000.0, 2000.0), (2000.0, 2000.0), (2000.0, 2500.0), (1000.0, 2500.0)]
WEST, EAST = [(0.0, 1850.0), (600.0, 2000.0), (1150.0, 2340.0)], [(5250.0, 3380.0), (5800.0, 3840.0)]


Read = Callable[[str], tuple[str, list[str]]]


@pytest.fixture(scope="module")
def read_note() -> Read:
    """The example's sensors, an area of three of them, and two sections beside the whole line."""
    site = site_from_folder(EXAMPLE)
    shapes = [
        *site.map,
        MapShape(kind="area", name="The Village", points=SQUARE),
        MapShape(kind="line", name="east end", points=EAST),
        MapShape(kind="fence", name="border", points=SQUARE),
    ]
    sites = np.array(site.scenario.sites)
    return lambda note: in_ids(note, site.names, shapes, sites, site.scenario.pipeline)


@pytest.mark.parametrize("name", ["Izmir-1", "İzmir-1", "ızmir-1"])
@pytest.mark.parametrize("written", ["izmir-1", "İZMİR-1", "Izmır-1"])
def test_a_name_with_turkish_letters_is_read(name: str, written: str) -> None:
    read = in_ids(f"visit {written} every 3 steps", Names(sensors=[None, name]), (), np.zeros((2, 2)), ())
    assert read == ("visit sensor 1 every 3 steps", [])


@pytest.mark.parametrize(
    ("note", "read"),
    [
        ("Leak at kp-1.58: visit it every third step.", "Leak at sensor 3: visit it every third step."),
        ("KP-1.58, then sensor kp-0.10.", "sensor 3, then sensor 0."),
        ("near kilometre 3 every 2 steps", "near sensor 6 every 2 steps"),
        ("leak at km 1.6", "leak at sensor 3"),
        ("Visit the village often.", "Visit sensors 2, 3 and 4 often."),
        ("no leak at the east end", "no leak at the sensors 12 and 13"),
        # More sensors than an order can mean, a fence, a speed.
        ("walk the trunk line, keep within the border, at 5 km/h", None),
        ("Visit sensor 4 every third step.", None),
    ],
)
def test_names_areas_sections_and_kilometres_become_ids(read_note: Read, note: str, read: str | None) -> None:
    assert read_note(note) == (read or note, [])


@pytest.mark.parametrize(
    ("note", "read", "doubt"),
    [
        ("kp-1.5 leaks", "kp-1.5 leaks", "“kp-1.5” is no name of this mission."),
        ("leak at km 9", "leak at sensor 13", "“km 9” is read as sensor 13, the nearest, 2,472 m away"),
    ],
)
def test_what_is_unclear_is_quoted(read_note: Read, note: str, read: str, doubt: str) -> None:
    found, doubts = read_note(note)
    assert found == read
    assert len(doubts) == 1 and doubts[0].startswith(doubt)


def test_a_name_of_two_sensors_stays_and_a_number_is_an_id() -> None:
    names = Names(sensors=["pump", "Pump", "7", None, "step"])

    def read_note(note: str) -> tuple[str, list[str]]:
        return in_ids(note, names, [], np.full((5, 2), np.nan), [])

    assert read_note("Pump leaks") == (
        "Pump leaks",
        ["“Pump” is a name of sensors 0 and 1: write the ID of the one that you mean."],
    )
    assert read_note("visit sensor 7 every step") == (
        "visit sensor 7 every step",
        ["“sensor 7” is read as ID 7; the one named 7 is sensor 2."],
    )
    text, doubts = read_note("near km 3")
    assert text == "near km 3" and doubts[0].startswith("“km 3” is unknown: this mission has no line")


def test_without_names_a_note_stays_as_it_is() -> None:
    note, line = "Sensor 1 leaks: visit it every 3 steps.", [(0.0, 0.0), (1000.0, 0.0)]
    assert in_ids(note, None, [], np.zeros((3, 2)), line) == (note, [])


def test_sections_share_the_sensors_between_them() -> None:
    shapes = [MapShape(kind="line", name=name, points=at) for name, at in (("west", WEST), ("east", EAST))]
    site = site_from_folder(EXAMPLE)
    sites = np.array(site.scenario.sites)
    assert in_ids("west, east", None, shapes, sites, ())[0] == "sensors 0, 1 and 2, sensors 12 and 13"


def test_a_kilometre_means_the_sensors_at_the_same_place_near_the_line_and_is_doubted_far_from_them() -> None:
    # 1,000 m along the line, 50 m and 51 m further, and 251 m beside it.
    places, line = (
        np.array([(1000.0, 250.0), (1050.0, 0.0), (1051.0, 0.0), (1000.0, 251.0)]),
        [(0.0, 0.0), (5000.0, 0.0)],
    )

    def read_note(note: str) -> tuple[str, list[str]]:
        return in_ids(note, None, [], places, line)

    assert read_note("leak at km 1") == ("leak at sensors 0 and 1", [])
    assert read_note("leak at km 1.301") == ("leak at sensors 1 and 2", [])
    read, doubts = read_note("leak at km 1.302")
    assert read == "leak at sensors 1 and 2"
    assert doubts == ["“km 1.302” is read as sensors 1 and 2, the nearest, 251 m away along the line."]
