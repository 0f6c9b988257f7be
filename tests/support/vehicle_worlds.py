"""World folders for flights over MAVLink, and the missions of their trajectories."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shared.world.scenario import scenario_named
from shared.world.trajectory import trajectories
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.projection import Frame
from simulator.world.batch import Fleet
from simulator.world.sensors import Streams, draw_positions
from tests.support.airframe import Item
from tests.support.world_folders import feature, write

JUMP = 177


def mission_in(plan: Path) -> list[Item]:
    """The items of a plan as a ground station sends them: a jump names the item's place, from 0."""
    items = json.loads(plan.read_text(encoding="utf-8"))["mission"]["items"]
    place_of = {item["doJumpId"]: place for place, item in enumerate(items)}
    made = []
    for item in items:
        first, second = item["params"][:2]
        first = place_of[first] if item["command"] == JUMP else first
        made.append(Item(item["command"], item["params"][4], item["params"][5], (first, second)))
    return made


def pipeline_folder(
    folder: Path, seed: int, corners: int = 36, toml: str | None = None, ahead_m: Sequence[float] = (0.0, 0.0, 0.0)
) -> Path:
    """Scenario ``pipeline`` as a world's folder: its sensors for a seed, and its laps as polygons.

    A lap's polygon begins ``ahead_m`` metres after the trajectory's start, so that the UAVs start as far ahead.
    """
    scenario = scenario_named("pipeline")
    frame = Frame(41.3, 39.9, (scenario.area_m / 2, scenario.area_m / 2))
    sensors = draw_positions(scenario, Streams.of(np.random.SeedSequence(seed)).layout)
    features = [
        feature("sensor", "Point", place, id=f"s{number}")
        for number, place in enumerate(frame.degrees(sensors).tolist())
    ]
    for lap, ahead in zip(trajectories(scenario), ahead_m, strict=True):
        places_m = (np.linspace(0.0, lap.length_m, corners, endpoint=False) + ahead) % lap.length_m
        ring = frame.degrees(lap.at(places_m)).tolist()
        features.append(feature("trajectory", "Polygon", [[*ring, ring[0]]]))
    around = frame.degrees([(-100.0, -100.0), (1100.0, -100.0), (1100.0, 1100.0), (-100.0, 1100.0)]).tolist()
    features.append(feature("fence", "Polygon", [[*around, around[0]]]))
    folder.mkdir(parents=True, exist_ok=True)
    return write(folder, *features, toml=toml)


def starts_m(folder: Path, seed: int) -> list[float]:
    """The starts of the UAVs in `aicvds simulate` of a world's folder, metres along their trajectories."""
    fleet = Fleet.draw(site_from_folder(folder).scenario, Streams.of(np.random.SeedSequence(seed)).angles)
    return [float(start) for start in fleet.start_m]
