"""The names and the map of a world's features, for the edge's page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shared.wire.names import MAX_SHAPES, MapShape, Names
from shared.world.channel import FloatArray
from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.survey import Survey
from simulator.sites.pictured_line import simplified
from simulator.sites.projection import Frame

# Corners of a circle, points of a shape and of all together, and how far one may be away, metres.
_CORNERS, _POINTS, _ALL_POINTS, _FARTHEST_M = 48, 1000, 10_000, 2e6


def names_and_map(
    survey: Survey, path: Path, frame: Frame, fences: Sequence[Fence]
) -> tuple[Names, tuple[MapShape, ...]]:
    """The names of sensors and UAVs, and the first 300 of fences, background and sections in the scenario's plane.

    Raises:
        UsageError: the background is too far away.
    """
    drawn = [*survey.background, *survey.sections][: MAX_SHAPES - len(fences)]
    most = min(_POINTS, _ALL_POINTS // max(1, len(drawn) + len(fences)))
    shapes = [MapShape(kind=f.role, name=f.name, points=_drawn(_corners(f), most, not f.radius)) for f in fences]
    for kind, name, points in drawn:
        line = frame.metres(points)
        if not np.linalg.norm(line - frame.centre, axis=1).max() <= _FARTHEST_M:
            raise UsageError(f"{path}: the line or area {name or 'without a name'} is too far away; draw it nearer")
        shapes.append(MapShape(kind=kind, name=name, points=_drawn(line, most, kind == "area")))
    return Names(sensors=survey.sensor_names, uavs=survey.uav_names), tuple(shapes)


def _drawn(line: FloatArray, most: int, closed: bool) -> list[tuple[float, float]]:
    thinned = np.round(simplified(line, most), 1)
    return [(x, y) for x, y in (thinned[:-1] if closed else thinned).tolist()]


def _corners(fence: Fence) -> FloatArray:
    if not fence.radius:
        return np.array(fence.points)
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    return fence.points[0] + fence.radius * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
