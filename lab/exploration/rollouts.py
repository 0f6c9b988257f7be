"""Logged decisions: the simulator records them, and the edge's modules are pretrained on them."""

from __future__ import annotations

import gzip
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from shared.wire.schemas import DecideRequest, SensorId
from shared.wire.strict_models import Wire
from shared.world.scenario import Scenario


class Header(Wire):
    """The first line of a rollouts file: the world of all its missions."""

    scenario: Scenario
    missions: int
    behaviour: str


class Reference(Wire):
    """A teacher's action: ``planner`` has the fleet's knowledge, ``clairvoyant`` knows all arrivals."""

    teacher: Literal["planner", "clairvoyant"]
    sensor_id: SensorId
    velocity: int = Field(ge=0, le=14)


class RolloutStep(Wire):
    """One UAV's decision: its report, its action, and the outcome.

    ``cost`` is the UAV's own c, ``fleet_lost`` the packets lost in that step at all sensors. ``reference`` is the
    teacher's action, which the UAV may not have flown; None without a teacher, and in older files.
    """

    request: DecideRequest
    sensor_id: SensorId
    velocity: int = Field(ge=0, le=14)
    cost: float = Field(ge=0)
    failed: bool
    fleet_lost: int = Field(ge=0)
    reference: Reference | None = None


def write_rollouts(path: Path, header: Header, steps: Iterable[RolloutStep]) -> None:
    """Write gzipped JSON lines, the header first; until the last step is written the name ends with ``.part``."""
    half = path.with_name(f"{path.name}.part")
    with gzip.open(half, "wt", encoding="utf-8", compresslevel=3) as file:
        file.write(header.model_dump_json() + "\n")
        file.writelines(step.model_dump_json() + "\n" for step in steps)
    half.replace(path)


def read_rollouts(path: Path) -> tuple[Header, Iterator[RolloutStep]]:
    """The header, and the steps one by one.

    Raises:
        OSError: the file cannot be read or is no gzip.
        ValueError: a line is invalid; the text names it.
    """

    def parsed() -> Iterator[Header | RolloutStep]:
        number = 0
        with gzip.open(path, "rt", encoding="utf-8") as file:
            try:
                for number, line in enumerate(file, start=1):
                    model = Header if number == 1 else RolloutStep
                    yield model.model_validate_json(line)
            except ValidationError as error:
                fault = error.errors(include_url=False)[0]["msg"]
                raise ValueError(f"{path}, line {number}: {fault}") from None
            except EOFError:
                raise ValueError(f"{path} ends after line {number}: its recording was stopped") from None

    lines = parsed()
    header = next(lines, None)
    if not isinstance(header, Header):
        raise ValueError(f"{path} is empty")
    return header, (line for line in lines if isinstance(line, RolloutStep))
