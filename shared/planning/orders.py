"""Operator guidance: a fleet's orders in addition to its goal to lose no packets, in a form that code can check.

An operator writes a note in plain words, and an LLM compiles it to a :class:`Guidance`. The edge obeys only confirmed
guidance. Empty guidance changes no number anywhere.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from shared.wire.schemas import MissionId, Note, SensorId
from shared.wire.strict_models import Received, Wire
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario

Level = Annotated[int, Field(ge=0, le=14)]
MAX_WISHES = 1000
MAX_WEIGHT = 10.0
MAX_EVERY = 1000
# The cost in lost packets of each step in which a sensor is overdue. It is above the loss of the fullest sensor in one
# step, so that a deadline gives way only to several sensors that overflow.
LATE_PACKETS = 20.0


class SensorWish(Received):
    """The orders for one sensor.

    With ``visit_every`` n the fleet is to visit the sensor at least once in any n consecutive steps.
    """

    sensor_id: SensorId
    weight: float = Field(1.0, ge=0, le=MAX_WEIGHT, description="the factor of its lost packets; 0: they do not count")
    visit_every: int | None = Field(None, ge=1, le=MAX_EVERY, description="steps")


class Guidance(Received):
    """A fleet's orders: wishes for sensors, and forbidden velocities.

    The velocities, m/s, are a hard rule: a UAV flies none of ``forbidden_velocities`` and none outside
    ``min_velocity..max_velocity``. Weights and visits are weighed against each other and against lost packets.
    """

    sensors: list[SensorWish] = Field([], max_length=MAX_WISHES, fail_fast=True)
    min_velocity: Level | None = None
    max_velocity: Level | None = None
    forbidden_velocities: list[Level] = Field([], max_length=15, fail_fast=True)

    @model_validator(mode="after")
    def _each_sensor_once(self) -> Self:
        ids = [wish.sensor_id for wish in self.sensors]
        if len(set(ids)) < len(ids):
            twice = next(i for i in ids if ids.count(i) > 1)
            raise ValueError(f"sensors names sensor {twice} more than once")
        return self

    def __bool__(self) -> bool:
        """Whether there is any order."""
        return self.wishes or self.restricts

    @property
    def wishes(self) -> bool:
        """Whether any sensor has a weight or a visit deadline."""
        return any(wish.weight != 1.0 or wish.visit_every is not None for wish in self.sensors)

    @property
    def restricts(self) -> bool:
        """Whether there is a rule on velocities, even one that forbids none of the scenario's."""
        return bool(self.forbidden_velocities) or self.min_velocity is not None or self.max_velocity is not None

    def check(self, scenario: Scenario) -> None:
        """Check that a fleet in this scenario can obey.

        Raises:
            Impossible: a sensor is unknown, a velocity does not exist, or no velocity is left.
        """
        for row, wish in enumerate(self.sensors):
            if wish.sensor_id >= scenario.sensors:
                known = f"there are {scenario.sensors}, from 0"
                raise Impossible(f"sensors[{row}].sensor_id", f"sensor {wish.sensor_id} is unknown: {known}")
        named = {"min_velocity": self.min_velocity, "max_velocity": self.max_velocity}
        named |= {f"forbidden_velocities[{row}]": level for row, level in enumerate(self.forbidden_velocities)}
        for name, level in named.items():
            if level is not None and level > scenario.max_velocity:
                raise Impossible(name, f"{level} m/s is more than the fleet's highest, {scenario.max_velocity} m/s")
        if not self.allowed(scenario.max_velocity + 1).any():
            raise Impossible("forbidden_velocities", "no velocity is left to fly at")

    def allowed(self, levels: int) -> NDArray[np.bool_]:
        """Which of the velocities 0..levels - 1 m/s a UAV may fly, shape ``(levels,)``."""
        level = np.arange(levels)
        fastest = levels if self.max_velocity is None else self.max_velocity
        slowest = 0 if self.min_velocity is None else self.min_velocity
        return (level >= slowest) & (level <= fastest) & ~np.isin(level, self.forbidden_velocities)

    def allows(self, velocity: int) -> bool:
        """Whether a UAV may fly this velocity."""
        slow = self.min_velocity is not None and velocity < self.min_velocity
        fast = self.max_velocity is not None and velocity > self.max_velocity
        return not (slow or fast or velocity in self.forbidden_velocities)

    def nearest(self, velocity: int, levels: int) -> int:
        """The allowed velocity of 0..levels - 1 nearest to this one, the slower of two."""
        if 0 <= velocity < levels and self.allows(velocity):
            return velocity
        choices = np.flatnonzero(self.allowed(levels))
        return int(choices[np.abs(choices - velocity).argmin()])

    def weights(self, sensors: int) -> FloatArray:
        """The factor of each sensor's lost packets, shape ``(J,)``."""
        weights = np.ones(sensors)
        for wish in self.sensors:
            weights[wish.sensor_id] = wish.weight
        return weights

    def visit_intervals(self, sensors: int) -> FloatArray:
        """The longest interval between visits to each sensor, steps, shape ``(J,)``; infinite without an order."""
        intervals = np.full(sensors, np.inf)
        for wish in self.sensors:
            if wish.visit_every is not None:
                intervals[wish.sensor_id] = wish.visit_every
        return intervals

    def overdue(self, step: int, visits: NDArray[np.int64]) -> FloatArray:
        """The steps by which each sensor is overdue if no UAV visits it in this step, shape ``(J,)``.

        It is 1 if a visit in this very step is just in time, and 0 if there is more time.

        Args:
            visits: step of the last visit, ``(J,)``; -1 for never, which counts as a visit just before step 0.
        """
        late: FloatArray = np.maximum(step - visits - self.visit_intervals(len(visits)) + 1.0, 0.0)
        return late

    def lateness(self, step: int, visits: NDArray[np.int64], horizon: int, beyond: int) -> FloatArray:
        """The price of overdue sensors in a plan from ``step`` on, packets: :attr:`FleetProblem.late`.

        ``late[s, e, j]`` is the price in the plan's step e if no UAV has visited sensor j since the plan's step s
        began; e = H stands for the ``beyond`` steps after the plan.

        Args:
            visits: step of the last visit before the plan, ``(J,)``; -1 for never.

        Returns:
            Shape ``(H + 1, H + 1, J)``.
        """
        late = np.zeros((horizon + 1, horizon + 1, len(visits)))
        for since in range(horizon + 1):
            last = visits if since == 0 else np.full_like(visits, step + since - 1)
            for now in range(since, horizon + 1):
                steps = [now] if now < horizon else range(horizon, horizon + beyond)
                late[since, now] = sum(LATE_PACKETS * (self.overdue(step + n, last) > 0) for n in steps)
        return late

    def merged_with(self, in_force: Guidance, levels: int) -> Guidance:
        """These orders merged with the orders in force.

        For a sensor in both, these orders apply. The allowed velocities are those of 0..levels - 1 m/s that both allow;
        if there are none, those that the orders in force allow.
        """
        if not in_force:
            return self
        named = {wish.sensor_id for wish in self.sensors}
        others = [wish for wish in in_force.sensors if wish.sensor_id not in named]
        allowed = in_force.allowed(levels)
        both = allowed & self.allowed(levels)
        forbidden = np.flatnonzero(~(both if both.any() else allowed)).tolist()
        return Guidance(sensors=[*self.sensors, *others][:MAX_WISHES], forbidden_velocities=forbidden)

    def in_words(self) -> str:
        """The orders in plain English, from the structure alone."""
        return " ".join(self._each_in_words()) or "Nothing beyond the mission's own rules."

    def beyond(self, other: Guidance) -> list[str]:
        """The orders, each in words, that the other guidance does not have."""
        others = set(other._each_in_words())
        return [order for order in self._each_in_words() if order not in others]

    def _each_in_words(self) -> list[str]:
        words = []
        for wish in self.sensors:
            if wish.visit_every is not None:
                often = "in every step" if wish.visit_every == 1 else f"at least once in every {wish.visit_every} steps"
                words.append(f"Visit sensor {wish.sensor_id} {often}.")
            if wish.weight == 0:
                words.append(f"Ignore what sensor {wish.sensor_id} loses.")
            elif wish.weight != 1:
                words.append(f"Count each packet that sensor {wish.sensor_id} loses {wish.weight:g} times.")
        if self.min_velocity is not None:
            words.append(f"Never fly slower than {self.min_velocity} m/s.")
        if self.max_velocity is not None:
            words.append(f"Never fly faster than {self.max_velocity} m/s.")
        if self.forbidden_velocities:
            levels = " or ".join(map(str, sorted(set(self.forbidden_velocities))))
            words.append(f"Never fly at {levels} m/s.")
        return words


class Impossible(ValueError):
    """Guidance that this fleet cannot obey; ``field`` is the field at fault."""

    def __init__(self, field: str, detail: str) -> None:
        super().__init__(f"{field}: {detail}")
        self.field = field
        self.detail = detail


NO_GUIDANCE = Guidance()

# `none`: neither a note nor a structure of the operator's.
GuidanceState = Literal["none", "compiling", "proposed", "confirmed", "rejected", "failed"]


class GuidanceStatus(Wire):
    """``GET /missions/{id}/guidance``: the operator's note, the guidance from it, and its status.

    The edge obeys only ``confirmed`` guidance. The compact prompt shows ``proposed`` guidance too, which the LLM alone
    decides by in mode ``llm``.
    """

    # The status of a newer edge may have more fields.
    model_config = ConfigDict(extra="ignore")

    mission_id: MissionId
    status: GuidanceState
    note: str | None = None
    guidance: Guidance | None = Field(None, description="compiled from the note, or given by the operator")
    in_words: str | None = Field(None, description="the guidance in plain English, from the structure alone")
    obeyed_in_words: str | None = Field(None, description="the orders that are obeyed now, in plain English")
    origin: Literal["llm", "operator"] | None = Field(None, description="the author of the structure")
    model: str | None = Field(None, description="the LLM that compiled the note")
    failure: str | None = Field(None, description="why the note could not be compiled")
    doubts: list[str] = Field([], description="what may be wrong with the LLM's reading; empty if it is certain")
    begins: list[str] = Field([], description="the orders that begin when `guidance` is confirmed, each in words")
    ends: list[str] = Field([], description="the orders in force that end when `guidance` is confirmed, each in words")
    begun: list[str] = Field([], description="the orders that began when those in force last changed, each in words")
    ended: list[str] = Field([], description="the orders that ended when those in force last changed, each in words")
    version: str = Field("", description="another one after every change; an answer may name the one that it answers")


class GuidanceAnswer(Received):
    """``POST /missions/{id}/guidance``: confirm or reject the compiled guidance, replace it, or withdraw all orders.

    A new note is compiled, and obeyed once it is confirmed; until then the orders before it stay. A given structure
    counts as confirmed. It needs neither an LLM nor a note. Both replace all orders in force. `withdraw` ends these,
    whatever has become of the note; `reject` does the same where no proposal waits for an answer.
    """

    answer: Literal["confirm", "reject", "withdraw"] | None = None
    guidance: Guidance | None = None
    note: Note | None = Field(
        None, description="a new note in plain words; a long prompt keeps the text of the mission's first one"
    )
    version: str | None = Field(
        None, max_length=64, description="the status's `version`: the answer gets 409 if the guidance has changed since"
    )

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        if [self.answer, self.guidance, self.note].count(None) != 2:
            raise ValueError("give one of answer, guidance and note")
        return self
