"""The user's names in an operator's note, replaced by sensors' IDs before the LLM reads it."""

import re
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from shared.wire.names import MapShape, Names
from shared.world.channel import FloatArray
from shared.world.scenario import Point
from shared.world.trajectory import Polyline

# The most sensors that an area or a section may stand for. Then metres: how near to a line a sensor is on it; how much
# farther from a kilometre than the nearest sensor another may be; how far from the pipeline a sensor counts, and from
# which distance along it the nearest is doubted.
_MOST_SENSORS, _NEAR_M, _SAME_M, _FAR_M = 8, 100.0, 50.0, 250.0
# Words of orders are no names.
_WORDS = {"sensor", "sensors", "visit", "step", "steps", "every", "never", "speed", "velocity", "weight", "all"}
_KILOMETRE = r"(?:kilomet(?:re|er)|km)[ -]?(?P<km>\d{1,4}(?:[.,]\d{1,3})?)(?![\w.,]*\d|\s*/)"


def in_ids(
    note: str, names: Names | None, shapes: Sequence[MapShape], places: FloatArray, pipeline: Sequence[Point]
) -> tuple[str, list[str]]:
    """The note with IDs for names of sensors, areas and lines and for kilometres, and doubts that quote words of it.

    Args:
        places: the sensors' positions ``(J, 2)``, NaN where unknown, metres.
        pipeline: the line along which kilometres count, from its first point, metres.
    """
    given = [(name, (sensor,)) for sensor, name in enumerate(names.sensors if names else ()) if name]
    lower, doubts = _key(note), []
    given += [(s.name, _sensors_of(s, places)) for s in shapes if s.name and _key(s.name) in lower]  # type: ignore[misc]
    meanings: dict[str, set[tuple[int, ...]]] = defaultdict(set)
    for name, sensors in given:
        usable = (len(name) >= 3 or re.search(r"\d", name)) and not name.isdigit() and _key(name) not in _WORDS
        if usable and 0 < len(sensors) <= _MOST_SENSORS:
            meanings[_key(name)].add(sensors)

    def read(found: re.Match[str]) -> str:
        if found["km"]:
            ids, doubt = _at_kilometre(float(found["km"].replace(",", ".")), places, pipeline)
        elif len(meant := meanings[_key(found["name"])]) == 1:
            return _listed(*meant)
        else:
            every = _listed(sorted({sensor for sensors in meant for sensor in sensors}))
            ids, doubt = (), f"is a name of {every}: write the ID of the one that you mean."
        if doubt:
            doubts.append(f"“{found[0]}” {doubt}")
        return _listed(ids) if ids else found[0]

    alternatives = "|".join(sorted(map(re.escape, meanings), key=len, reverse=True)) or "(?!)"
    named = rf"(?:sensors?\s+)?(?P<name>{alternatives})(?![\w]|[.-]\w)"
    text = re.sub(rf"(?<![\w.-])(?:{named}|{_KILOMETRE})", read, note, flags=re.IGNORECASE)
    numbers = {name: sensors[0] for name, sensors in given if name.isdigit()}
    doubts += [
        f"“sensor {number}” is read as ID {number}; the one named {number} is sensor {numbers[number]}."
        for number in re.findall(r"\bsensors?\s+(\d+)", lower)
        if numbers.get(number, int(number)) != int(number)
    ]
    for begin in {found[0] for name in meanings if (found := re.match(r"[^\W\d]{2,}[ ._-]?(?=\d)", name))}:
        words = re.findall(rf"(?<!\w){re.escape(begin)}\d(?:[\w.-]*\w)?", text, re.IGNORECASE)
        doubts += [f"“{word}” is no name of this mission." for word in words if _key(word) not in meanings]
    return text, doubts


def _key(text: str) -> str:
    """In lower case; of the Turkish İ and ı an i, as the regular expressions here read them."""
    return text.replace("İ", "i").replace("ı", "i").lower()


def _listed(ids: Sequence[int]) -> str:
    *first, last = map(str, ids)
    return f"sensors {', '.join(first)} and {last}" if first else f"sensor {last}"


def _sensors_of(shape: MapShape, places: FloatArray) -> tuple[int, ...]:
    """The sensors in an area, or within 100 m of a line; none of a fence, and none whose place is unknown."""
    if shape.kind == "fence" or len(set(shape.points)) < 2:
        return ()
    if shape.kind == "line":
        return tuple(np.flatnonzero(_projected(shape.points, places)[:, 1] <= _NEAR_M).tolist())
    (x, y), (x1, y1) = places.T[..., None], np.array(shape.points).T
    x2, y2 = np.roll(x1, -1), np.roll(y1, -1)
    spans = (y1 > y) != (y2 > y)
    crossed = spans & (x < x1 + (y - y1) * (x2 - x1) / np.where(spans, y2 - y1, 1.0))
    return tuple(np.flatnonzero(crossed.sum(axis=1) % 2).tolist())


def _at_kilometre(km: float, places: FloatArray, pipeline: Sequence[Point]) -> tuple[Sequence[int], str]:
    """The sensors nearest to that way along the line, of those that are near the line, and what is doubtful of it."""
    along = _projected(pipeline, places) if len(pipeline) > 1 else np.full((len(places), 2), np.nan)
    gaps = np.where(along[:, 1] <= _FAR_M, np.abs(along[:, 0] - 1000.0 * km), np.nan)
    if np.isnan(gaps).all():
        return (), "is unknown: this mission has no line, or no sensor with a known place."
    least = float(np.nanmin(gaps))
    ids = np.flatnonzero(gaps <= least + _SAME_M).tolist()[:_MOST_SENSORS]
    return ids, f"is read as {_listed(ids)}, the nearest, {least:,.0f} m away along the line." if least > _FAR_M else ""


def _projected(line: Sequence[Point], places: FloatArray) -> FloatArray:
    """Of each place the way along a line to its nearest point, and the distance to that, ``(J, 2)`` metres."""
    path = Polyline(line)
    found = np.array([path.locate((x, y)) for x, y in places.tolist()])
    if line[0] != line[-1]:
        # It counts there and back.
        found[:, 0] = np.minimum(found[:, 0], path.length_m - found[:, 0])
    return found
