"""The names and the map of a world's features, for the edge's page, and a pipeline's line for pictures."""

from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shared.wire.names import MAX_SHAPES, MapShape, Names
from shared.world.channel import FloatArray
from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.survey import Survey
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


def chained(parts: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """The parts as one line, each joined at its end that is nearest to an end of those before, from the first part.

    Args:
        parts: points ``(n, 2)`` each, metres.

    Returns:
        The line, ``(N, 2)``, and the widest gap that it joins, metres.
    """
    if not parts:
        return np.empty((0, 2)), 0.0
    # As complex numbers distances take a fraction of the time.
    ends = np.array([(complex(*part[0]), complex(*part[-1])) for part in parts])
    line, widest = deque([parts[0]]), 0.0
    ends[0] = np.inf
    for _ in parts[1:]:
        gaps = np.stack([np.abs(ends - complex(*at)) for at in (line[0][0], line[-1][-1])])
        after, index, last = (int(at) for at in np.unravel_index(np.argmin(gaps), gaps.shape))
        widest = max(widest, float(gaps[after, index, last]))
        part = parts[index] if after != last else parts[index][::-1]
        ends[index] = np.inf
        if after:
            line.append(part)
        else:
            line.appendleft(part)
    return np.concatenate(line), widest


def simplified(line: FloatArray, most: int) -> FloatArray:
    """The line ``(N, 2)`` without the points that change it least, at most ``most``; the ends stay."""
    while (excess := len(line) - most) > 0:
        odd = np.arange(1, len(line) - 1, 2)
        (x1, y1), (x2, y2) = (line[odd] - line[odd - 1]).T, (line[odd + 1] - line[odd - 1]).T
        areas = np.abs(x1 * y2 - y1 * x2)
        line = np.delete(line, odd[np.argsort(areas, kind="stable")[:excess]], axis=0)
    return line
