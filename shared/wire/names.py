"""The user's own names of sensors and UAVs, and the lines and areas of the user's own map."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from shared.wire.strict_models import Received, one_paragraph
from shared.world.scenario import MAX_SENSORS, Waypoint

MAX_NAME, MAX_SHAPES, MAX_POINTS = 64, 300, 10_000

Name = Annotated[str, Field(max_length=MAX_NAME), AfterValidator(one_paragraph)]


class Names(Received):
    """Names by ID: the first is that of sensor 0, and so on; null, or a shorter list: no name."""

    sensors: list[Name | None] = Field(default_factory=list, max_length=MAX_SENSORS, fail_fast=True)
    uavs: list[Name | None] = Field(default_factory=list, max_length=100, fail_fast=True)

    def sensor(self, sensor_id: int) -> str | None:
        """The sensor's name, if it has one."""
        return self.sensors[sensor_id] if sensor_id < len(self.sensors) else None


class MapShape(Received):
    """A line or an area of the map, such as a section of the pipeline or a fence."""

    kind: Literal["line", "area", "fence", "no_fly"]
    name: Name | None = None
    points: list[Waypoint] = Field(
        min_length=2, max_length=1000, fail_fast=True, description="m; an area's first point is not repeated at its end"
    )


def _few_points(shapes: list[MapShape]) -> list[MapShape]:
    if (count := sum(len(shape.points) for shape in shapes)) > MAX_POINTS:
        raise ValueError(f"{count:,} points in all, at most {MAX_POINTS:,}: simplify the map")
    return shapes


MapShapes = Annotated[list[MapShape], Field(max_length=MAX_SHAPES, fail_fast=True), AfterValidator(_few_points)]
