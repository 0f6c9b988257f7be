"""The wire of sensors' own readings, which reach the edge by another network than the UAVs' radios, such as LoRaWAN."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from shared.wire.schemas import SensorId, Step
from shared.wire.strict_models import Received, Wire

# A day: an older reading says nothing about a queue.
MAX_AGE_S = 86_400.0
MAX_READINGS = 1000

ReadingResult = Literal["merged", "duplicate", "outdated", "early"]


class SensorReading(Received):
    """One sensor's own reading; its time is an age or a step of the mission."""

    sensor_id: SensorId
    queue: float = Field(ge=0, le=100_000, description="packets waiting")
    battery: float | None = Field(None, ge=0, le=1e9, description="J left; omitted: as known before")
    age_s: float | None = Field(
        None, ge=0, le=MAX_AGE_S, description="s since the sensor sent it; give this or `step`, not both"
    )
    step: Step | None = Field(None, description="the step at whose start the queue was such")
    message_id: Annotated[str, Field(pattern=r"^[\x21-\x7e]{1,64}$")] | None = Field(
        None, description="of the reading's message: a repeated message counts once"
    )

    @model_validator(mode="after")
    def _one_time(self) -> Self:
        if (self.age_s is None) == (self.step is None):
            raise ValueError("give age_s or step, one of the two")
        return self


class ReadingsRequest(Received):
    """``POST /missions/{id}/readings``: at most one reading of a sensor."""

    readings: list[SensorReading] = Field(min_length=1, max_length=MAX_READINGS, fail_fast=True)

    @model_validator(mode="after")
    def _one_a_sensor(self) -> Self:
        ids = [reading.sensor_id for reading in self.readings]
        if len(set(ids)) != len(ids):
            raise ValueError("readings: a sensor appears more than once; send its newest reading")
        return self


class ReadingsResponse(Wire):
    """The result of each reading, in the order of the request."""

    results: list[ReadingResult] = Field(
        description="`merged` into the fleet's belief; `duplicate`: its message was merged before; `outdated`: a "
        "beacon, a reading or a visit of its step or a later one is known; `early`: no UAV of the mission has reported "
        "yet: send it again"
    )
    step: Step | None = Field(description="the mission's newest step; null before its first report")
