"""``world.geojson``: the sensors' sites, the UAVs' trajectories, the pipeline and fences, as features on the globe."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails, from_json

from shared.kit.validation_messages import problem_of
from shared.world.scenario import MAX_SENSORS, Point
from simulator.errors import UsageError
from simulator.sites.fence import Fence, FenceRole
from simulator.sites.files.reading import quoted, text_of

MAX_BYTES = 20_000_000
MAX_TRAJECTORIES, MAX_WAYPOINTS, MAX_FENCES = 100, 1000, 100
MAX_RADIUS_M = 1e6
ROLES = '"sensor", "trajectory", "pipeline", "fence" or "no_fly"'
# RFC 7946 has no `crs` member; older programs still write one, which is valid if it names WGS 84.
_WGS84 = {"urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:OGC::CRS84", "urn:ogc:def:crs:EPSG::4326", "EPSG:4326"}


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


class _LineString(_GeoJson):
    type: Literal["LineString"]
    coordinates: list[Position] = Field(min_length=2, max_length=MAX_WAYPOINTS)


class _Polygon(_GeoJson):
    type: Literal["Polygon"]
    coordinates: Annotated[list[Annotated[list[Position], Field(max_length=MAX_WAYPOINTS)]], AfterValidator(_ring)]


_Name = Annotated[str, Field(min_length=1, max_length=64)] | int | None


class _Properties(_GeoJson):
    role: Literal["sensor", "trajectory", "pipeline", "fence", "no_fly"]
    id: _Name = None
    name: _Name = None
    radius_m: float | None = Field(None, gt=0, le=MAX_RADIUS_M)


class _Feature(_GeoJson):
    type: Literal["Feature"]
    properties: _Properties
    geometry: _Point | _LineString | _Polygon = Field(discriminator="type")
    id: _Name | float = None

    @property
    def identifier(self) -> str | None:
        names = (self.properties.id, self.properties.name, self.id)
        return next((str(name).strip() for name in names if name is not None), None)

    @property
    def line(self) -> list[Point]:
        if isinstance(self.geometry, _Polygon):
            return [(x, y) for x, y, *_ in self.geometry.coordinates[0]]
        if isinstance(self.geometry, _LineString):
            return [(x, y) for x, y, *_ in self.geometry.coordinates]
        return [(self.geometry.coordinates[0], self.geometry.coordinates[1])]


@dataclass
class Survey:
    """The content of a ``world.geojson``. Points are longitude and latitude, degrees.

    Attributes:
        sensors: site by ID, in the file's order.
        trajectories: waypoints by the feature's label, such as ``features[3] ('north')``; the last waypoint of a ring
            equals the first.
        pipeline: a polyline, or empty.
        fences: fence by the feature's label; the radius of a circle is in metres.
    """

    sensors: dict[str, Point] = field(default_factory=dict)
    trajectories: dict[str, list[Point]] = field(default_factory=dict)
    pipeline: list[Point] = field(default_factory=list)
    fences: dict[str, Fence] = field(default_factory=dict)


def read_survey(path: Path) -> Survey:
    """The features of a GeoJSON file (RFC 7946), by their property ``role``.

    Raises:
        UsageError: the file cannot be read, or is no valid GeoJSON; the text names the line, or the feature by its
            index from 0 and its ID.
    """
    survey = Survey()
    for label, feature in _features(path):
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


def _features(path: Path) -> Iterator[tuple[str, _Feature]]:
    """The label of each feature, its index and ID if it has one, and the feature."""
    for index, raw in enumerate(_collection(path)):
        label = f"features[{index}]{_id_of(raw)}"
        try:
            yield label, _Feature.model_validate(raw)
        except ValidationError as error:
            raise UsageError(f"{path}, {label}: {_error_text(error.errors(include_url=False)[0])}") from None


def _collection(path: Path) -> list[Any]:
    try:
        # NaN and infinities pass here; the validation of their feature rejects them with its label.
        document = from_json(text_of(path, MAX_BYTES))
    except ValueError as error:
        raise UsageError(f"{path} is no JSON: {error}") from None
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        raise UsageError(f'{path} is no GeoJSON FeatureCollection: its top level needs "type": "FeatureCollection"')
    crs = document.get("crs")
    if crs is not None:
        name = crs["properties"].get("name") if isinstance(crs, dict) and _is_object(crs.get("properties")) else crs
        if not isinstance(name, str) or name not in _WGS84:
            raise UsageError(f"{path}: crs is {quoted(name)}; export the file as WGS 84 (EPSG:4326)")
    features = document.get("features")
    if not isinstance(features, list):
        raise UsageError(f'{path}: "features" is no list; put the sensors and trajectories there')
    return features


def _is_object(value: object) -> bool:
    return isinstance(value, dict)


def _id_of(raw: object) -> str:
    properties = raw.get("properties") if isinstance(raw, dict) else None
    holders = [holder for holder in (properties, raw) if isinstance(holder, dict)]
    names = (holder.get(key) for holder in holders for key in ("id", "name"))
    name = next((name for name in names if isinstance(name, str | int)), None)
    return "" if name is None else f" ({quoted(name)})"


def _error_text(error: ErrorDetails) -> str:
    """A validation error as a message in the terms of GeoJSON."""
    where = "".join(f"[{at}]" if isinstance(at, int) else f".{at}" for at in error["loc"]).lstrip(".")
    for geometry in ("Point", "LineString", "Polygon"):
        where = where.replace(f"geometry.{geometry}", "geometry")
    if where == "properties.role":
        return f'role is missing; add to its properties "role": {ROLES}' if error["type"] == "missing" else (
            f"role is {quoted(error['input'])}; the roles are {ROLES}"
        )  # fmt: skip
    if where.startswith(("id", "properties.id", "properties.name")):
        return f"{quoted(error['input'])} is no ID; give a text of 1 to 64 letters or a number"
    if error["type"].startswith("union_tag"):
        return "geometry is none of Point, LineString or Polygon; split collections and Multi... geometries into those"
    if error["type"] == "too_short" and where == "geometry.coordinates":
        return "geometry.coordinates: a Point needs a longitude and a latitude, a LineString at least two positions"
    if error["type"] == "too_long" and where.startswith("geometry.coordinates"):
        return f"{where} is too long; a position has two or three numbers, a line at most {MAX_WAYPOINTS} positions"
    shown = "" if error["type"] == "value_error" else f", not {quoted(error['input'])}"
    return f"{where or 'the feature'}: {problem_of(error)}{shown}"


def _add(survey: Survey, label: str, feature: _Feature) -> None:
    """Add a feature to the survey by its role; raises ``ValueError`` for a geometry that does not fit the role."""
    role, geometry = feature.properties.role, feature.geometry.type
    if role == "sensor":
        if geometry != "Point":
            raise ValueError(f"a sensor is a Point, not a {geometry}")
        if not feature.identifier:
            raise ValueError('the sensor has no ID; add to its properties "id", such as "kp-01"')
        if feature.identifier in survey.sensors:
            raise ValueError(f"sensor {quoted(feature.identifier)} comes twice; give each sensor an ID of its own")
        if len(survey.sensors) == MAX_SENSORS:
            raise ValueError(f"a world has at most {MAX_SENSORS:,} sensors")
        survey.sensors[feature.identifier] = feature.line[0]
    elif role == "trajectory":
        if geometry == "Point":
            raise ValueError("a trajectory is a LineString (there and back) or a Polygon (laps), not a Point")
        if len(survey.trajectories) == MAX_TRAJECTORIES:
            raise ValueError(f"a world has at most {MAX_TRAJECTORIES} trajectories")
        survey.trajectories[label] = feature.line
    elif role == "pipeline":
        if geometry != "LineString":
            raise ValueError(f"the pipeline is a LineString, not a {geometry}")
        if survey.pipeline:
            raise ValueError("the pipeline comes twice; join its parts to one LineString")
        survey.pipeline = feature.line
    else:
        survey.fences[label] = _fence(survey, role, feature)


def _fence(survey: Survey, role: FenceRole, feature: _Feature) -> Fence:
    """The fence of a feature; raises ``ValueError`` for a geometry that is no area, or for one fence too many."""
    geometry, radius = feature.geometry.type, feature.properties.radius_m
    if geometry == "LineString" or (geometry == "Point") != (radius is not None):
        raise ValueError(f"a {role} is a Polygon, or a Point with the property radius_m")
    if role == "fence" and any(fence.role == "fence" for fence in survey.fences.values()):
        raise ValueError("the fence comes twice; autopilots differ in what two mean, so draw one Polygon around both")
    if len(survey.fences) == MAX_FENCES:
        raise ValueError(f"a world has at most {MAX_FENCES} fences")
    return Fence(role, tuple(feature.line), radius or 0.0)
