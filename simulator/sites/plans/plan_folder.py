"""Flight plans into a world's folder, and a world's trajectories as flight plans."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.survey import read_collection, read_survey, survey_of
from simulator.sites.files.world_folder import FEATURES, placed_features, site_from_folder, site_of
from simulator.sites.plans.qgroundcontrol import FlightPlan, plan_text, read_plan


@dataclass(frozen=True)
class Imported:
    """The content of a ``world.geojson`` after an import.

    Attributes:
        notes: what the plans have and the world has not, a sentence each.
    """

    path: Path
    sensors: int
    trajectories: int
    fences: int
    notes: tuple[str, ...]


def import_plans(plans: Sequence[Path], folder: Path, overwrite: bool) -> Imported:
    """Write the plans' paths and fences into a folder's ``world.geojson``, which is made if it is missing.

    Whatever is there stays, but for the trajectories. UAV i flies the i-th plan. The file is written only if the
    folder's world can be read then, as far as it has sensors.

    Raises:
        UsageError: a plan, the file or the world with the plans is invalid, the plans or the file have different
            fences not to be left, or the file has trajectories and ``overwrite`` is false.
    """
    read = [read_plan(path) for path in plans]
    path = folder / FEATURES
    document: dict[str, Any] = {"type": "FeatureCollection", "features": []}
    fences: list[Fence] = []
    if path.exists():
        document = read_collection(path)
        there = survey_of(path, document)
        if there.trajectories and not overwrite:
            raise UsageError(f"{path} has {len(there.trajectories)} trajectories; add --overwrite to replace them")
        fences += there.fences.values()
    kept = [feature for feature in document["features"] if feature["properties"]["role"] != "trajectory"]
    drawn = _further_fences(plans, read, path, fences)
    paths = ([list(point) for point in plan.path.trajectory] for plan in read)
    flown = [_feature("trajectory", "LineString", p, name=of.stem) for p, of in zip(paths, plans, strict=True)]
    document |= {"features": [*kept, *flown, *map(_fence_feature, drawn)]}
    survey = survey_of(path, document)
    if survey.sensors:
        site_of(survey, folder)
    else:
        placed_features(survey, path)
    _write(path, document)
    notes = tuple(f"{of}: {note}" for of, plan in zip(plans, read, strict=True) for note in plan.notes)
    return Imported(path, len(survey.sensors), len(flown), len(survey.fences), notes)


def export_plans(folder: Path, out: Path, overwrite: bool) -> list[Path]:
    """Write ``uav_0.plan`` and so on, one for each trajectory of a world's folder, with the world's fences.

    Raises:
        UsageError: the world is invalid, or a file is there and ``overwrite`` is false.
    """
    site, survey = site_from_folder(folder), read_survey(folder / FEATURES)
    scenario = site.scenario
    assert site.frame is not None, "a world's folder has a place on the globe"
    paths = [out / f"uav_{uav}.plan" for uav in range(scenario.uavs)]
    there = [path for path in paths if path.exists()]
    if there and not overwrite:
        raise UsageError(f"{there[0]} is there already; choose another folder or add --overwrite")
    out.mkdir(parents=True, exist_ok=True)
    fences = list(survey.fences.values())
    for path, trajectory in zip(paths, survey.trajectories.values(), strict=True):
        flown = [(longitude, latitude) for longitude, latitude in site.frame.bent(trajectory).tolist()]
        text = plan_text(flown, fences, scenario.altitude_m, float(min(7, scenario.max_velocity)))
        path.write_text(text, encoding="utf-8")
    return paths


def _further_fences(
    paths: Sequence[Path], plans: Sequence[FlightPlan], world: Path, there: Sequence[Fence]
) -> list[Fence]:
    """The plans' fences that are not there, each once; raises ``UsageError`` for two areas not to be left."""
    fences = list(there)
    for path, plan in zip(paths, plans, strict=True):
        for fence in plan.fences:
            if any(_same(fence, other) for other in fences):
                continue
            if fence.role == "fence" and any(other.role == "fence" for other in fences):
                in_world = any(other.role == "fence" for other in there)
                whose = f"{world} has another" if in_world else "an earlier plan has another"
                raise UsageError(
                    f"{path}, geoFence: this is the second inclusion area ({whose}), and a world has one for all its "
                    "UAVs; draw one polygon around both, or take one out"
                )
            fences.append(fence)
    return fences[len(there) :]


def _same(one: Fence, other: Fence) -> bool:
    """Whether two fences differ by no more than a plan's digits."""
    if (one.role, len(one.points)) != (other.role, len(other.points)) or abs(one.radius - other.radius) > 0.01:
        return False
    return bool(np.allclose(one.points, other.points, rtol=0.0, atol=2e-7))


def _fence_feature(fence: Fence) -> dict[str, Any]:
    if fence.radius:
        return _feature(fence.role, "Point", list(fence.points[0]), radius_m=fence.radius)
    return _feature(fence.role, "Polygon", [[list(point) for point in fence.points]])


def _feature(role: str, kind: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": {"role": role, **properties},
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def _write(path: Path, document: dict[str, Any]) -> None:
    """Write the file so that it is there as a whole or as it was; each feature is one line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    members = "".join(f"  {_json(key)}: {_json(value)},\n" for key, value in document.items() if key != "features")
    features = ",\n".join(f"    {_json(feature)}" for feature in document["features"])
    temporary = path.with_suffix(".new")
    temporary.write_text(f'{{\n{members}  "features": [\n{features}\n  ]\n}}\n', encoding="utf-8")
    os.replace(temporary, path)


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
