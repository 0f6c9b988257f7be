"""Flight plans into a world's folder, and a world's trajectories as flight plans."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.survey import read_survey
from simulator.sites.files.world_folder import FEATURES, site_from_folder
from simulator.sites.plans.qgroundcontrol import FlightPlan, plan_text, read_plan


@dataclass(frozen=True)
class Imported:
    """The content of a ``world.geojson`` after an import.

    Attributes:
        replaced: the fences that the file had before and that are gone.
        altitudes_m: of the plans' waypoints.
    """

    path: Path
    sensors: int
    trajectories: int
    fences: int
    replaced: int
    altitudes_m: frozenset[float]


def import_plans(plans: Sequence[Path], folder: Path, overwrite: bool) -> Imported:
    """Write the plans' paths and fences into a folder's ``world.geojson``, which is made if it is missing.

    Sensors and the pipeline that are there stay, and fences where the plans have none. UAV i flies the i-th plan.

    Raises:
        UsageError: a plan or the file is invalid, the plans have different fences, or the file has trajectories, or
            other fences than the plans, and ``overwrite`` is false.
    """
    read = [read_plan(path) for path in plans]
    fences = _merge_fences(plans, read)
    path = folder / FEATURES
    kept: list[dict[str, Any]] = []
    replaced = 0
    if path.exists():
        there = read_survey(path)
        if there.trajectories and not overwrite:
            raise UsageError(f"{path} has {len(there.trajectories)} trajectories; add --overwrite to replace them")
        lost = [label for label, fence in there.fences.items() if fences and fence not in fences]
        if lost and not overwrite:
            raise UsageError(
                f"{path}, {lost[0]}: the plans' geofence would replace this fence; add --overwrite to replace it, or "
                "take the geofence out of the plans to keep it"
            )
        replaced = len(lost)
        features = json.loads(path.read_text(encoding="utf-8-sig"))["features"]
        roles = ("sensor", "pipeline") if fences else ("sensor", "pipeline", "fence", "no_fly")
        kept = [feature for feature in features if feature["properties"]["role"] in roles]
    flown = [_trajectory_feature(plan, of.stem) for plan, of in zip(read, plans, strict=True)]
    _write(path, {"type": "FeatureCollection", "features": [*kept, *flown, *map(_fence_feature, fences)]})
    sensors = sum(feature["properties"]["role"] == "sensor" for feature in kept)
    drawn = len(fences) + sum(feature["properties"]["role"] in ("fence", "no_fly") for feature in kept)
    altitudes = frozenset(height for plan in read for height in plan.path.altitudes_m if height is not None)
    return Imported(path, sensors, len(flown), drawn, replaced, altitudes)


def export_plans(folder: Path, out: Path, overwrite: bool) -> list[Path]:
    """Write ``uav_0.plan`` and so on, one for each trajectory of a world's folder, with the world's fences.

    Raises:
        UsageError: the world is invalid, or a file is there and ``overwrite`` is false.
    """
    scenario = site_from_folder(folder).scenario
    survey = read_survey(folder / FEATURES)
    paths = [out / f"uav_{uav}.plan" for uav in range(scenario.uavs)]
    there = [path for path in paths if path.exists()]
    if there and not overwrite:
        raise UsageError(f"{there[0]} is there already; choose another folder or add --overwrite")
    out.mkdir(parents=True, exist_ok=True)
    fences = list(survey.fences.values())
    for path, trajectory in zip(paths, survey.trajectories.values(), strict=True):
        text = plan_text(trajectory, fences, scenario.altitude_m, float(min(7, scenario.max_velocity)))
        path.write_text(text, encoding="utf-8")
    return paths


def _merge_fences(paths: Sequence[Path], plans: Sequence[FlightPlan]) -> list[Fence]:
    """The plans' fences, each once; raises ``UsageError`` for two areas not to be left."""
    fences: list[Fence] = []
    for path, plan in zip(paths, plans, strict=True):
        for fence in plan.fences:
            if fence in fences:
                continue
            if fence.role == "fence" and any(other.role == "fence" for other in fences):
                raise UsageError(
                    f"{path}, geoFence: this is the second inclusion area, and a world has one for all its UAVs; draw "
                    "one polygon around both"
                )
            fences.append(fence)
    return fences


def _trajectory_feature(plan: FlightPlan, name: str) -> dict[str, Any]:
    return _feature("trajectory", "LineString", [list(point) for point in plan.path.trajectory], name=name)


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
    features = ",\n".join(f"    {json.dumps(feature, ensure_ascii=False)}" for feature in document["features"])
    temporary = path.with_suffix(".new")
    temporary.write_text(
        f'{{\n  "type": "FeatureCollection",\n  "features": [\n{features}\n  ]\n}}\n', encoding="utf-8"
    )
    os.replace(temporary, path)
