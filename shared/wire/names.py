"""The user's own names of sensors and UAVs, and the lines and areas of the user's own map."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from shared.wire.strict_models import Received, one_paragraph
from shared.world.scenario import MAX_SENSORS, Waypoint

MAX_NAME, MAX_SHAPES = 64, 300

Name = Annotated[str, Field(max_length=MAX_NAME), AfterValidator(one_paragraph)]


class Names(Received):
    """Names by ID: the first is that of sensor 0, and so on; null, or a shorter list: no name."""

    sensors: list[Name | None] = Field(default_factory=list, max_length=MAX_SENSORS, fail_fast=True)
    uavs: list[Name | None] = Field(default_factory=list, max_length=100, fail_fast=True)


class MapShape(Received):
    """A line or an area of the map, such as a section of the pipeline or a fence."""

    kind: Literal["line", "area", "fence", "no_fly"]
    name: Name | None = None
    points: list[Waypoint] = Field(
        min_length=2, max_length=1000, fail_fast=True, description="m; an area's first point is not repeated at its end"
    )


# A request's size bounds the points of all shapes together.
MapShapes = Annotated[list[MapShape], Field(max_length=MAX_SHAPES, fail_fast=True)]


def with_names(text: str, names: Names | None) -> str:
    """A text with the user's name after each ``sensor 4`` and ``UAV 1`` that has one and is without it."""

    def named(found: re.Match[str]) -> str:
        listed = () if names is None else names.uavs if found[1] == "UAV" else names.sensors
        name = listed[number] if (number := int(found[2])) < len(listed) else None
        return found[0] if name is None else f"{found[0]} ({name})"

    return re.sub(r"\b(UAV|[Ss]ensor) (\d{1,4})\b(?! \()", named, text)
