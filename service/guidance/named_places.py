"""The user's names in an operator's note, replaced by sensors' IDs before the LLM reads it."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from shared.wire.names import MapShape, Names
from shared.wire.schemas import MAX_NOTE
from shared.world.channel import FloatArray
from shared.world.scenario import Point

# An area or section with more sensors is no order for each of them. Sensors within 100 m of a line are on it, unless
# another is nearer by more than 10 m.
_MOST_SENSORS, _NEAR_M, _BESIDE_M = 8, 100.0, 10.0
# Sensors that are as near to a kilometre, and the distance from which that is a doubt, metres.
_SAME_M, _FAR_M = 50.0, 250.0
# Words of orders are no names.
_WORDS = frozenset(
    ("sensor", "sensors", "visit", "step", "steps", "every", "never", "speed", "velocity", "weight", "all")
)
_KILOMETRE = r"(?:kilomet(?:re|er)|km)[ -]?(\d{1,4}(?:[.,]\d{1,3})?)(?![\w.,]*\d|\s*/)"


class NamedPlaces:
    """What a mission's note may name.

    Args:
        names: of sensors and UAVs, if there are any.
        shapes: lines and areas, metres.
        places: the sensors' positions ``(J, 2)``, NaN where unknown, metres.
        pipeline: the line along which kilometres count, from its first point, metres.
    """

    def __init__(
        self, names: Names | None, shapes: Sequence[MapShape], places: FloatArray, pipeline: Sequence[Point]
    ) -> None:
        self._places, self._pipeline = places, pipeline
        self._meanings: dict[str, set[tuple[int, ...]]] = {}
        self._numbers: dict[str, int] = {}
        for sensor, name in enumerate(names.sensors if names else ()):
            if name is not None and name.isdigit():
                self._numbers[name] = sensor
            elif name is not None:
                self._add(name, (sensor,))
        for shape in shapes:
            if shape.name and shape.kind in ("area", "no_fly"):
                self._add(shape.name, tuple(_within(shape, places)))
        gaps: dict[str, FloatArray] = {}
        for shape in shapes:
            if shape.name and shape.kind == "line":
                gap = _projected(shape.points, places)[1]
                gaps[shape.name] = np.minimum(gap, gaps.get(shape.name, np.inf))
        nearest = np.min(list(gaps.values()), axis=0) if gaps else np.inf
        for name, gap in gaps.items():
            self._add(name, tuple(np.flatnonzero((gap <= _NEAR_M) & (gap <= nearest + _BESIDE_M)).tolist()))

    def in_ids(self, note: str) -> tuple[str, list[str]]:
        """The note with sensors' IDs for names and kilometres, and doubts that quote the words they are about."""
        doubts: list[str] = []
        names = sorted(map(re.escape, self._meanings), key=len, reverse=True)
        named = rf"(?:sensors?\s+)?({'|'.join(names)})(?![\w]|[.-]\w)" if names else r"(?!)()"
        read = re.sub(
            rf"(?<![\w.-])(?:{named}|{_KILOMETRE})",
            lambda found: self._kilometre(found, doubts) if found[2] else self._name(found, doubts),
            note,
            flags=re.IGNORECASE,
        )
        doubts += self._unknown(note, read)
        return (read, doubts) if len(read) <= 2 * MAX_NOTE else (note, ["The note is too long with IDs for its names."])

    def _add(self, name: str, sensors: tuple[int, ...]) -> None:
        known = len(name) >= 3 or any(one.isdigit() for one in name)
        if known and name.lower() not in _WORDS and 0 < len(sensors) <= _MOST_SENSORS:
            self._meanings.setdefault(name.lower(), set()).add(sensors)

    def _name(self, found: re.Match[str], doubts: list[str]) -> str:
        meanings = self._meanings[found[1].lower()]
        if len(meanings) == 1:
            return _listed(next(iter(meanings)))
        ids = sorted({sensor for sensors in meanings for sensor in sensors})
        doubts.append(f"“{found[1]}” is a name of {_listed(ids)}: write the ID of the one that you mean.")
        return found[0]

    def _kilometre(self, found: re.Match[str], doubts: list[str]) -> str:
        along = _distances_along(self._pipeline, self._places)
        if not np.isfinite(along).any():
            doubts.append(f"“{found[0]}” is unknown: this mission has no line, or no sensor with a known place.")
            return found[0]
        gaps = np.abs(along - 1000.0 * float(found[2].replace(",", ".")))
        least = float(np.nanmin(gaps))
        read = _listed(np.flatnonzero(gaps <= least + _SAME_M).tolist()[:_MOST_SENSORS])
        if least > _FAR_M:
            doubts.append(f"“{found[0]}” is read as {read}, the nearest, {least:,.0f} m away along the line.")
        return read

    def _unknown(self, note: str, read: str) -> Iterator[str]:
        """Doubts about numbers that are names, too, and about words that look like a sensor's name."""
        for number in re.findall(r"\bsensors?\s+(\d+)", note, re.IGNORECASE):
            if (named := self._numbers.get(number, int(number))) != int(number):
                yield f"“sensor {number}” is read as the ID {number}; the sensor named {number} is sensor {named}."
        begins = {found[0] for name in self._meanings if (found := re.match(r"[^\W\d]{2,}[ ._-]?(?=\d)", name))}
        for begin in sorted(begins):
            for word in re.findall(rf"(?<!\w){re.escape(begin)}\d(?:[\w.-]*\w)?", read, re.IGNORECASE):
                if word.lower() not in self._meanings and not re.fullmatch(_KILOMETRE, word, re.IGNORECASE):
                    yield f"“{word}” is no name of this mission."


def _listed(ids: Sequence[int]) -> str:
    *first, last = map(str, ids)
    return f"sensors {', '.join(first)} and {last}" if first else f"sensor {last}"


def _within(shape: MapShape, places: FloatArray) -> list[int]:
    """The sensors in an area; an unknown place is in none."""
    (x, y), (x1, y1) = places.T[..., None], np.array(shape.points).T
    x2, y2 = np.roll(x1, -1), np.roll(y1, -1)
    spans = (y1 > y) != (y2 > y)
    crossed = spans & (x < x1 + (y - y1) * (x2 - x1) / np.where(spans, y2 - y1, 1.0))
    return np.flatnonzero(crossed.sum(axis=1) % 2).tolist()  # type: ignore[no-any-return]


def _distances_along(line: Sequence[Point], places: FloatArray) -> FloatArray:
    """The way along a line to each sensor, ``(J,)`` metres; NaN for a sensor that is not on it."""
    if len(line) < 2:
        return np.full(len(places), np.nan)
    along, gap = _projected(line, places)
    return np.where(gap <= _FAR_M, along, np.nan)


def _projected(line: Sequence[Point], places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of each place the way along a line to its nearest point, and the distance to that, ``(J,)`` each, metres."""
    points = np.array(line)
    way = np.diff(points, axis=0)
    length = np.linalg.norm(way, axis=1)
    offset = places[:, None] - points[:-1]
    share = np.clip((offset * way).sum(axis=-1) / np.where(length > 0, length**2, 1.0), 0.0, 1.0)
    gaps = np.linalg.norm(offset - share[..., None] * way, axis=-1)
    rows, nearest = np.arange(len(places)), np.argmin(gaps, axis=1)
    begin = np.concatenate(([0.0], np.cumsum(length)[:-1]))
    return begin[nearest] + share[rows, nearest] * length[nearest], gaps[rows, nearest]
