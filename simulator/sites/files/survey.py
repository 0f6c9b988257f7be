"""``world.geojson``: the sensors' sites, the UAVs' trajectories, the pipeline and fences, as features on the globe."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails, from_json

from shared.kit.text_files import text_of
from shared.kit.validation_messages import problem_of
from shared.wire.names import MAX_NAME
from shared.world.scenario import MAX_SENSORS, Point
from simulator.errors import UsageError
from simulator.sites.fence import Fence, FenceRole
from simulator.sites.files.reading import json_fault, quoted

MAX_BYTES = 20_000_000
MAX_TRAJECTORIES, MAX_WAYPOINTS, MAX_FENCES, MAX_CORNERS = 100, 1000, 100, 1000
MAX_RADIUS_M, MAX_PARTS = 1e6, 10_000
ROLES = '"sensor", "trajectory", "pipeline", "fence", "no_fly" or "background"'


def _is_wgs84(name: str) -> bool:
    """Whether a ``crs`` names WGS 84, as a code, URN or URL: ``EPSG:4326``, ``urn:ogc:def:crs:OGC:1.3:CRS84``,
    ``http://www.opengis.net/def/crs/EPSG/0/4326``. RFC 7946 has no such member; older programs still write it."""
    *words, last = re.findall(r"[a-z0-9]+", name.lower().removesuffix("/proj4/")) or [""]
    if last in ("4326", "4979"):
        return "epsg" in words
    return last in ("crs84", "crs84h", "wgs84") or (last == "84" and words[-1:] in (["crs"], ["wgs"]))


def _on_earth(position: list[float]) -> list[float]:
    longitude, latitude = position[:2]
    if abs(longitude) <= 180 and abs(latitude) <= 90:
        return position
    if abs(longitude) <= 90 and abs(latitude) <= 180:
        fix = "GeoJSON has the longitude first; swap the two"
    elif max(abs(longitude), abs(latitude)) > 360:
        fix = "these look like projected metres; export the file as WGS 84 (EPSG:4326)"
    else:
        fix = "longitudes go from -180 to 180 and latitudes from -90 to 90"
    raise ValueError(f"[{longitude:g}, {latitude:g}] is no longitude and latitude in degrees: {fix}")


def _ring(rings: list[list[list[float]]]) -> list[list[list[float]]]:
    if len(rings) != 1:
        raise ValueError(f"the Polygon has {len(rings)} rings; give one ring, without holes")
    if len(rings[0]) < 4 or rings[0][0] != rings[0][-1]:
        raise ValueError(
            "the Polygon's ring is not closed; its first position comes again at the end, at least four in all"
        )
    return rings


class _GeoJson(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)


# An altitude may be the third number; the scenario's applies.
Position = Annotated[list[float], Field(min_length=2, max_length=3), AfterValidator(_on_earth)]


class _Point(_GeoJson):
    type: Literal["Point"]
    coordinates: Position


_Line = Annotated[list[Position], Field(min_length=2)]


class _LineString(_GeoJson):
    type: Literal["LineString"]
    coordinates: _Line


class _MultiLineString(_GeoJson):
    type: Literal["MultiLineString"]
    coordinates: list[_Line] = Field(min_length=1)


class _Polygon(_GeoJson):
    type: Literal["Polygon"]
    coordinates: Annotated[list[list[Position]], AfterValidator(_ring)]


def _single(geometry: Any) -> Any:
    """A Multi... geometry of one part as that part: many programs write every feature so."""
    kind, parts = (geometry.get("type"), geometry.get("coordinates")) if isinstance(geometry, dict) else (None, None)
    if kind in ("MultiPoint", "MultiLineString", "MultiPolygon") and isinstance(parts, list) and len(parts) == 1:
        return {**geometry, "type": kind.removeprefix("Multi"), "coordinates": parts[0]}
    return geometry


class _Properties(_GeoJson):
    role: Literal["sensor", "trajectory", "pipeline", "fence", "no_fly", "background"]
    id: Any = None
    name: Any = None
    radius_m: float | None = Field(None, gt=0, le=MAX_RADIUS_M)


class _Feature(_GeoJson):
    type: Literal["Feature"]
    properties: _Properties
    geometry: Annotated[
        Annotated[_Point | _LineString | _MultiLineString | _Polygon, Field(discriminator="type")],
        BeforeValidator(_single),
    ]
    id: Any = None

    @property
    def identifier(self) -> str:
        """The feature's ID, or its name; raises ``ValueError`` for none, or one that is no text or whole number."""
        names = (self.properties.id, self.properties.name, self.id)
        name = next((name for name in names if name is not None and name != ""), None)
        if name is None:
            raise ValueError('the sensor has no ID; add to its properties "id", such as "kp-01"')
        if isinstance(name, float) and name.is_integer():
            # Tables of numbers make 7.0 of 7.
            name = int(name)
        text = "" if isinstance(name, bool) or not isinstance(name, str | int) else _text(name)
        if not 1 <= len(text) <= 64:
            raise ValueError(f"{quoted(name)} is no ID; give a text of 1 to 64 letters or a whole number")
        return text

    @property
    def title(self) -> str | None:
        """Its name for people, or else its ID: one line of printable text; ``None`` without either."""
        names = (self.properties.name, self.properties.id, self.id)
        text = next((_text(name) for name in names if isinstance(name, str | int) and name != ""), "")
        return " ".join("".join(one if one.isprintable() else " " for one in text).split())[:MAX_NAME].strip() or None

    @property
    def parts(self) -> list[list[Point]]:
        """The geometry's lines: one, but for a MultiLineString."""
        geometry = self.geometry
        if isinstance(geometry, _Point):
            return [[(geometry.coordinates[0], geometry.coordinates[1])]]
        lines = [geometry.coordinates] if isinstance(geometry, _LineString) else geometry.coordinates
        return [[(x, y) for x, y, *_ in line] for line in lines]

    @property
    def line(self) -> list[Point]:
        """The geometry as one line; raises ``ValueError`` where its parts do not begin where the ones before end."""
        first, *others = self.parts
        for part in others:
            (x, y), (east, north) = first[-1], part[0]
            if y != north or (x - east) % 360:
                raise ValueError("the MultiLineString's parts do not meet; give a LineString")
            first += part[1:]
        return first


def _text(name: str | int) -> str:
    return name.strip() if isinstance(name, str) else str(name) if abs(name) < 10**64 else ""


Drawn = tuple[Literal["line", "area"], str | None, list[Point]]


@dataclass
class Survey:
    """The content of a ``world.geojson``. Points are longitude and latitude, degrees.

    Attributes:
        sensors: site by ID, in the file's order.
        trajectories: waypoints by the feature's label, such as ``features[3] ('north')``; the last waypoint of a ring
            equals the first.
        pipeline: polylines, for pictures.
        fences: fence by the feature's label; the radius of a circle is in metres.
        sensor_names, uav_names: for people, in the order of the sensors and trajectories.
        background, sections: kind, name and points of lines and areas, and of the pipeline's named parts.
    """

    sensors: dict[str, Point] = field(default_factory=dict)
    trajectories: dict[str, list[Point]] = field(default_factory=dict)
    pipeline: list[list[Point]] = field(default_factory=list)
    fences: dict[str, Fence] = field(default_factory=dict)
    sensor_names: list[str | None] = field(default_factory=list)
    uav_names: list[str | None] = field(default_factory=list)
    background: list[Drawn] = field(default_factory=list)
    sections: list[Drawn] = field(default_factory=list)


def read_survey(path: Path) -> Survey:
    """The features of a GeoJSON file (RFC 7946), by their property ``role``.

    Raises:
        UsageError: the file cannot be read, or is no valid GeoJSON; the text names the line, or the feature by its
            index from 0 and its ID.
    """
    return survey_of(path, read_collection(path))


def survey_of(path: Path, collection: Mapping[str, Any]) -> Survey:
    """The features of a collection that is, or is to be, in a file; raises as :func:`read_survey`."""
    survey = Survey()
    for label, feature in _features(path, collection["features"]):
        try:
            _add(survey, label, feature)
        except ValueError as error:
            raise UsageError(f"{path}, {label}: {error}") from None
    return survey


def check_complete(path: Path, survey: Survey) -> None:
    """Raises ``UsageError`` for a survey without sensors or trajectories."""
    for found, role, geometry in (
        (survey.sensors, "sensor", "Point"),
        (survey.trajectories, "trajectory", "LineString or Polygon"),
    ):
        if not found:
            raise UsageError(f'{path} has no {role}: give a {geometry} the property "role": "{role}"')


def _features(path: Path, features: Sequence[Any]) -> Iterator[tuple[str, _Feature]]:
    """The label of each feature, its index and ID if it has one, and the feature."""
    for index, raw in enumerate(features):
        label = f"features[{index}]{_id_of(raw)}"
        for holder in (raw, raw.get("geometry")) if isinstance(raw, dict) else ():
            _check_crs(f"{path}, {label}", holder)
        try:
            yield label, _Feature.model_validate(raw)
        except ValidationError as error:
            raise UsageError(f"{path}, {label}: {_error_text(error.errors(include_url=False)[0])}") from None


def read_collection(path: Path) -> dict[str, Any]:
    """The feature collection in a file, its features not looked at; raises as :func:`read_survey`."""
    text = text_of(path, MAX_BYTES, UsageError)
    try:
        # NaN and infinities pass here; the validation of their feature rejects them with its label.
        document = from_json(text)
    except ValueError as error:
        raise UsageError(f"{path} is no JSON: {json_fault(text, error)}") from None
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        raise UsageError(f'{path} is no GeoJSON FeatureCollection: its top level needs "type": "FeatureCollection"')
    _check_crs(str(path), document)
    if not isinstance(document.get("features"), list):
        raise UsageError(f'{path}: "features" is no list; put the sensors and trajectories there')
    return document


def _check_crs(where: str, raw: object) -> None:
    """Raises ``UsageError`` for a ``crs`` member of the collection, or of an older feature, that is not WGS 84."""
    crs = raw.get("crs") if isinstance(raw, dict) else None
    if crs is None:
        return
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name", properties.get("href")) if isinstance(properties, dict) else crs
    if isinstance(properties, dict) and isinstance(code := properties.get("code"), int | str):
        name = f"EPSG:{code}"
    if not isinstance(name, str) or not _is_wgs84(name):
        raise UsageError(f"{where}: crs is {quoted(name)}; export the file as WGS 84 (EPSG:4326)")


def _id_of(raw: object) -> str:
    properties = raw.get("properties") if isinstance(raw, dict) else None
    holders = [holder for holder in (properties, raw) if isinstance(holder, dict)]
    names = (holder.get(key) for holder in holders for key in ("id", "name"))
    name = next((name for name in names if isinstance(name, str | int)), None)
    return "" if name is None else f" ({quoted(name)})"


def _error_text(error: ErrorDetails) -> str:
    """A validation error as a message in the terms of GeoJSON."""
    where = "".join(f"[{at}]" if isinstance(at, int) else f".{at}" for at in error["loc"]).lstrip(".")
    for geometry in ("Point", "MultiLineString", "LineString", "Polygon"):
        where = where.replace(f"geometry.{geometry}", "geometry")
    if where == "properties.role":
        return f'role is missing; add to its properties "role": {ROLES}' if error["type"] == "missing" else (
            f"role is {quoted(error['input'])}; the roles are {ROLES}"
        )  # fmt: skip
    if where == "properties" and error["input"] is None:
        return f'properties is null; a feature needs the property "role": {ROLES}'
    if where == "geometry" and error["input"] is None:
        return "geometry is null; give the feature a Point, LineString or Polygon, or take it out"
    if error["type"].startswith("union_tag"):
        return "geometry is none of Point, LineString or Polygon; split collections and Multi... geometries into those"
    if error["type"] == "too_short" and where == "geometry.coordinates":
        return "geometry.coordinates: a Point needs a longitude and a latitude, a LineString at least two positions"
    if error["type"] == "too_long" and where.startswith("geometry.coordinates"):
        return f"{where} is too long; a position has two or three numbers"
    shown = "" if error["type"] in ("value_error", "missing") else f", not {quoted(error['input'])}"
    return f"{where or 'the feature'}: {problem_of(error)}{shown}"


def _add(survey: Survey, label: str, feature: _Feature) -> None:
    """Add a feature to the survey by its role; raises ``ValueError`` for a geometry that does not fit the role."""
    role, geometry = feature.properties.role, feature.geometry.type
    if role == "sensor":
        if geometry != "Point":
            raise ValueError(f"a sensor is a Point, not a {geometry}")
        if (name := feature.identifier) in survey.sensors:
            raise ValueError(f"sensor {quoted(name)} comes twice; give each sensor an ID of its own")
        if len(survey.sensors) == MAX_SENSORS:
            raise ValueError(f"a world has at most {MAX_SENSORS:,} sensors")
        survey.sensors[name] = feature.line[0]
        survey.sensor_names.append(feature.title)
    elif role == "trajectory":
        if geometry == "Point":
            raise ValueError("a trajectory is a LineString (there and back) or a Polygon (laps), not a Point")
        if len(survey.trajectories) == MAX_TRAJECTORIES:
            raise ValueError(f"a world has at most {MAX_TRAJECTORIES} trajectories")
        survey.trajectories[label] = line = feature.line
        survey.uav_names.append(feature.title)
        if len(line) > MAX_WAYPOINTS:
            raise ValueError(f"the trajectory has {len(line):,} waypoints, at most {MAX_WAYPOINTS:,}; simplify it")
    elif role == "pipeline":
        if geometry not in ("LineString", "MultiLineString"):
            raise ValueError(f"the pipeline is a LineString or MultiLineString, not a {geometry}")
        survey.pipeline += feature.parts
        if len(survey.pipeline) > MAX_PARTS:
            raise ValueError(f"the pipeline has more than {MAX_PARTS:,} parts; join them")
        if feature.title is not None:
            survey.sections += (("line", feature.title, part) for part in feature.parts)
    elif role == "background":
        if geometry == "Point":
            raise ValueError("the background is a LineString, MultiLineString or Polygon, not a Point")
        kind: Literal["line", "area"] = "area" if geometry == "Polygon" else "line"
        survey.background += ((kind, feature.title, part) for part in feature.parts)
    else:
        survey.fences[label] = _fence(survey, role, feature)


def _fence(survey: Survey, role: FenceRole, feature: _Feature) -> Fence:
    """The fence of a feature; raises ``ValueError`` for a geometry that is no area, or for one fence too many."""
    geometry, radius = feature.geometry.type, feature.properties.radius_m
    if "LineString" in geometry or (geometry == "Point") != (radius is not None):
        raise ValueError(f"a {role} is a Polygon, or a Point with the property radius_m")
    if role == "fence" and any(fence.role == "fence" for fence in survey.fences.values()):
        raise ValueError("the fence comes twice; autopilots differ in what two mean, so draw one Polygon around both")
    if len(survey.fences) == MAX_FENCES:
        raise ValueError(f"a world has at most {MAX_FENCES} fences")
    if len(feature.line) > MAX_CORNERS + 1:
        raise ValueError(f"the {role} has {len(feature.line) - 1:,} corners, at most {MAX_CORNERS:,}; simplify it")
    return Fence(role, tuple(feature.line), radius or 0.0, feature.title)
